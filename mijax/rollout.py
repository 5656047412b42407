"""Running environments: collecting experience into the replay, and greedy evaluation."""

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from envs_mjx.base import Environment, EnvState, TimeStep
from mijax.agents.core import Agent
from mijax.nets.two_branch import MemoryState
from mijax.replay import Replay, StepRecord, finish, write
from mijax.types import Metrics, Params

Recorder = Callable[..., StepRecord]
"""What the replay stores of a step of E environments, from their time steps and previous actions, and, where moments
are stored, their states and the symmetries of their episodes."""


class Actor(Protocol):
    """What plays greedily: an agent, or one that forgets; see `mijax.agents.core.Agent`."""

    def no_action(self, batch: int) -> jax.Array:
        """The previous action of episodes that have not started."""
        ...

    def initial_memory(self, batch: int) -> Any:
        """What such episodes remember."""
        ...

    def act(self, params: Params, memory: Any, observation: jax.Array, previous_action: jax.Array) -> tuple:
        """New memory and greedy actions."""
        ...

    def value(self, params: Params, memory: Any, observation: jax.Array, previous_action: jax.Array) -> jax.Array:
        """What is promised of episodes after their first observation."""
        ...


@struct.dataclass
class Episodes:
    """The open episode of each of E environments."""

    env_state: EnvState  # leading axis E
    timestep: TimeStep  # leading axis E
    memory: MemoryState | Any  # leading axis E
    previous_action: jax.Array  # (E,) int32, -1 at the start; or (E, A) float32, 0 at the start
    position: jax.Array  # (E,) int32, steps since the start
    returns: jax.Array  # (E,) float32, undiscounted so far
    symmetry: jax.Array | None = None  # (E, 2) uint32, drawn with the episode: see `mijax.augmentation`


@struct.dataclass
class EpisodeTotals:
    """Sums over the episodes that finished."""

    episodes: jax.Array  # () int32
    returns: jax.Array  # () float32
    successes: jax.Array  # () int32
    steps: jax.Array  # () int32

    @staticmethod
    def zero() -> "EpisodeTotals":
        """Nothing finished yet."""
        count = jnp.zeros((), jnp.int32)
        return EpisodeTotals(count, jnp.zeros(()), count, count)

    def metrics(self) -> Metrics:
        """Means over the episodes; NaN when none finished."""
        number = self.episodes.astype(jnp.float32)
        number = jnp.where(number > 0, number, jnp.nan)
        return {
            "train/episodes": self.episodes,
            "train/return": self.returns / number,
            "train/success": self.successes / number,
            "train/length": self.steps / number,
        }


def select(which: jax.Array, new: Any, old: Any) -> Any:
    """Per environment (leading axis): `new` where `which`, else `old`. Works on pytrees."""
    return jax.tree.map(lambda x, y: jnp.where(which.reshape(-1, *[1] * (x.ndim - 1)), x, y), new, old)


def start_episodes(
    env: Environment, agent: Actor, num_envs: int, key: jax.Array, symmetric: bool = False
) -> Episodes:
    """Reset every environment; `symmetric`: for a replay that stores copies of episodes, moved by a symmetry each."""
    env_state, timestep = jax.vmap(env.reset)(jax.random.split(key, num_envs))
    return Episodes(
        env_state=env_state,
        timestep=timestep,
        memory=agent.initial_memory(num_envs),
        previous_action=agent.no_action(num_envs),
        position=jnp.zeros((num_envs,), jnp.int32),
        returns=jnp.zeros((num_envs,)),
        symmetry=draw_symmetry(key, num_envs) if symmetric else None,
    )


def draw_symmetry(key: jax.Array, num: int) -> jax.Array:
    """(num, 2) uint32, one for each episode; besides it, `key` may be split up to `num` ways."""
    return jax.random.bits(jax.random.fold_in(key, num), (num, 2), jnp.uint32)


def collect_step(
    env: Environment,
    agent: Agent,
    params: Params,
    record: Recorder,
    epsilon: jax.Array,
    episodes: Episodes,
    replay: Replay,
    totals: EpisodeTotals,
    key: jax.Array,
) -> tuple[Episodes, Replay, EpisodeTotals]:
    """Act once in every environment, store what follows, and start a new episode where one ended."""
    num_envs = episodes.position.shape[0]
    key_act, key_env, key_reset = jax.random.split(key, 3)
    memory, action = agent.explore(
        params, episodes.memory, episodes.timestep.observation, episodes.previous_action, epsilon, key_act
    )
    env_state, timestep = jax.vmap(env.step)(jax.random.split(key_env, num_envs), episodes.env_state, action)
    position, returns = episodes.position + 1, episodes.returns + timestep.reward
    reached = record(timestep, action, env_state, episodes.symmetry)
    replay = write(replay, reached, position)
    done = timestep.done
    totals = EpisodeTotals(
        totals.episodes + jnp.sum(done, dtype=jnp.int32),
        totals.returns + jnp.sum(jnp.where(done, returns, 0)),
        totals.successes + jnp.sum(done & jax.vmap(env.success)(timestep), dtype=jnp.int32),
        totals.steps + jnp.sum(jnp.where(done, position, 0), dtype=jnp.int32),
    )
    replay = finish(replay, done, position + 1)
    running = Episodes(env_state, timestep, memory, action, position, returns, episodes.symmetry)

    def begin() -> tuple[Episodes, StepRecord]:
        begun = select(done, start_episodes(env, agent, num_envs, key_reset, agent.copies > 0), running)
        return begun, record(begun.timestep, begun.previous_action, begun.env_state, begun.symmetry)

    # What a robot's replay stores costs as much as a step, and few steps end an episode.
    episodes, first = jax.lax.cond(jnp.any(done), begin, lambda: (running, reached))
    return episodes, write(replay, first, episodes.position, keep=done), totals


def evaluate(
    env: Environment, agent: Actor, params: Params, num_episodes: int, key: jax.Array, discount: float
) -> Metrics:
    """Greedy episodes, side by side: per-episode results, each (num_episodes,).

    The discounted return is sum_t gamma^t r_{t+1}, gamma = `discount`; `value` is what the agent promises itself of it,
    and of the bonus, on the first observation: far above the return means that it believes episodes it has learnt by
    heart.
    """
    key_start, key_steps = jax.random.split(key)
    episodes = start_episodes(env, agent, num_episodes, key_start)
    false = jnp.zeros((num_episodes,), bool)
    zero = jnp.zeros((num_episodes,))
    value = agent.value(params, episodes.memory, episodes.timestep.observation, episodes.previous_action)

    def advance(carry: tuple, key: jax.Array) -> tuple[tuple, None]:
        episodes, over, success, discounted, revealed = carry
        revealed |= ~over & jax.vmap(env.reveals)(episodes.env_state)
        memory, action = agent.act(
            params, episodes.memory, episodes.timestep.observation, episodes.previous_action
        )
        keys = jax.random.split(key, num_episodes)
        env_state, timestep = jax.vmap(env.step)(keys, episodes.env_state, action)
        reward = jnp.where(over, 0, timestep.reward)
        success |= ~over & timestep.done & jax.vmap(env.success)(timestep)
        discounted += reward * discount ** episodes.position.astype(jnp.float32)
        position = episodes.position + ~over
        episodes = Episodes(
            env_state, timestep, memory, action, position, episodes.returns + reward, episodes.symmetry)
        return (episodes, over | timestep.done, success, discounted, revealed), None

    carry = (episodes, false, false, zero, false)
    (episodes, _, success, discounted, revealed), _ = jax.lax.scan(
        advance, carry, jax.random.split(key_steps, env.horizon)
    )
    return {
        "return": episodes.returns,
        "discounted_return": discounted,
        "success": success.astype(jnp.float32),
        "length": episodes.position.astype(jnp.float32),
        "reveals": revealed.astype(jnp.float32),
        "value": value,
    }

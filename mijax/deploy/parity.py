"""Whether an exported policy acts as the trained agent does: whole episodes of the agent, step by step."""

import dataclasses
from collections.abc import Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mijax.agents.core import Agent
from mijax.agents.dqn import DQN
from mijax.deploy.numpy_policy import Policy, Refused
from mijax.rollout import select, start_episodes
from mijax.run_folder import RunError
from mijax.types import Params

TOLERANCE = 1e-4
"""How far actions may differ; and how much worse by the agent's own values a different discrete action may be."""
BATCH = 10
"""Episodes played side by side: ten of a robot's are 30 MB of frames."""
STRAY = 0.25
"""Share of random actions in every second episode. A trained agent's own episodes are too much alike to test it: on
Heaven-Hell there are two."""


@dataclasses.dataclass(frozen=True)
class Parity:
    """What a comparison found."""

    episodes: int
    steps: int
    largest_difference: float
    """Between actions; with discrete ones between the values of the two that were chosen, 0 where they are the same."""
    ties: int
    """Steps with another action, of a value within `TOLERANCE` of the best."""

    def __str__(self) -> str:
        differ = f"differ by {self.largest_difference:.2g} at most" if self.largest_difference else "are the same"
        ties = f", {self.ties} ties broken otherwise" if self.ties else ""
        return f"{self.episodes} episodes, {self.steps} steps: actions {differ}{ties}"


@dataclasses.dataclass(frozen=True)
class Episode:
    """T steps of the agent, on the host."""

    observation: np.ndarray  # (T, *observation_shape)
    action: np.ndarray  # (T,) int32 or (T, A) float32: the greedy one
    taken: np.ndarray  # as `action`: what was done instead, in an episode that strays
    values: np.ndarray | None  # (T, A) with discrete actions


def play(agent: Agent, params: Params, key: jax.Array, number: int) -> Iterator[Episode]:
    """Episodes of the agent, `BATCH` side by side: greedy ones, and every second one that strays."""
    env, side_by_side = agent.env, min(number, BATCH)
    strays = jnp.arange(side_by_side) % 2 == 1

    @jax.jit
    def batch(params: Params, key: jax.Array) -> tuple[Any, ...]:
        key_start, key_steps = jax.random.split(key)

        def step(carry: tuple, key: jax.Array) -> tuple[tuple, tuple]:
            env_state, observation, memory, previous = carry
            seen, values = (memory, observation, previous), None
            if isinstance(agent, DQN):
                values = agent.action_values(params, *seen)[1]
            memory, action = agent.act(params, *seen)
            key_action, key_step = jax.random.split(key)
            taken = select(strays, agent.explore(params, *seen, jnp.float32(STRAY), key_action)[1], action)
            env_state, timestep = jax.vmap(env.step)(jax.random.split(key_step, side_by_side), env_state, taken)
            return (env_state, timestep.observation, memory, taken), (observation, action, taken, values, timestep.done)

        start = start_episodes(env, agent, side_by_side, key_start)
        carry = start.env_state, start.timestep.observation, start.memory, start.previous_action
        return jax.lax.scan(step, carry, jax.random.split(key_steps, env.horizon))[1]

    for begin in range(0, number, side_by_side):
        *recorded, over = jax.device_get(batch(params, jax.random.fold_in(key, begin)))
        for i in range(min(side_by_side, number - begin)):
            length = int(np.argmax(over[:, i])) + 1 if over[:, i].any() else len(over)
            yield Episode(*jax.tree.map(lambda x, i=i, length=length: x[:length, i], recorded))


def compare(policy: Policy, episodes: Iterable[Episode]) -> Parity:
    """Show the policy what the agent saw and did in whole episodes; the memory is the policy's own.

    Raises:
        RunError: an action differs by more than `TOLERANCE`, or the contract refuses what the environment shows.
    """
    number, steps, largest, ties = 0, 0, 0.0, 0
    for number, episode in enumerate(episodes, start=1):
        policy.reset()
        for t, (observation, expected) in enumerate(zip(episode.observation, episode.action, strict=True)):
            where = f"episode {number}, step {t}"
            try:
                action = policy.act(observation, episode.taken[t - 1] if t else None)
            except Refused as error:
                raise RunError(f"parity: {where}: the contract refuses what the environment shows: {error}") from None
            if episode.values is None:
                difference = float(np.max(np.abs(action - expected)))
            else:
                difference = float(episode.values[t, expected] - episode.values[t, action])
                ties += int(action != expected)
            if not difference <= TOLERANCE:
                raise RunError(f"parity: {where}: the exported policy's action is {action}, the agent's {expected}")
            largest = max(largest, difference)
        steps += len(episode.action)
    policy.reset()
    return Parity(number, steps, largest, ties)

"""Trials of a robot task: many episodes of its scripted expert, or of random actions, counted by how they end."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.robot.planner import Planner
from envs_mjx.robot.task import OUTCOMES, RUNNING, SUCCESS, RobotState, RobotTask

Act = Callable[[Any, jax.Array, jax.Array], tuple[Any, jax.Array]]
BATCH = 16
"""Episodes side by side: the fastest on a CPU."""


@dataclasses.dataclass(frozen=True)
class Trial:
    """N episodes."""

    outcome: np.ndarray  # (N,) int32, index into `task.OUTCOMES`
    length: np.ndarray  # (N,) int32, steps
    movable_first: np.ndarray | None  # (N,) bool, what the expert works on first, or a policy touches; None: neither
    moments: RobotState | None  # leaves (N, T + 1, ...), of the expert's episodes
    not_finite: int
    """Frames shown, over all episodes, in which any number is not finite; 0 where none were drawn."""
    touched: np.ndarray | bool = True
    """(N,) bool, whether a policy touched anything."""

    def episode(self, index: int) -> list[RobotState]:
        """The moments of one of the expert's episodes, from the reset to its end."""
        return [jax.tree.map(lambda x, t=t: x[index, t], self.moments) for t in range(int(self.length[index]) + 1)]

    @property
    def success(self) -> np.ndarray:
        """(N,) bool: whether an episode ended with the task solved."""
        return self.outcome == SUCCESS

    def counts(self) -> dict[str, int]:
        """How many episodes ended in each way."""
        return {name: int(np.sum(self.outcome == code)) for code, name in enumerate(OUTCOMES) if code != RUNNING}


def expert_trial(env: RobotTask, key: jax.Array, episodes: int, changes_over: bool = True) -> Trial:
    """Episodes of the expert; every other one begins with the immovable object.

    Args:
        changes_over: False gives an expert that works on its first choice for ever.
    """
    first = jnp.arange(_whole_batches(episodes), dtype=jnp.int32) % 2
    keys = jax.random.split(key, first.shape[0])
    played = jax.tree.map(lambda x: np.asarray(x)[:episodes], _play_expert(env, changes_over, keys, first))
    return Trial(*played[:2], movable_first=np.asarray(first[:episodes] == 1), moments=played[2], not_finite=0)


def random_trial(env: RobotTask, key: jax.Array, episodes: int) -> Trial:
    """Episodes of uniformly random actions; every frame up to the end is drawn and looked at."""
    keys = jax.random.split(key, _whole_batches(episodes))
    outcome, length, not_finite = (np.asarray(x)[:episodes] for x in _play_random(env, keys))
    return Trial(outcome, length, movable_first=None, moments=None, not_finite=int(not_finite.sum()))


def policy_trial(
    env: RobotTask, act: Act, initial_memory: Callable[[int], Any], no_action: Callable[[int], jax.Array],
    key: jax.Array, episodes: int
) -> Trial:
    """Episodes of a policy.

    Args:
        env: the task.
        act: (memory, (B, 84, 84, 2) observations, (B, 4) previous actions) -> new memory, (B, 4) actions.
        initial_memory: of so many episodes.
        no_action: (B, 4) previous actions at their start.
        key: draws the episodes.
        episodes: how many.
    """
    play = jax.jit(functools.partial(_play_policy, env, act, initial_memory(BATCH), no_action(BATCH)))
    keys = jax.random.split(key, (_whole_batches(episodes) // BATCH, BATCH))
    outcome, length, first = (np.asarray(x).reshape(-1)[:episodes] for x in jax.lax.map(play, keys))
    return Trial(outcome, length, movable_first=first == 1, moments=None, not_finite=0, touched=first >= 0)


def _play_policy(
    env: RobotTask, act: Act, memory: Any, previous_action: jax.Array, keys: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """How (B,) episodes end, their lengths, and whether the object touched first is the movable one, -1 for neither:
    the one that is nearer to the gripper when something is touched for the first time."""
    env_state, shown = jax.vmap(env.reset)(keys)
    keys = jax.vmap(lambda key: jax.random.fold_in(key, 3))(keys)  # 0 to 2 are `reset`'s

    def nearer_is_movable(env_state: RobotState) -> jax.Array:
        apart = env.object_poses(env_state)[:, :2] - env_state.qpos[None, :2]
        return (jnp.argmin(jnp.sum(jnp.square(apart), axis=1)) == env_state.movable).astype(jnp.int32)

    def step(carry: tuple, number: jax.Array) -> tuple[tuple, None]:
        env_state, observation, memory, previous_action, first = carry
        memory, action = act(memory, observation, previous_action)
        step_keys = jax.vmap(lambda key: jax.random.fold_in(key, number))(keys)
        later, shown = jax.vmap(env.step)(step_keys, env_state, action)
        over = env_state.outcome != RUNNING
        first = jnp.where(~over & later.touched & ~env_state.touched, jax.vmap(nearer_is_movable)(later), first)
        later = jax.tree.map(
            lambda old, new: jnp.where(over.reshape(-1, *[1] * (old.ndim - 1)), old, new), env_state, later)
        return (later, shown.observation, memory, action, first), None

    start = (env_state, shown.observation, memory, previous_action, jnp.full(keys.shape[0], -1, jnp.int32))
    (env_state, _, _, _, first), _ = jax.lax.scan(step, start, jnp.arange(env.horizon, dtype=jnp.int32))
    return env_state.outcome, env_state.time, first


def _whole_batches(episodes: int) -> int:
    """A partial batch would be compiled by itself."""
    return -(-episodes // BATCH) * BATCH


@functools.partial(jax.jit, static_argnums=(0, 1))
def _play_expert(env: RobotTask, changes_over: bool, keys: jax.Array, first: jax.Array) -> tuple:
    def play(episode: tuple) -> tuple[jax.Array, jax.Array, RobotState]:
        played = Planner(env, changes_over).play(*episode)
        return played.outcome, played.length, played.states

    return jax.lax.map(play, (keys, first), batch_size=BATCH)


@functools.partial(jax.jit, static_argnums=0)
def _play_random(env: RobotTask, keys: jax.Array) -> tuple:
    def play(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        keys = jax.random.split(key, env.horizon + 1)
        env_state, shown = env.reset(keys[0])

        def finite(shown) -> jax.Array:
            return jnp.isfinite(shown.observation).all() & jnp.isfinite(shown.state).all()

        def step(carry: tuple, key: jax.Array) -> tuple[tuple, None]:
            env_state, not_finite = carry
            key_action, key_step = jax.random.split(key)
            action = env.action_spec.sample(key_action)
            later, shown = env.step(key_step, env_state, action)
            over = env_state.outcome != RUNNING
            env_state = jax.tree.map(lambda old, new: jnp.where(over, old, new), env_state, later)
            return (env_state, not_finite + (~over & ~finite(shown)).astype(jnp.int32)), None

        start = (env_state, (~finite(shown)).astype(jnp.int32))
        (env_state, not_finite), _ = jax.lax.scan(step, start, keys[1:])
        return env_state.outcome, env_state.time, not_finite

    return jax.lax.map(play, keys, batch_size=BATCH)

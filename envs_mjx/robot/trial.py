"""Trials of a robot task: many episodes of its scripted expert, or of random actions, counted by how they end."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.registry import sample_action
from envs_mjx.robot.planner import Planner
from envs_mjx.robot.task import OUTCOMES, RUNNING, SUCCESS, RobotState, RobotTask

BATCH = 16
"""Episodes side by side: the fastest on a CPU."""


@dataclasses.dataclass(frozen=True)
class Trial:
    """N episodes."""

    outcome: np.ndarray  # (N,) int32, index into `task.OUTCOMES`
    length: np.ndarray  # (N,) int32, steps
    movable_first: np.ndarray | None  # (N,) bool, what the expert works on first; None: no expert played
    moments: RobotState | None  # leaves (N, T + 1, ...), of the expert's episodes
    not_finite: int
    """Frames shown, over all episodes, in which any number is not finite; 0 where none were drawn."""

    def episode(self, index: int) -> list[RobotState]:
        """The moments of one of the expert's episodes, from the reset to its end."""
        return [jax.tree.map(lambda x, t=t: x[index, t], self.moments) for t in range(int(self.length[index]) + 1)]

    @property
    def success(self) -> np.ndarray:
        """(N,) bool"""
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
            action = sample_action(env, key_action)
            later, shown = env.step(key_step, env_state, action)
            over = env_state.outcome != RUNNING
            env_state = jax.tree.map(lambda old, new: jnp.where(over, old, new), env_state, later)
            return (env_state, not_finite + (~over & ~finite(shown)).astype(jnp.int32)), None

        start = (env_state, (~finite(shown)).astype(jnp.int32))
        (env_state, not_finite), _ = jax.lax.scan(step, start, keys[1:])
        return env_state.outcome, env_state.time, not_finite

    return jax.lax.map(play, keys, batch_size=BATCH)

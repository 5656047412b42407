"""Transitions (s, o, a, r, s', o') of a random policy or an expert, as indices into distinct states and observations.

Letters: N transitions, S distinct states, D distinct observations, V ground-truth variables.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs_mjx.base import Demonstrations, Environment, EnvState, TimeStep
from mijax.config import DataSource
from mijax.demonstrations import demonstrate


@struct.dataclass
class Transitions:
    """Whole episodes, one row per transition; each distinct frame is stored once, in its own dtype."""

    states: jax.Array  # (S, *state_shape)  distinct states
    observations: jax.Array  # (D, *observation_shape)  distinct observations
    state: jax.Array  # (N,) int32  row of `states`
    observation: jax.Array  # (N,) int32  row of `observations`
    action: jax.Array  # (N,) int32, or (N, size) float32 when continuous
    reward: jax.Array  # (N,) float32, received on arriving at the next state
    next_state: jax.Array  # (N,) int32
    next_observation: jax.Array  # (N,) int32
    terminal: jax.Array  # (N,) bool  whether the task ended there; the time limit is no end of the task
    ground_truth: jax.Array  # (N, V) float32  `Environment.variables` before the action
    reveals: jax.Array  # (N,) bool  whether `observation` shows what is otherwise hidden
    episode: jax.Array  # (N,) int32
    key: jax.Array  # (2,) uint32  data of the key that the episodes follow from
    moments: EnvState | None = None  # leaves (S, ...)  what shows each state, to be augmented; None: not kept

    @property
    def size(self) -> int:
        """N, the number of transitions."""
        return self.reward.shape[0]


@struct.dataclass
class Episodes:
    """Rectangular episodes of at most T steps; what follows the end of an episode is meaningless.

    Frames have T + 1 entries: the one that ends an episode is the last of its `length` + 1.
    """

    env_state: EnvState  # leaves (E, T + 1, ...)
    timestep: TimeStep  # leaves (E, T + 1, ...)
    action: jax.Array  # (E, T, ...)  action t leads from frame t to frame t + 1
    length: jax.Array  # (E,) int32  steps of each episode


@functools.partial(jax.jit, static_argnums=(0, 2))
def random_episodes(env: Environment, key: jax.Array, num_episodes: int) -> Episodes:
    """`num_episodes` whole episodes of the uniform random policy, side by side."""

    def rollout(episode_key: jax.Array) -> Episodes:
        keys = jax.random.split(episode_key, env.horizon + 1)
        first = env.reset(keys[0])

        def step(carry: tuple, step_key: jax.Array) -> tuple:
            env_state, alive = carry
            action_key, env_key = jax.random.split(step_key)
            action = env.action_spec.sample(action_key)
            env_state, timestep = env.step(env_key, env_state, action)
            return (env_state, alive & ~timestep.done), (action, (env_state, timestep), alive)

        _, (action, frames, alive) = jax.lax.scan(step, (first[0], jnp.ones((), bool)), keys[1:])
        env_state, timestep = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, frames)
        return Episodes(env_state, timestep, action, jnp.sum(alive, dtype=jnp.int32))

    return jax.vmap(rollout)(jax.random.split(key, num_episodes))


def random_transitions(env: Environment, key: jax.Array, num_episodes: int) -> Transitions:
    """The transitions of `random_episodes`, each distinct frame stored once."""
    episodes = random_episodes(env, key, num_episodes)
    truth, reveals = jax.jit(jax.vmap(jax.vmap(lambda moment: (env.ground_truth(moment), env.reveals(moment)))))(
        episodes.env_state)
    shown, action, length, truth, reveals = jax.device_get(
        (episodes.timestep, episodes.action, episodes.length, truth, reveals))
    row, step = np.nonzero(np.arange(env.horizon) < length[:, None])
    seen = np.arange(env.horizon + 1) <= length[:, None]
    states, state_index = _distinct(shown.state, seen)
    observations, observation_index = _distinct(shown.observation, seen)
    columns: dict[str, np.ndarray] = {
        "states": states, "observations": observations,
        "state": state_index[row, step], "next_state": state_index[row, step + 1],
        "observation": observation_index[row, step], "next_observation": observation_index[row, step + 1],
        "action": action[row, step], "reward": shown.reward[row, step + 1],
        "terminal": shown.terminated[row, step + 1], "ground_truth": truth[row, step], "reveals": reveals[row, step],
        "episode": row.astype(np.int32), "key": np.asarray(jax.random.key_data(key))}
    return Transitions(**{name: jnp.asarray(column) for name, column in columns.items()})


def _distinct(frames: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distinct frames of (E, T + 1, ...) where `seen`, and (E, T + 1) int32 which of them stands where."""
    flat = np.ascontiguousarray(frames[seen])
    as_bytes = flat.reshape(len(flat), -1).view(np.dtype((np.void, flat[0].nbytes))).ravel()
    _, first, inverse = np.unique(as_bytes, return_index=True, return_inverse=True)
    index = np.full(seen.shape, -1, np.int32)
    index[seen] = inverse
    return flat[first], index


@struct.dataclass
class TransitionTable:
    """The K distinct transitions of a data set, as rows of indices into its distinct frames."""

    state: jax.Array  # (K,) int32
    observation: jax.Array  # (K,) int32
    action: jax.Array  # (K,) int32, or (K, size) float32
    reward: jax.Array  # (K,) float32
    next_state: jax.Array  # (K,) int32
    next_observation: jax.Array  # (K,) int32
    terminal: jax.Array  # (K,) bool
    ground_truth: jax.Array  # (K, V) float32

    @property
    def size(self) -> int:
        """K, the number of distinct transitions."""
        return self.reward.shape[0]


def tabulate(transitions: Transitions) -> tuple[TransitionTable, jax.Array]:
    """The distinct transitions, and (N,) int32 which of them each transition is."""
    columns = TransitionTable(**{f.name: getattr(transitions, f.name) for f in dataclasses.fields(TransitionTable)})
    table = [np.asarray(c, np.float64).reshape(transitions.size, -1) for c in jax.tree.leaves(columns)]
    _, first, inverse = np.unique(np.concatenate(table, axis=1), axis=0, return_index=True, return_inverse=True)
    return jax.tree.map(lambda c: c[first], columns), jnp.asarray(inverse.reshape(-1), jnp.int32)


def collect(
    env: Environment, key: jax.Array, num_episodes: int, source: DataSource = "random", moved: bool = False
) -> Transitions:
    """The transitions of `num_episodes` episodes of the random policy or of the environment's expert (Appendix C.1).

    Demonstrations are `moved`, if asked for, each by a symmetry of its own, as copies of them are in training.

    Raises:
        ConfigError: demonstrations are asked of an environment without an expert.
    """
    if source == "demonstrations":
        return demonstrated(env, key, num_episodes, moved)
    return random_transitions(env, key, num_episodes)


def demonstrated(env: Environment, key: jax.Array, num_episodes: int, moved: bool = False) -> Transitions:
    """The transitions of an expert's episodes. Every moment counts as distinct, and is kept beside its frames."""
    episodes: Demonstrations = jax.device_get(demonstrate(env, key, num_episodes))
    horizon = episodes.action.shape[1]
    row, step = np.nonzero(np.arange(horizon) < episodes.length[:, None])
    seen = np.arange(horizon + 1) <= episodes.length[:, None]
    index = np.cumsum(seen).reshape(seen.shape).astype(np.int32) - 1
    now, after = index[row, step], index[row, step + 1]
    moments = jax.tree.map(lambda leaf: jnp.asarray(leaf[seen]), episodes.env_state)
    actions = np.concatenate([episodes.action, np.zeros_like(episodes.action[:, :1])], axis=1)[seen]
    if moved:
        symmetries = jax.random.split(jax.random.fold_in(key, 1), num_episodes)[np.nonzero(seen)[0]]
        moments, actions = jax.jit(jax.vmap(env.augment))(symmetries, moments, jnp.asarray(actions))
    shown, truth, reveals = _look(env, moments)
    return Transitions(
        states=shown.state, observations=shown.observation, state=jnp.asarray(now), observation=jnp.asarray(now),
        action=jnp.asarray(actions[now]), reward=shown.reward[after], next_state=jnp.asarray(after),
        next_observation=jnp.asarray(after), terminal=shown.terminated[after], ground_truth=truth[now],
        reveals=reveals[now], episode=jnp.asarray(row, jnp.int32), key=jax.random.key_data(key), moments=moments)


@functools.partial(jax.jit, static_argnums=0)
def _look(env: Environment, moments: EnvState) -> tuple[TimeStep, jax.Array, jax.Array]:
    """What each of (S, ...) moments shows, its ground truth, and whether it reveals what is hidden."""
    look = lambda moment: (env.show(moment), env.ground_truth(moment), env.reveals(moment))  # noqa: E731
    return jax.lax.map(look, moments)

"""Copies of an episode in worlds that a symmetry of the task has moved (paper Appendix F), made when it is sampled.

The replay stores moments, some hundred bytes each; frames are rendered at sampling. Turning and rendering a moment of
Block-Pulling takes less time than turning its stored image (`envs_mjx.robot.task.RobotTask.augment`), and is exact.
"""

import dataclasses
from typing import Any, cast

import jax
import jax.numpy as jnp

from envs_mjx.base import Environment, EnvState, TimeStep
from mijax.types import Tokens


def shows_again(env: Environment) -> bool:
    """Whether the environment can show a moment again, so that moments can be stored in place of frames."""
    env_state, _ = jax.eval_shape(env.reset, jax.random.key(0))
    try:
        jax.eval_shape(env.show, env_state)
    except (NotImplementedError, TypeError):  # a user's method of that name may be another
        return False
    return True


def show_copy(
    env: Environment, symmetry: jax.Array, copy: jax.Array, env_state: EnvState, actions: Any
) -> tuple[TimeStep, Any]:
    """What one moment shows in one copy of its episode, and what actions are there.

    Args:
        env: shows moments again.
        symmetry: (2,) uint32, drawn once per episode; draws the symmetry of each of its copies.
        copy: () int32; copy 0 is the episode as it was.
        actions: a pytree of actions, (A,) each, such as the one that led to this moment.
    """
    key = jax.random.fold_in(jax.random.wrap_key_data(symmetry), copy)
    first, *rest = jax.tree.leaves(actions)
    there, first = env.augment(key, env_state, first)
    moved = there, [first, *(env.augment(key, env_state, action)[1] for action in rest)]
    here = env_state, jax.tree.leaves(actions)
    env_state, leaves = jax.tree.map(lambda a, b: jnp.where(copy == 0, a, b), here, moved)
    return env.show(env_state), jax.tree.unflatten(jax.tree.structure(actions), leaves)


def draw_copies(tokens: Tokens, copies: int, batch: int, key: jax.Array) -> jax.Array:
    """(R, L) int32: which copy of its episode each token shows, the same in all of an episode's, drawn uniformly."""
    drawn = jax.random.randint(key, (batch,), 0, copies + 1, jnp.int32)
    return drawn[jnp.maximum(tokens.segment - 1, 0)]


def take_copies(tokens: Tokens, copies: int, batch: int, key: jax.Array) -> Tokens:
    """Tokens of `batch` episodes, each in one of its copies, of a replay that stores what every copy shows.

    Args:
        tokens: their frames and states are features (R L, 1 + copies, D), actions and z_s (R, L, 1 + copies, ...).
        copies: besides the original.
    """
    copy = draw_copies(tokens, copies, batch, key)
    frames = _take(jnp.asarray(tokens.frames), copy.reshape(-1))
    states = None if tokens.states is None else _take(tokens.states, copy.reshape(-1))
    z_s = None if tokens.z_s is None else _take(tokens.z_s, copy)
    return dataclasses.replace(
        tokens, frames=frames, states=states, previous_action=_take(tokens.previous_action, copy), z_s=z_s,
        intended=None if tokens.intended is None else _take(tokens.intended, copy))


def _take(x: jax.Array, copy: jax.Array) -> jax.Array:
    """(*B, 1 + copies, D) -> (*B, D) in the copies (*B,)."""
    return jnp.take_along_axis(x, copy[..., None, None], axis=-2)[..., 0, :]


def show_tokens(env: Environment, tokens: Tokens, copies: int, batch: int, key: jax.Array, states: bool) -> Tokens:
    """Tokens of `batch` episodes with frames in place of moments; each episode in one of its copies, drawn uniformly.

    Args:
        tokens: their frames are moments, leaves (R L, ...); with `copies`, their z_s are (R, L, 1 + copies, F).
        copies: besides the original.
        states: whether the states are wanted too.
    """
    actions, z_s = (tokens.previous_action, tokens.intended), tokens.z_s
    if copies == 0:
        timestep = jax.vmap(env.show)(tokens.frames)
    else:
        copy = draw_copies(tokens, copies, batch, key)
        symmetry = cast(jax.Array, tokens.symmetry).reshape(-1, 2)
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), actions)
        timestep, moved = jax.vmap(lambda *moment: show_copy(env, *moment))(
            symmetry, copy.reshape(-1), tokens.frames, flat)
        actions = jax.tree.map(lambda x, like: x.reshape(like.shape), moved, actions)
        if z_s is not None:
            z_s = _take(z_s, copy)
    return dataclasses.replace(
        tokens, frames=timestep.observation, previous_action=actions[0], intended=actions[1], z_s=z_s,
        states=timestep.state if states else None, symmetry=None)

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


def draw_copies(copies: int, batch: int, key: jax.Array) -> jax.Array:
    """(batch,) int32: which copy of each episode is sampled, 0 the episode as it was, uniform."""
    return jax.random.randint(key, (batch,), 0, copies + 1, jnp.int32)


def show_tokens(env: Environment, tokens: Tokens, copy: jax.Array | None, states: bool) -> Tokens:
    """Tokens with frames in place of moments.

    Args:
        tokens: their frames are moments, leaves (R L, ...); with copies, their z_s are (R, L, 1 + copies, F).
        copy: (B,) int32, which copy is shown of the episode of each segment; None where there are none.
        states: whether the states are wanted too.
    """
    actions, z_s = (tokens.previous_action, tokens.intended), tokens.z_s
    if copy is None:
        timestep = jax.vmap(env.show)(tokens.frames)
    else:
        here = copy[jnp.maximum(tokens.segment - 1, 0)]
        symmetry = cast(jax.Array, tokens.symmetry).reshape(-1, 2)
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), actions)
        timestep, moved = jax.vmap(lambda *moment: show_copy(env, *moment))(
            symmetry, here.reshape(-1), tokens.frames, flat)
        actions = jax.tree.map(lambda x, like: x.reshape(like.shape), moved, actions)
        if z_s is not None:
            z_s = jnp.take_along_axis(z_s, here[..., None, None], axis=-2)[..., 0, :]
    return dataclasses.replace(
        tokens, frames=timestep.observation, previous_action=actions[0], intended=actions[1], z_s=z_s,
        states=timestep.state if states else None, symmetry=None)

"""Packing sampled episodes into rows, so that no update computes padding.

A trained Heaven-Hell episode fills 15 of 51 tokens. Episodes are laid one after the other in as few rows as a greedy
first fit of the longest needs; segments and positions keep them apart, so the result does not depend on the packing.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from mijax.frames import FrameTable
from mijax.replay import Replay, read_steps
from mijax.types import Tokens


@struct.dataclass
class Layout:
    """Where each of B episodes lies."""

    row: jax.Array  # (B,) int32
    offset: jax.Array  # (B,) int32, first token in its row
    num_rows: jax.Array  # () int32, rows in use


def first_fit(length: jax.Array, row_length: int) -> Layout:
    """First fit, longest first, of (B,) episodes into rows of `row_length` tokens; B rows always suffice."""
    num = length.shape[0]
    order = jnp.argsort(-length)

    def place(space: jax.Array, need: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        row = jnp.argmax(space >= need).astype(jnp.int32)
        offset = row_length - space[row]
        return space.at[row].add(-need), (row, offset)

    _, (row, offset) = jax.lax.scan(place, jnp.full((num,), row_length, jnp.int32), length[order])
    back = jnp.zeros((num,), jnp.int32).at[order].set(jnp.arange(num, dtype=jnp.int32))
    return Layout(row[back], offset[back], jnp.max(row) + 1)


def fit_folds(length: jax.Array, row_length: int) -> Layout:
    """`first_fit` of each half of (B,) episodes by itself: `row` counts within the half, `num_rows` is the larger."""
    halves = jax.vmap(first_fit, in_axes=(0, None))(length.reshape(2, -1), row_length)
    return Layout(halves.row.reshape(-1), halves.offset.reshape(-1), jnp.max(halves.num_rows))


def stack_folds(layout: Layout, rows: int) -> Layout:
    """Lay the second half of the episodes below `rows` rows of the first."""
    fold = jnp.arange(layout.row.shape[0], dtype=jnp.int32) * 2 // layout.row.shape[0]
    return dataclasses.replace(layout, row=layout.row + rows * fold)


def one_per_row(num: int) -> Layout:
    """Every episode in a row of its own: no packing."""
    return Layout(jnp.arange(num, dtype=jnp.int32), jnp.zeros((num,), jnp.int32), jnp.asarray(num, jnp.int32))


def row_choices(episodes: int) -> tuple[int, ...]:
    """The static numbers of rows that so many episodes may be packed into."""
    return tuple(sorted({-(-episodes * eighths // 8) for eighths in (3, 5, 8)}))


def gather_rows(
    replay: Replay, slots: jax.Array, layout: Layout, rows: int, observations: FrameTable | None,
    copy: jax.Array | None = None,
) -> Tokens:
    """Read (B,) episodes from the replay into `rows` packed rows; `observations` as for `Learner`.

    Segment b + 1 is episode b. Of a replay that stores what every copy of an episode shows, (B,) int32 `copy` says
    which of them is read.
    """
    row_length = replay.data.reward.shape[1]
    step = jnp.arange(row_length)[None]
    length = replay.length[slots]
    target = layout.row[:, None] * row_length + layout.offset[:, None] + step
    target = jnp.where(step < length[:, None], target, rows * row_length).reshape(-1)
    source = jnp.arange(slots.shape[0] * row_length, dtype=jnp.int32)
    source = jnp.full((rows * row_length,), -1, jnp.int32).at[target].set(source, mode="drop")
    used = source >= 0
    episode, position = jnp.maximum(source, 0) // row_length, jnp.maximum(source, 0) % row_length
    data = read_steps(replay, slots[episode], position, None if copy is None else copy[episode])

    def shaped(x: jax.Array) -> jax.Array:
        return x.reshape(rows, row_length, *x.shape[1:])

    return Tokens(
        frames=data.observation if observations is None else observations,
        frame=None if observations is None else shaped(data.observation.astype(jnp.int32)),
        previous_action=shaped(_actions(data.previous_action, used)),
        reward=shaped(data.reward),
        terminated=shaped(data.terminated),
        truncated=shaped(data.truncated),
        segment=shaped(jnp.where(used, episode + 1, 0)),
        position=shaped(jnp.where(used, position, 0)),
        z_s=None if data.z_s is None else shaped(data.z_s.astype(jnp.float32)),
        states=data.state,
        intended=None if data.intended is None else shaped(_actions(data.intended, used)),
        symmetry=None if data.symmetry is None else shaped(data.symmetry),
    )


def _actions(stored: jax.Array, used: jax.Array) -> jax.Array:
    """(N,) int32 with -1 where not used, or (N, A) float32 with 0 there."""
    if jnp.issubdtype(stored.dtype, jnp.integer):
        return jnp.where(used, stored.astype(jnp.int32), -1)
    return jnp.where(used[:, None], stored, 0)

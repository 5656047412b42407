"""Packing sampled episodes into rows, so that no update computes padding.

A trained Heaven-Hell episode fills 15 of 51 tokens. Episodes are laid one after the other in as few rows as a greedy
first fit of the longest needs; segments and positions keep them apart, so the result does not depend on the packing.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from mijax.replay import Replay
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


def gather_rows(replay: Replay, slots: jax.Array, layout: Layout, rows: int, max_frames: int | None) -> Tokens:
    """Read (B,) episodes from the replay into `rows` packed rows.

    With `max_frames`, an upper bound of the distinct observations among them, each distinct one appears once in
    `frames`.
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
    data = jax.tree.map(lambda x: x[slots[episode], position], replay.data)

    def shaped(x: jax.Array) -> jax.Array:
        return x.reshape(rows, row_length, *x.shape[1:])

    frames, frame = data.observation, None
    if max_frames is not None and max_frames < frames.shape[0]:
        frames, frame = distinct(frames, max_frames)
        frame = shaped(frame)
    return Tokens(
        frames=frames,
        frame=frame,
        previous_action=shaped(jnp.where(used, data.previous_action.astype(jnp.int32), -1)),
        reward=shaped(data.reward),
        terminated=shaped(data.terminated),
        truncated=shaped(data.truncated),
        segment=shaped(jnp.where(used, episode + 1, 0)),
        position=shaped(jnp.where(used, position, 0)),
        z_s=None if data.z_s is None else shaped(data.z_s.astype(jnp.float32)),
    )


def distinct(frames: jax.Array, capacity: int) -> tuple[jax.Array, jax.Array]:
    """(N, *shape) frames -> (capacity, *shape) the distinct ones, and (N,) int32 which of them each is.

    Frames are told apart by 64 bits of a random linear hash. `capacity` must bound the number of distinct frames.
    """
    num = frames.shape[0]
    flat = _as_bits(frames.reshape(num, -1))
    multipliers = jax.random.bits(jax.random.key(0), (2, flat.shape[1]), jnp.uint32) | 1
    high, low = (jnp.sum(flat * m, axis=1, dtype=jnp.uint32) for m in multipliers[:, None])
    high, low, order = jax.lax.sort((high, low, jnp.arange(num, dtype=jnp.int32)), num_keys=2)
    changed = jnp.concatenate([jnp.zeros((1,), bool), (high[1:] != high[:-1]) | (low[1:] != low[:-1])])
    rank = jnp.cumsum(changed, dtype=jnp.int32)
    index = jnp.zeros((num,), jnp.int32).at[order].set(rank)
    first = jnp.zeros((capacity,), jnp.int32).at[rank].set(order, mode="drop")
    return frames[first], index


def _as_bits(x: jax.Array) -> jax.Array:
    """uint32 that differ where the numbers of `x` do; 0.0 and -0.0 are one number.

    Short floats such as 1.0 and -0.5 differ in their highest bits alone, of which a linear hash keeps few: they are
    mixed downwards first.
    """
    if x.dtype.itemsize == 1:
        return x.astype(jnp.uint32)
    x = jnp.where(x == 0, jnp.zeros((), x.dtype), x)
    bits = jax.lax.bitcast_convert_type(x, jnp.dtype(f"uint{8 * x.dtype.itemsize}")).astype(jnp.uint32)
    bits = (bits ^ (bits >> 16)) * jnp.uint32(0x85EBCA6B)
    return bits ^ (bits >> 13)

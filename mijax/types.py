"""Named frozen pytrees that pass between the rooms of the library. A shape comment stands on every field.

Letters: E environments, R packed rows, L tokens per row, N frames, A actions, F features.
"""

import dataclasses
from typing import Any, cast

import jax
import jax.numpy as jnp
from flax import struct

Params = Any
"""A pytree of float32 parameters (Flax linen)."""
Metrics = dict[str, jax.Array]
"""Scalars by name."""


@struct.dataclass
class Representation:
    """What stage 1 hands to stage 2: the frozen encoders and the scale of z_s."""

    phi: Params  # state encoder, s -> z_s
    psi: Params  # observation encoder, o -> z_o
    z_s_mean: jax.Array  # (F,)  mean of z_s over the training set
    z_s_variance: jax.Array  # ()  Tr Var(z_s) over the training set: the unit of the bonus and of the auxiliary loss
    data_key: jax.Array  # (2,) uint32  data of the key that the episodes it was learnt from follow from

    def standardise(self, z_s: jax.Array) -> jax.Array:
        """(..., F) features -> (..., F) with mean 0 and, all divided by the same number, variances that add up to 1."""
        return (z_s - jnp.broadcast_to(self.z_s_mean, z_s.shape)) / jnp.sqrt(self.z_s_variance)

    def destandardise(self, z: jax.Array) -> jax.Array:
        """(..., F) network outputs of unit scale -> (..., F) predictions of z_s: no head has to learn its offset."""
        return jnp.broadcast_to(self.z_s_mean, z.shape) + jnp.sqrt(self.z_s_variance) * z


@struct.dataclass
class Tokens:
    """Packed sequences: each row holds one or more whole episodes, one after the other.

    Token t of an episode is what was known on arriving at step t: (a_{t-1}, o_t). Padding belongs to segment 0.
    """

    frames: Any  # (R L, *observation_shape) the observations, a FrameTable of all there are, or moments to be shown
    frame: jax.Array | None  # (R, L) int32, which of all observations a token shows; None when frames are the tokens'
    previous_action: jax.Array  # (R, L) int32, -1 on the first token of an episode; or (R, L, A) float32, there 0
    reward: jax.Array  # (R, L) float32, received on arriving
    terminated: jax.Array  # (R, L) bool, on arriving
    truncated: jax.Array  # (R, L) bool, on arriving
    segment: jax.Array  # (R, L) int32, which episode of the row, from 1; 0 is padding
    position: jax.Array  # (R, L) int32, step within the episode
    z_s: jax.Array | None  # (R, L, F) phi(s_t), or None when the agent does not use it
    states: jax.Array | None = None  # (R L, *state_shape) for asymmetric critics
    symmetry: jax.Array | None = None  # (R, L, 2) uint32, while frames are moments: see `mijax.augmentation`
    intended: jax.Array | None = None  # (R, L, A) what was meant in the place of the previous action; None: not wanted
    demonstrated: jax.Array | None = None  # (R, L) bool, whether an expert acted in the episode; None: not wanted
    succeeded: jax.Array | None = None  # (R, L) bool, whether it returns what an expert's does; None: not wanted

    def folds(self) -> "tuple[Tokens, Tokens]":
        """The two halves of the rows, without their states: of a batch of `sample_episodes`, its two folds."""
        rows, length = self.segment.shape
        halves = []
        for part in (slice(None, rows // 2), slice(rows // 2, None)):
            rest = dataclasses.replace(self, frames=None, frame=None, states=None)
            half = jax.tree.map(lambda x, part=part: x[part], rest)
            if isinstance(self.frames, jax.Array):
                own = self.frames.reshape(rows, length, *self.frames.shape[1:])[part]
                half = dataclasses.replace(half, frames=own.reshape(-1, *self.frames.shape[1:]))
            else:
                half = dataclasses.replace(half, frames=self.frames, frame=cast(jax.Array, self.frame)[part])
            halves.append(half)
        return halves[0], halves[1]

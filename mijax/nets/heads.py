"""Embedders of single tokens and multi-layer heads (paper Appendix A.7)."""

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp


def as_float(observation: jax.Array, dtype: jnp.dtype) -> jax.Array:
    """Stored observations (uint8 planes, float vectors) as numbers to compute with."""
    return observation.astype(dtype)


class MLP(nn.Module):
    """ReLU layers of `hidden` units, then a linear layer of `features`."""

    hidden: Sequence[int]
    features: int
    dtype: jnp.dtype = jnp.float32
    start_at_zero: bool = False  # the linear layer starts with zeros

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for width in self.hidden:
            x = nn.relu(nn.Dense(width, dtype=self.dtype)(x))
        last = nn.initializers.zeros if self.start_at_zero else nn.initializers.lecun_normal()
        return nn.Dense(self.features, kernel_init=last, dtype=self.dtype)(x)


class ObservationEmbedder(nn.Module):
    """(N, *observation_shape) -> (N, features): Linear + ReLU, after two small convolutions for images."""

    features: int
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        x = as_float(observation, self.dtype)
        if x.ndim == 4:
            for channels in (8, 16):
                x = nn.relu(nn.Conv(channels, (2, 2), padding="VALID", dtype=self.dtype)(x))
        return nn.relu(nn.Dense(self.features, dtype=self.dtype)(x.reshape(x.shape[0], -1)))


class ActionEmbedder(nn.Module):
    """(...) int32 actions, -1 for none -> (..., features)."""

    num_actions: int
    features: int
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, action: jax.Array) -> jax.Array:
        one_hot = jax.nn.one_hot(action, self.num_actions, dtype=self.dtype)
        return nn.relu(nn.Dense(self.features, dtype=self.dtype)(one_hot))

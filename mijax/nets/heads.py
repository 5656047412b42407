"""Embedders of single tokens and multi-layer heads (paper Appendix A.7)."""

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp

from mijax.frames import Frames, Patches, apply_layer
from mijax.nets.encoders import Convolution


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
    """N observations -> (N, features): Linear + ReLU, after two small convolutions for images."""

    features: int
    dtype: jnp.dtype = jnp.float32
    layers = ((2, 1), (2, 1))  # of images; not used on vectors

    @nn.compact
    def __call__(self, observation: Frames) -> jax.Array:
        x = observation
        if isinstance(x, Patches) or x.ndim == 4:
            for channels, (kernel, stride) in zip((8, 16), self.layers, strict=True):
                convolution = Convolution(channels, kernel, stride)
                x = apply_layer(lambda y, conv=convolution: nn.relu(conv(y.astype(self.dtype))), x)
        assert isinstance(x, jax.Array)
        return nn.relu(nn.Dense(self.features, dtype=self.dtype)(x.reshape(x.shape[0], -1).astype(self.dtype)))


class ActionEmbedder(nn.Module):
    """(...) int32 actions, -1 for none -> (..., features)."""

    num_actions: int
    features: int
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, action: jax.Array) -> jax.Array:
        one_hot = jax.nn.one_hot(action, self.num_actions, dtype=self.dtype)
        return nn.relu(nn.Dense(self.features, dtype=self.dtype)(one_hot))

"""Embedders of single tokens and multi-layer heads (paper Appendix A.7)."""

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp

from mijax.frames import Frames, Layers, Patches, apply_layer
from mijax.nets.encoders import STRIDED_IMAGE_MINIMUM, Convolution, image_plan


class MLP(nn.Module):
    """ReLU layers of `hidden` units, normalised first if `norm`, then a linear layer of `features`."""

    hidden: Sequence[int]
    features: int
    dtype: jnp.dtype = jnp.float32
    start_at_zero: bool = False  # the linear layer starts with zeros
    norm: bool = False

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for width in self.hidden:
            x = nn.Dense(width, dtype=self.dtype)(x)
            x = nn.relu(nn.LayerNorm(dtype=self.dtype)(x) if self.norm else x)
        last = nn.initializers.zeros if self.start_at_zero else nn.initializers.lecun_normal()
        return nn.Dense(self.features, kernel_init=last, dtype=self.dtype)(x)


class ObservationEmbedder(nn.Module):
    """N observations -> (N, features): Linear + ReLU, after two small convolutions for images.

    Images as large as the robots' go through the strided convolutions of Fig. 27 instead.
    """

    features: int
    dtype: jnp.dtype = jnp.float32

    @staticmethod
    def layers_on(shape: Sequence[int]) -> Layers:
        """What can work on patches of observations of this shape: nothing of vectors and large images."""
        if len(shape) != 3 or min(shape[:2]) >= STRIDED_IMAGE_MINIMUM:
            return ()
        kernel = 2 if min(shape[:2]) > 2 else 1
        return ((kernel, 1), (kernel, 1))

    @nn.compact
    def __call__(self, observation: Frames) -> jax.Array:
        x = observation
        if isinstance(x, jax.Array) and x.ndim == 4 and min(x.shape[1:3]) >= STRIDED_IMAGE_MINIMUM:
            for block in image_plan(min(x.shape[1:3])):
                x = nn.relu(Convolution(block.channels, block.kernel, block.stride)(x.astype(self.dtype)))
        elif isinstance(x, Patches) or x.ndim == 4:
            kernel = x.windows[0].shape[-1] if isinstance(x, Patches) else self.layers_on(x.shape[1:])[0][0]
            for channels in (8, 16):
                convolution = Convolution(channels, kernel, 1)
                x = apply_layer(lambda y, conv=convolution: nn.relu(conv(y.astype(self.dtype))), x)
        assert isinstance(x, jax.Array)
        return nn.relu(nn.Dense(self.features, dtype=self.dtype)(x.reshape(x.shape[0], -1).astype(self.dtype)))


def action_vector(action: jax.Array, num_actions: int, dtype: jnp.dtype) -> jax.Array:
    """What a network sees of an action: (N,) integers -> (N, A) one-hot, 0 for -1 (none); (N, A) floats as they are."""
    if jnp.issubdtype(action.dtype, jnp.integer):
        return jax.nn.one_hot(action, num_actions, dtype=dtype)
    return action.astype(dtype)


class ActionEmbedder(nn.Module):
    """(N,) integer or (N, A) float actions -> (N, features)."""

    num_actions: int
    features: int
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, action: jax.Array) -> jax.Array:
        seen = action_vector(action, self.num_actions, self.dtype)
        return nn.relu(nn.Dense(self.features, dtype=self.dtype)(seen))

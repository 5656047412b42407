"""Encoders of observations and states: an MLP for vectors, a small convolutional network for images.

`phi` and `psi` of stage 1 and the memoryless branch of the agents are these modules, chosen by shape, so that
parameters move from one to the other. `encoder.apply({"params": psi}, observation)` maps (..., *shape) to (..., F).
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from flax import linen as nn

from envs_mjx.base import ArraySpec

VECTOR_HIDDEN = (128, 128)
SMALL_IMAGE_CHANNELS = (64, 128, 256)
STRIDED_IMAGE_MINIMUM = 52
"""Rows from which the strided convolutions of the robot domains still leave a 3 x 3 map for the last layer."""


@dataclasses.dataclass(frozen=True)
class ConvBlock:
    """A convolution, ReLU and, if `pool` > 1, max-pooling."""

    channels: int
    kernel: int
    stride: int = 1
    pool: int = 1

    def output_size(self, size: int) -> int:
        """Rows after the block, from `size` rows before it."""
        return ((size - self.kernel) // self.stride + 1) // self.pool


class VectorEncoder(nn.Module):
    """(..., D) -> (..., features): an MLP (paper Fig. 26)."""

    hidden: tuple[int, ...]
    features: int

    def setup(self) -> None:
        self.blocks = [nn.Dense(width) for width in self.hidden]
        self.output = nn.Dense(self.features)

    def first_block(self, x: jax.Array) -> jax.Array:
        """(..., D) -> (..., hidden[0]): what the DIM discriminator shares (Fig. 28)."""
        return nn.relu(self.blocks[0](x.astype(jnp.float32)))

    def finish(self, h: jax.Array) -> jax.Array:
        """(..., hidden[0]) -> (..., features): all that follows the first block."""
        for block in self.blocks[1:]:
            h = nn.relu(block(h))
        return self.output(h)

    def __call__(self, x: jax.Array) -> jax.Array:
        return self.finish(self.first_block(x))


class ImageEncoder(nn.Module):
    """(..., rows, columns, channels) -> (..., features): convolutions (paper Figs. 24, 25, 27)."""

    plan: tuple[ConvBlock, ...]
    features: int

    def setup(self) -> None:
        self.blocks = [
            nn.Conv(b.channels, (b.kernel, b.kernel), (b.stride, b.stride), padding="VALID") for b in self.plan
        ]
        self.output = nn.Dense(self.features)

    def _block(self, index: int, x: jax.Array) -> jax.Array:
        pool = self.plan[index].pool
        x = nn.relu(self.blocks[index](x))
        return nn.max_pool(x, (pool, pool), (pool, pool)) if pool > 1 else x

    def first_block(self, x: jax.Array) -> jax.Array:
        """(..., rows, columns, channels) -> (..., rows', columns', channels'): what the discriminator shares."""
        return self._block(0, x.astype(jnp.float32))

    def finish(self, h: jax.Array) -> jax.Array:
        """(..., rows', columns', channels') -> (..., features): all that follows the first block."""
        for index in range(1, len(self.plan)):
            h = self._block(index, h)
        return self.output(h.reshape(*h.shape[:-3], -1))

    def __call__(self, x: jax.Array) -> jax.Array:
        return self.finish(self.first_block(x))


Encoder = VectorEncoder | ImageEncoder


def image_plan(size: int) -> tuple[ConvBlock, ...]:
    """The convolutions for images whose shorter side has `size` pixels.

    From 52 pixels on, the strided layers of the robot domains. Below, three 2 x 2 convolutions; max-pooling follows the
    second and then the first one, wherever the last convolution still has 2 x 2 pixels to see: 6 x 6 gives the paper's
    Sphinx network and 11 x 11 its CarFlag-2D network.
    """
    if size >= STRIDED_IMAGE_MINIMUM:
        return (ConvBlock(32, 8, 4), ConvBlock(64, 4, 4), ConvBlock(64, 3, 1))
    plans = [
        tuple(ConvBlock(c, kernel, 1, p) for c, p in zip(SMALL_IMAGE_CHANNELS, pools, strict=True))
        for kernel, pools in ((2, (2, 2, 1)), (2, (1, 2, 1)), (2, (1, 1, 1)), (1, (1, 1, 1)))
    ]
    return next(plan for plan in plans if _fits(plan, size))


def _fits(plan: Sequence[ConvBlock], size: int) -> bool:
    for block in plan:
        size = block.output_size(size)
    return size >= 1


def encoder_for(spec: ArraySpec, features: int) -> Encoder:
    """The encoder of arrays like `spec`: vectors (D,) or images (rows, columns, channels)."""
    if spec.is_image:
        return ImageEncoder(plan=image_plan(min(spec.shape[:2])), features=features)
    if len(spec.shape) == 1:
        return VectorEncoder(hidden=VECTOR_HIDDEN, features=features)
    raise ValueError(f"no encoder for arrays of shape {spec.shape}: vectors (D,) and images (rows, columns, channels)")

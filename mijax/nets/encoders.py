"""Encoders of observations and states: an MLP for vectors, a small convolutional network for images.

`phi` and `psi` of stage 1 and the memoryless branch of the agents are these modules, chosen by shape, so that
parameters move from one to the other. `encoder.apply({"params": psi}, observation)` maps (..., *shape) to (..., F).
"""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from flax import linen as nn

from envs_mjx.base import ArraySpec
from mijax.frames import Frames, Layers, apply_layer

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

    @property
    def layers(self) -> Layers:
        """Kernel and stride of the convolution and of the pooling."""
        return ((self.kernel, self.stride), *(((self.pool, self.pool),) if self.pool > 1 else ()))

    def output_size(self, size: int) -> int:
        """Rows after the block, from `size` rows before it."""
        return ((size - self.kernel) // self.stride + 1) // self.pool


class Convolution(nn.Module):
    """A convolution without padding, written as one matrix product: (..., rows, columns, C) -> (..., r, c, channels).

    XLA's own convolutions are many times slower on a CPU inside a scan (Sphinx: 5 against 50 updates/s, measured).
    `kernel` must be a multiple of `stride`: pixels are first gathered in blocks of stride x stride. Of `inputs`
    channels the last ones may be left out of `x`, where they are always 0: their weights are then not used.
    """

    channels: int
    kernel: int
    stride: int
    inputs: int | None = None  # C where None

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        stride, side, shown = self.stride, self.kernel // self.stride, x.shape[-1]
        weights = self.param(
            "kernel", nn.initializers.lecun_normal(), (self.kernel, self.kernel, self.inputs or shown, self.channels))
        bias = self.param("bias", nn.initializers.zeros_init(), (self.channels,))
        weights, bias = weights[..., :shown, :].astype(x.dtype), bias.astype(x.dtype)
        blocks = _gather_blocks(x, stride)
        rows, columns = blocks.shape[-3] - side + 1, blocks.shape[-2] - side + 1
        shifts = [blocks[..., i : i + rows, j : j + columns, :] for i in range(side) for j in range(side)]
        patches = jnp.concatenate(shifts, axis=-1) if len(shifts) > 1 else shifts[0]
        matrix = weights.reshape(side, stride, side, stride, -1, self.channels).transpose(0, 2, 1, 3, 4, 5)
        y = patches @ matrix.reshape(patches.shape[-1], self.channels)
        return y + bias.reshape((1,) * (y.ndim - 1) + (-1,))


def _gather_blocks(x: jax.Array, size: int) -> jax.Array:
    """(..., rows, columns, C) -> (..., rows // size, columns // size, size^2 C); what is left over is cut off."""
    if size == 1:
        return x
    *batch, rows, columns, channels = x.shape
    r, c = rows // size, columns // size
    x = x[..., : r * size, : c * size, :].reshape(*batch, r, size, c, size, channels)
    return jnp.moveaxis(x, -4, -3).reshape(*batch, r, c, size * size * channels)


def _max_pool(x: jax.Array, size: int) -> jax.Array:
    """The largest value in each block of size x size pixels; what is left over is cut off."""
    rows, columns = x.shape[-3] // size * size, x.shape[-2] // size * size
    shifts = [x[..., i:rows:size, j:columns:size, :] for i in range(size) for j in range(size)]
    return functools.reduce(jnp.maximum, shifts)


def about_mean(x: jax.Array, contrast: float) -> jax.Array:
    """(..., rows, columns, channels) pixels relative to the mean of the first channel, in units of `contrast`."""
    return (x - jnp.mean(x[..., :1], axis=(-3, -2, -1), keepdims=True)) / contrast


class VectorEncoder(nn.Module):
    """(..., D) -> (..., features): an MLP (paper Fig. 26)."""

    hidden: tuple[int, ...]
    features: int
    dtype: jnp.dtype = jnp.float32
    layers = ()  # none that sees a window

    def setup(self) -> None:
        self.blocks = [nn.Dense(width, dtype=self.dtype) for width in self.hidden]
        self.output = nn.Dense(self.features, dtype=self.dtype)

    def first_block(self, x: Frames) -> jax.Array:
        """(..., D) -> (..., hidden[0]): what the DIM discriminator shares (Fig. 28)."""
        assert isinstance(x, jax.Array)
        return nn.relu(self.blocks[0](x.astype(self.dtype)))

    def finish(self, h: jax.Array) -> jax.Array:
        """(..., hidden[0]) -> (..., features): all that follows the first block."""
        return self.output(self._rest(h))

    def body(self, x: Frames) -> jax.Array:
        """(..., D) -> (..., hidden[-1]): all but the output layer, for several outputs to share."""
        return self._rest(self.first_block(x))

    def _rest(self, h: jax.Array) -> jax.Array:
        for block in self.blocks[1:]:
            h = nn.relu(block(h))
        return h

    def __call__(self, x: Frames) -> jax.Array:
        return self.finish(self.first_block(x))


class ImageEncoder(nn.Module):
    """(..., rows, columns, channels) -> (..., features): convolutions (paper Figs. 24, 25, 27)."""

    plan: tuple[ConvBlock, ...]
    features: int
    dtype: jnp.dtype = jnp.float32
    channels: int | None = None  # of the images; of these the last may be left out where they are always 0
    contrast: float = 0.0  # see `ArraySpec`
    blank: int = 0  # last channels that are always 0: not looked at, as depths relative to a mean would fill them

    def setup(self) -> None:
        inputs = (self.channels, *(None for _ in self.plan[1:]))
        self.blocks = [
            Convolution(b.channels, b.kernel, b.stride, count) for b, count in zip(self.plan, inputs, strict=True)]
        self.output = nn.Dense(self.features, dtype=self.dtype)

    @property
    def layers(self) -> Layers:
        """What can work on patches: nothing for large images, whose patches hardly repeat."""
        return sum((block.layers for block in self.plan), ()) if self.plan[0].stride == 1 else ()

    def _block(self, index: int, x: Frames) -> Frames:
        pool = self.plan[index].pool
        x = apply_layer(lambda y: nn.relu(self.blocks[index](y.astype(self.dtype))), x)
        return apply_layer(lambda y: _max_pool(y, pool), x) if pool > 1 else x

    def first_block(self, x: Frames) -> Frames:
        """(..., rows, columns, channels) -> (..., rows', columns', channels'): what the discriminator shares."""
        if self.blank and isinstance(x, jax.Array) and x.shape[-1] == self.channels:
            x = x[..., : -self.blank]
        if self.contrast > 0:
            assert isinstance(x, jax.Array)
            x = about_mean(x, self.contrast)
        return self._block(0, x)

    def finish(self, h: Frames) -> jax.Array:
        """(..., rows', columns', channels') -> (..., features): all that follows the first block."""
        return self.output(self._rest(h))

    def body(self, x: Frames) -> jax.Array:
        """(..., rows, columns, channels) -> (..., D): all but the output layer, for several outputs to share."""
        return self._rest(self.first_block(x))

    def _rest(self, h: Frames) -> jax.Array:
        for index in range(1, len(self.plan)):
            h = self._block(index, h)
        assert isinstance(h, jax.Array)
        return h.reshape(*h.shape[:-3], -1)

    def __call__(self, x: Frames) -> jax.Array:
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


def encoder_for(spec: ArraySpec, features: int, dtype: jnp.dtype = jnp.float32) -> Encoder:
    """The encoder of arrays like `spec`: vectors (D,) or images (rows, columns, channels)."""
    if spec.is_image:
        return ImageEncoder(image_plan(min(spec.shape[:2])), features, dtype, spec.shape[2], spec.contrast, spec.blank)
    if len(spec.shape) == 1:
        return VectorEncoder(hidden=VECTOR_HIDDEN, features=features, dtype=dtype)
    raise ValueError(f"no encoder for arrays of shape {spec.shape}: vectors (D,) and images (rows, columns, channels)")

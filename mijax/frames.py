"""Observations that come back again and again: lists of all there are, and images taken apart into distinct patches.

The grid worlds show few observations, of nearly empty planes: CarFlag-2D has 1 120, and 500 of its states have 50 000
windows of 2 x 2 pixels, of 25 kinds. Encoding every observation once, and in it every kind of patch once, gives the
same features for a fraction of the work.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

Layers = tuple[tuple[int, int], ...]
"""(kernel, stride) of the layers that see a square window without padding, from the first one on."""
_HASH_ATTEMPTS = 100


@struct.dataclass
class Patches:
    """N images on their way through the first layers of a network."""

    values: jax.Array | np.ndarray  # (M, C)  what the layers so far made of each distinct patch; at first the pixels
    windows: tuple[np.ndarray, ...]  # per coming layer (M', k, k) int32: the patches that each of its outputs sees
    images: jax.Array | np.ndarray  # (N, rows, columns) int32: patches of the last of them, as they lie in each image

    def take(self, index: jax.Array) -> "Patches":
        """The images at (B,) `index`."""
        return Patches(self.values, self.windows, jnp.asarray(self.images)[index])

    def through(self, layer: Callable[[jax.Array], jax.Array]) -> "Patches | jax.Array":
        """After the next layer, a function (..., k, k, C) -> (..., 1, 1, C'). After the last one that works on patches,
        the images: (N, rows, columns, C').
        """
        values = layer(jnp.asarray(self.values)[self.windows[0]])[:, 0, 0]
        return Patches(values, self.windows[1:], self.images) if len(self.windows) > 1 else values[self.images]


Frames = jax.Array | Patches
"""(N, ...) observations or states, or N images taken apart."""


def apply_layer(layer: Callable[[jax.Array], jax.Array], x: Frames) -> Frames:
    """`layer` on images or on their patches."""
    return x.through(layer) if isinstance(x, Patches) else layer(x)


def take(frames: Frames, index: jax.Array) -> Frames:
    """The frames at (B,) `index`."""
    return frames.take(index) if isinstance(frames, Patches) else frames[index]


def keep_present(index: jax.Array, count: int, capacity: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Of `count` frames those that (B,) `index` names: () bool whether they are at most `capacity`; and if so,
    (capacity,) int32 which they are and (B,) int32 where among them each one of `index` is.
    """
    present = jnp.zeros(count, jnp.int32).at[index].set(1)
    slot = jnp.cumsum(present) - 1
    return slot[-1] < capacity, jnp.nonzero(present, size=capacity, fill_value=0)[0], slot[index]


def take_apart(images: np.ndarray, layers: Sequence[tuple[int, int]], batch: int) -> Patches | None:
    """Find the distinct patches of (N, rows, columns, C) images under `layers`.

    Stops before the first layer with more than half as many distinct patches as `batch` images have positions. None if
    that is the very first, and for vectors.
    """
    if not layers or images.ndim != 4:
        return None
    num, rows, columns, channels = images.shape
    values, flat = np.unique(images.reshape(-1, channels), axis=0, return_inverse=True)
    index: np.ndarray = flat.reshape(num, rows, columns).astype(np.int32)
    windows, first = [], np.arange(0)
    for kernel, stride in layers:
        seen = np.lib.stride_tricks.sliding_window_view(index, (kernel, kernel), axis=(1, 2))[:, ::stride, ::stride]
        name = np.zeros(seen.shape[:3], np.int64)
        for position in np.ndindex(kernel, kernel):  # names stay below (distinct windows) x (distinct patches)
            name = name * (index.max() + 1) + seen[..., *position]
            _, first, name = np.unique(name, return_index=True, return_inverse=True)
        if 2 * len(first) > batch * seen[0, ..., 0, 0].size:
            break
        windows.append(seen.reshape(-1, kernel, kernel)[first])
        index = name.reshape(seen.shape[:3]).astype(np.int32)
    return Patches(values, tuple(windows), index) if windows else None


@jax.tree_util.register_static
class FrameTable:
    """All observations of an environment, known when programs are traced; equal only to itself."""

    def __init__(self, frames: np.ndarray) -> None:
        """Args:
            frames: (D, *observation_shape), each observation once.

        Raises:
            ValueError: two of them are the same.
        """
        self.frames = frames
        flat = np.asarray(_as_bits(jnp.asarray(frames).reshape(len(frames), -1)))
        for attempt in range(_HASH_ATTEMPTS):
            multipliers = np.random.default_rng(attempt).integers(0, 2**32, flat.shape[1], np.uint32) | np.uint32(1)
            hashes = np.asarray((flat * multipliers).sum(axis=1, dtype=np.uint32))
            if len(np.unique(hashes)) == len(frames):
                self._multipliers, self._hashes = multipliers, hashes
                break
        else:
            raise ValueError("the listed observations are not all different")
        self._prepared: dict[Layers, Patches | np.ndarray] = {}

    def __len__(self) -> int:
        return len(self.frames)

    def index_of(self, observation: jax.Array) -> jax.Array:
        """(B, *observation_shape) listed observations -> (B,) int32, by a hash that is unique in the list."""
        flat = _as_bits(observation.reshape(observation.shape[0], -1))
        hashes = jnp.sum(flat * self._multipliers[None], axis=1, dtype=jnp.uint32)
        return jnp.argmax(hashes[:, None] == self._hashes[None], axis=1).astype(jnp.int32)

    def prepared(self, layers: Layers) -> Frames:
        """All frames, taken apart for an encoder that starts with `layers` where that saves work."""
        if layers not in self._prepared:
            patches = take_apart(self.frames, layers, len(self))
            self._prepared[layers] = self.frames if patches is None else patches
        ready = self._prepared[layers]
        return ready if isinstance(ready, Patches) else jnp.asarray(ready)


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

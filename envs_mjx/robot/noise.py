"""Perlin noise for depth images (paper Appendix E.2, after Perlin 2002), from a key."""

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.robot.depth import SIZE

AMPLITUDE = 0.007
"""Metres: the paper's magnitude."""
CELLS = (1, 2, 4, 6)
"""Grid cells per axis; one of them is drawn for each image."""
_CORNERS = max(CELLS) + 1


def perlin(key: jax.Array, amplitude: float = AMPLITUDE, shape: tuple[int, int] = (SIZE, SIZE)) -> jax.Array:
    """`shape` float32 within [-amplitude, amplitude]: one octave of gradient noise with a quintic fade, times sqrt 2.

    The four weighted corners of a pixel's cell are two products of matrices, since the weights of rows and columns are
    independent.
    """
    key_cells, key_gradients = jax.random.split(key)
    cells = jnp.asarray(CELLS, jnp.float32)[jax.random.randint(key_cells, (), 0, len(CELLS), jnp.int32)]
    angle = jax.random.uniform(key_gradients, (_CORNERS, _CORNERS), jnp.float32, 0.0, 2 * np.pi)
    (weight, slope), (weight_across, slope_across) = (_corner_weights(cells, size) for size in shape)
    rows = slope @ (amplitude * np.sqrt(2).astype(np.float32) * jnp.cos(angle)) @ weight_across.T
    columns = weight @ (amplitude * np.sqrt(2).astype(np.float32) * jnp.sin(angle)) @ slope_across.T
    return rows + columns


def _corner_weights(cells: jax.Array, size: int) -> tuple[jax.Array, jax.Array]:
    """Both (size, 7): how much each line of corners counts for each pixel, and that times the distance in cells."""
    position = (jnp.arange(size, dtype=jnp.float32) * (1 / size)) * cells
    distance = position[:, None] - jnp.arange(_CORNERS, dtype=jnp.float32)[None, :]
    t = jnp.maximum(1.0 - jnp.abs(distance), 0.0)
    weight = t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
    return weight, weight * distance

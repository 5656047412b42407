"""Rotation augmentation (paper Appendix F): images turned about the gripper, actions turned with them.

Turning by `angle` takes the world's x axis towards its y axis. Stage 1 turns each transition by an angle of its own,
the task's learner each copy of an episode by one angle.
"""

import jax
import jax.numpy as jnp
import numpy as np

EPISODE_COPIES = 4
"""Turned copies of every demonstration in the task's replay."""


def rotate_image(image: jax.Array, angle: jax.Array) -> jax.Array:
    """Turn an image (rows, columns, channels) about its middle by `angle` (); rows are along x, columns along y.

    Bilinear; a pixel from beyond the border takes the nearest value. Channels that turn by the same angle (an
    observation and its state, one step and the next) are cheapest turned in one image.
    """
    rows, columns, channels = image.shape
    row = jnp.arange(rows, dtype=jnp.float32)[:, None] - (rows - 1) / 2
    column = jnp.arange(columns, dtype=jnp.float32)[None, :] - (columns - 1) / 2
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    source_row = jnp.clip(cos * row + sin * column + (rows - 1) / 2, 0.0, rows - 1.0)
    source_column = jnp.clip(cos * column - sin * row + (columns - 1) / 2, 0.0, columns - 1.0)
    top, left = (jnp.minimum(jnp.floor(x).astype(jnp.int32), size - 2)
                 for x, size in ((source_row, rows), (source_column, columns)))
    down, right = source_row - top.astype(jnp.float32), source_column - left.astype(jnp.float32)
    flat, corner = image.reshape(rows * columns, channels), top * columns + left

    def weighed(offset: int, weight: jax.Array) -> jax.Array:
        return flat[corner + offset] * weight[..., None]

    return (weighed(0, (1 - down) * (1 - right)) + weighed(1, (1 - down) * right)
            + weighed(columns, down * (1 - right)) + weighed(columns + 1, down * right))


def rotate_action(action: jax.Array, angle: jax.Array) -> jax.Array:
    """Turn (dx, dy) of an action (4,) by `angle` () and clip them to [-1, 1]; dz and the gripper's turn stay."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    dx, dy = cos * action[0] - sin * action[1], sin * action[0] + cos * action[1]
    return jnp.concatenate([jnp.clip(jnp.stack([dx, dy]), -1.0, 1.0), action[2:]])


def random_angle(key: jax.Array) -> jax.Array:
    """() uniform in [0, 2 pi)."""
    return jax.random.uniform(key, (), jnp.float32, 0.0, 2 * np.pi)

"""The orthographic top-down depth image, exactly: analytic heights of upright boxes, a tray and horizontal capsules.

The image is 84 x 84, its window 0.4 x 0.4 m. Rows run along world x, columns along world y, whatever the gripper's yaw.
The gripper stands at the point where pixels 41 and 42 meet, so that turning an image about its middle turns the scene
about the gripper. Lengths are in metres, angles in radians.
"""

import jax
import jax.numpy as jnp
import numpy as np

SIZE = 84
WINDOW = 0.4
PIXEL = WINDOW / SIZE
CAMERA_ABOVE_GRIPPER = 0.06
NOTHING = -1.0
"""Height of what is not there: below everything that is."""
_FINGER_HALF = 3.0  # pixels
_OFFSETS = (np.arange(SIZE, dtype=np.float32) - np.float32(SIZE / 2 - 0.5))  # pixels from the middle


def local_frame(gripper_xy: jax.Array, pose: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Where the pixels of an image around `gripper_xy` (2,) lie in the frame of a body at `pose` (3,): x, y, yaw.

    Returns:
        u, v: both (84, 84), coordinates along the body's own x and y axes.
    """
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
    x = (_OFFSETS * np.float32(PIXEL))[:, None] + (gripper_xy[0] - pose[0])
    y = (_OFFSETS * np.float32(PIXEL))[None, :] + (gripper_xy[1] - pose[1])
    return cos * x + sin * y, cos * y - sin * x


def box(u: jax.Array, v: jax.Array, half_u: float, half_v: float, top: float) -> jax.Array:
    """(84, 84) height of an upright box about the origin of (u, v), its top at `top`."""
    return jnp.where((jnp.abs(u) <= half_u) & (jnp.abs(v) <= half_v), top, NOTHING)


def tray(u: jax.Array, v: jax.Array, half: float, wall: float, top: float, floor: float) -> jax.Array:
    """(84, 84) height of an open square tray about the origin of (u, v): walls of thickness `wall` up to `top`."""
    outside = jnp.maximum(jnp.abs(u), jnp.abs(v))
    return jnp.where(outside <= half, jnp.where(outside > half - wall, top, floor), NOTHING)


def capsule(along: jax.Array, across: jax.Array, half_length: float, radius: float, axis_height: float) -> jax.Array:
    """(84, 84) height of a lying capsule about the origin; `half_length` is that of its axis, without the caps."""
    beyond = jnp.maximum(jnp.abs(along) - half_length, 0.0)
    rise = radius * radius - across * across - beyond * beyond
    return jnp.where(rise >= 0, axis_height + jnp.sqrt(jnp.maximum(rise, 0.0)), NOTHING)


def fingers(yaw: jax.Array, offset: float) -> jax.Array:
    """(84, 84) bool: two squares of 6 x 6 pixels, `offset` pixels from the middle to both sides along the yaw ()."""
    def beside(centre: jax.Array) -> jax.Array:
        distance = jnp.asarray(_OFFSETS) - centre
        return (distance > -_FINGER_HALF) & (distance <= _FINGER_HALF)

    row, column = offset * jnp.cos(yaw), offset * jnp.sin(yaw)
    return (beside(row)[:, None] & beside(column)[None, :]) | (beside(-row)[:, None] & beside(-column)[None, :])


def depth(height: jax.Array, gripper_z: jax.Array, painted: jax.Array) -> jax.Array:
    """(84, 84) metres below a camera 6 cm above the gripper, at least 0; 0 where a finger is `painted` (84, 84)."""
    return jnp.where(painted, 0.0, jnp.maximum(gripper_z + CAMERA_ABOVE_GRIPPER - height, 0.0))

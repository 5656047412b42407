"""The orthographic top-down depth image, exactly: analytic heights of upright boxes, a tray and horizontal capsules.

`envs_mjx.robot.window` tells what an image shows. The gripper stands in its middle, so that turning an image turns the
scene about the gripper. Lengths are in metres, angles in radians.
"""

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.robot.window import CAMERA_ABOVE_GRIPPER, NOTHING, OFFSETS, PIXEL, SIZE, WINDOW, depth, fingers

__all__ = ["CAMERA_ABOVE_GRIPPER", "NOTHING", "PIXEL", "SIZE", "WINDOW", "box", "capsule", "depth", "fingers",
           "local_frame", "tray"]


def local_frame(gripper_xy: jax.Array, pose: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Where the pixels of an image around `gripper_xy` (2,) lie in the frame of a body at `pose` (3,): x, y, yaw.

    Returns:
        u, v: both (84, 84), coordinates along the body's own x and y axes.
    """
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
    x = (OFFSETS * np.float32(PIXEL))[:, None] + (gripper_xy[0] - pose[0])
    y = (OFFSETS * np.float32(PIXEL))[None, :] + (gripper_xy[1] - pose[1])
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

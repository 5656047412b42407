"""Rotation augmentation (paper Appendix F): places, vectors, poses and actions turned by an angle, or mirrored.

Turning by `angle` takes the world's x axis towards its y axis; mirroring changes y and yaw (not in
the paper). `RobotTask.augment` moves a whole scene and renders it again; no image is turned.
"""

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.robot import scene


def random_angle(key: jax.Array) -> jax.Array:
    """() uniform in [0, 2 pi)."""
    return jax.random.uniform(key, (), jnp.float32, 0.0, 2 * np.pi)


def rotate_action(action: jax.Array, angle: jax.Array) -> jax.Array:
    """Turn (dx, dy) of an action (4,) by `angle` (); dz and the gripper's turn stay.

    Not clipped to [-1, 1], as the original does: (1, 1) turned is up to 1.41 long, as is the way in the turned scene.
    """
    return jnp.concatenate([turn_vectors(action[:2], angle), action[2:]])


def mirror_action(action: jax.Array) -> jax.Array:
    """An action (4,) with dy and the gripper's turn the other way."""
    return action * jnp.array([1.0, -1.0, 1.0, -1.0])


def mirror_poses(poses: jax.Array) -> jax.Array:
    """(..., 3) x, y, yaw mirrored in the plane of the workspace's middle y."""
    return poses.at[..., 1].set(2 * scene.CENTRE[1] - poses[..., 1]).at[..., 2].multiply(-1)


def turn_poses(poses: jax.Array, angle: jax.Array) -> jax.Array:
    """(..., 3) x, y, yaw turned by `angle` () about the middle of the workspace."""
    return jnp.concatenate([turn_places(poses[..., :2], angle), poses[..., 2:] + angle], axis=-1)


def turn_places(places: jax.Array, angle: jax.Array) -> jax.Array:
    """(..., 2) x, y turned by `angle` () about the middle of the workspace."""
    centre = jnp.broadcast_to(jnp.asarray(scene.CENTRE), places.shape)
    return turn_vectors(places - centre, angle) + centre


def turn_vectors(vectors: jax.Array, angle: jax.Array) -> jax.Array:
    """(..., 2) x, y turned by `angle` ()."""
    cos, sin, x, y = jnp.cos(angle), jnp.sin(angle), vectors[..., 0], vectors[..., 1]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)

"""The window that a policy looks through: what the images of training and those of a robot's cameras share.

An image is 84 x 84 pixels of depth in metres, seen from 6 cm above the gripper, straight down and without perspective.
Its window is 0.4 x 0.4 m, rows along world x, columns along world y, whatever the gripper's yaw. The gripper stands
where pixels 41 and 42 meet. This module needs NumPy only, and its functions take arrays of NumPy or of JAX alike.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

Array = Any
"""Of NumPy or of JAX: what comes in goes out."""

SIZE = 84
WINDOW = 0.4
PIXEL = WINDOW / SIZE
CAMERA_ABOVE_GRIPPER = 0.06
HIGHEST = 0.25
"""Of the gripper in its workspace, above the table."""
DEEPEST = HIGHEST + CAMERA_ABOVE_GRIPPER
"""The depth of the table at the gripper's highest. A policy is to see no more than that, give or take three times the
paper's noise."""
NOTHING = -1.0
"""Height of what is not there: below everything that is."""
PAD_SIDE, PAD_DEPTH = 0.09, 0.02
"""Block-Pushing's goal pad, and how much deeper than the table it is shown."""
FINGER_RADIUS = 0.0125
FINGER_BELOW = 0.005
"""The end effector is this far above the fingers' lowest points."""
OFFSETS = np.arange(SIZE, dtype=np.float32) - np.float32(SIZE / 2 - 0.5)
"""(84,) pixels from the middle of the image to the middle of each row or column."""
_FINGER_HALF = 3.0  # pixels


@dataclasses.dataclass(frozen=True)
class Opening:
    """How far the gripper is open, for a whole task."""

    finger: float
    """Metres from the middle to the centre of each finger."""
    painted: float
    """Pixels from the middle to each painted finger."""


OPEN = Opening(0.052, 29.0)
HALF_OPEN = Opening(0.036, 14.0)
CLOSED = Opening(0.0075, 0.0)
"""40 mm over both fingers, of the 60 that a handle's side bars leave; the original's bar of 80 mm would sit on them. At
0.015 an agent ended half of its episodes in the other world by a protective stop (one seed, results/robots)."""


class Outfit(NamedTuple):
    """What a task's images show beside its objects."""

    opening: Opening
    has_pad: bool
    """Whether there is a goal pad."""


TASKS = {"block_pulling": Outfit(OPEN, has_pad=False), "block_pushing": Outfit(HALF_OPEN, has_pad=True),
         "drawer_opening": Outfit(CLOSED, has_pad=False)}


def namespace(*arrays: Array) -> Any:
    """`jax.numpy` when one of the arrays is JAX's, else `numpy`."""
    for array in arrays:
        if not isinstance(array, np.ndarray | np.generic | float | int):
            return array.__array_namespace__()
    return np


def fingers(yaw: Array, offset: float) -> Array:
    """(84, 84) bool: two squares of 6 x 6 pixels, `offset` pixels from the middle to both sides along the yaw ()."""
    xp = namespace(yaw)

    def beside(centre: Array) -> Array:
        distance = xp.asarray(OFFSETS) - centre
        return (distance > -_FINGER_HALF) & (distance <= _FINGER_HALF)

    row, column = offset * xp.cos(yaw), offset * xp.sin(yaw)
    return (beside(row)[:, None] & beside(column)[None, :]) | (beside(-row)[:, None] & beside(-column)[None, :])


def depth(height: Array, gripper_z: Array, painted: Array) -> Array:
    """(84, 84) metres below a camera 6 cm above the gripper, at least 0; 0 where a finger is `painted` (84, 84)."""
    xp = namespace(height, gripper_z)
    return xp.where(painted, 0.0, xp.maximum(gripper_z + CAMERA_ABOVE_GRIPPER - height, 0.0))


def grey(depth: np.ndarray) -> np.ndarray:
    """Metres as uint8 of the same shape, for people: near is bright, `DEEPEST` black."""
    return np.round(255 * (1 - np.clip(depth / DEEPEST, 0, 1))).astype(np.uint8)

"""From depth cameras to what a policy sees (paper Section 6, Appendix E.1, Figs. 33 and 34).

Each camera's depth image becomes a cloud of points in the robot's frame; the clouds are put together, the gripper's own
points are taken out, the highest point over each place is kept, places that no camera saw are filled from beside, and
the fingers are painted as in training.

    seen = cloud(cameras, images)                       # points of all cameras
    observation = observe(seen, gripper, OPEN)          # (84, 84, 2)

Everything here is a pure function of arrays of NumPy or of JAX: with JAX, `jax.vmap` makes batches and `jax.jit`
compiles; a robot's computer needs NumPy only. Lengths are in metres, angles in radians.

A camera's own axes are those of OpenCV and of the cameras' drivers: x to the right of the image, y down, z forth. Whole
numbers are the middles of pixels. Depth is measured along z; 0 means that nothing was measured.
"""

from typing import NamedTuple

import numpy as np

from envs_mjx.robot import window
from envs_mjx.robot.window import Array, namespace

FINE = 5
"""Cells of the height map per pixel and axis: an image of training shows the middle of a pixel, and so does the middle
one of an odd number of cells. Depth within 5 mm of training's on opened drawers, three exact cameras of 640 x 480:
97.4 % of the pixels with 1, which makes objects grow by half a pixel, 98.8 % with 3, 99.1 % with 5, 99.0 % with 7."""
_MARGIN = 0.004  # m, around the fingers: what cameras and their calibration are off by
_TABLE = 0.01  # m: what is lower, where the goal pad lies, is the pad


class Cameras(NamedTuple):
    """C calibrated pinhole cameras of one size of image."""

    intrinsics: Array  # (C, 4) focal lengths fx, fy and principal point cx, cy, in pixels
    pose: Array  # (C, 4, 4) from the camera's frame to the robot's


class Cloud(NamedTuple):
    """N points in the robot's frame; those that were not measured keep their place in the arrays."""

    points: Array  # (N, 3) m
    measured: Array  # (N,) bool


def cloud(cameras: Cameras, images: Array) -> Cloud:
    """The points of all cameras together.

    Args:
        cameras: C of them.
        images: (C, rows, columns) depth in metres; 0 or not finite: nothing was measured.

    Raises:
        ValueError: unless the shapes fit each other.
    """
    number, rows, columns = _check(cameras, images)
    xp = namespace(images, cameras.pose)
    fx, fy, cx, cy = (cameras.intrinsics[:, i, None, None] for i in range(4))
    x = (xp.arange(columns, dtype=images.dtype)[None, None, :] - cx) / fx
    y = (xp.arange(rows, dtype=images.dtype)[None, :, None] - cy) / fy
    measured = xp.isfinite(images) & (images > 0)
    z = xp.where(measured, images, 0.0)
    shape = (number, rows, columns)
    own = xp.stack([xp.broadcast_to(x, shape) * z, xp.broadcast_to(y, shape) * z, z], axis=-1)
    points = own.reshape(number, -1, 3) @ xp.swapaxes(cameras.pose[:, :3, :3], 1, 2) + cameras.pose[:, None, :3, 3]
    return Cloud(points.reshape(-1, 3), measured.reshape(-1))


def fuse(*clouds: Cloud) -> Cloud:
    """One cloud of several: of cameras whose images differ in size, or of clouds that were recorded."""
    xp = namespace(*(one.points for one in clouds))
    return Cloud(xp.concatenate([one.points for one in clouds]), xp.concatenate([one.measured for one in clouds]))


def without_gripper(seen: Cloud, gripper: Array, opening: window.Opening) -> Cloud:
    """The cloud without the points that belong to the gripper: above the virtual camera, and around both fingers.

    Args:
        seen: N points.
        gripper: (4,) x, y, z, yaw.
        opening: how far it is open.
    """
    xp = namespace(seen.points, gripper)
    x, y = seen.points[:, 0] - gripper[0], seen.points[:, 1] - gripper[1]
    above = seen.points[:, 2] - gripper[2]
    cos, sin = xp.cos(gripper[3]), xp.sin(gripper[3])
    beside, across = xp.abs(cos * x + sin * y) - opening.finger, cos * y - sin * x
    reach = window.FINGER_RADIUS + _MARGIN
    finger = (beside * beside + across * across < reach * reach) & (above > -window.FINGER_BELOW - _MARGIN)
    return Cloud(seen.points, seen.measured & ~finger & (above < window.CAMERA_ABOVE_GRIPPER))


def height_map(seen: Cloud, gripper_xy: Array) -> Array:
    """(84, 84) height of the highest point at the middle of each pixel around `gripper_xy` (2,).

    The cells are closed before they are filled: see `close` and `fill`.
    """
    xp = namespace(seen.points, gripper_xy)
    side = window.SIZE * FINE
    place = xp.floor((seen.points[:, :2] - gripper_xy[None, :]) / (window.PIXEL / FINE)).astype(np.int32) + side // 2
    inside = seen.measured & ((place >= 0) & (place < side)).all(axis=1)
    cell = xp.where(inside, place[:, 0] * side + place[:, 1], side * side)  # one more, for what is not in the window
    height = xp.where(inside, seen.points[:, 2], window.NOTHING)
    cells = xp.full((side * side + 1,), window.NOTHING, seen.points.dtype)
    if xp is np:
        np.maximum.at(cells, cell, height)
    else:
        cells = cells.at[cell].max(height)
    closed = close(cells[:-1].reshape(side, side))
    return fill(closed)[FINE // 2 :: FINE, FINE // 2 :: FINE]


def close(height: Array) -> Array:
    """`height` (rows, columns), pits of one or two cells raised to what is around them; edges stay where they are.

    Pixels of cameras fall thinly on a slanted surface, and what lies below shines through: under a handle's bar, say.
    """
    xp = namespace(height)
    for extreme in (xp.maximum, xp.minimum):
        for axis in (0, 1):
            padded = xp.pad(height, [(1, 1) if axis == i else (0, 0) for i in (0, 1)], mode="edge")
            before, after = (padded[:-2], padded[2:]) if axis == 0 else (padded[:, :-2], padded[:, 2:])
            height = extreme(extreme(before, height), after)
    return height


def fill(height: Array) -> Array:
    """`height` (rows, columns), its cells without a value (`NOTHING`) filled from the nearest ones along the axes.

    Of the four, the nearest counts, and of equally near ones the lower: what is hidden lies behind something high.
    Where neither row nor column has a value the table is taken to be, at 0.
    """
    xp = namespace(height)
    best, nearest = xp.zeros_like(height), xp.full(height.shape, np.inf, height.dtype)
    for axis in (0, 1):
        for forth in (True, False):
            value, distance = _last_value(height, axis, forth)
            better = (distance < nearest) | ((distance == nearest) & (value < best))
            best, nearest = xp.where(better, value, best), xp.where(better, distance, nearest)
    return best


def _last_value(height: Array, axis: int, forth: bool) -> tuple[Array, Array]:
    """The last value on the way along an axis up to each cell, and how many cells back it is; infinity: there is none.
    """
    xp = namespace(height)
    along = height if axis == 0 else height.T
    along = along if forth else along[::-1]
    index = xp.arange(along.shape[0], dtype=np.int32)[:, None]
    last = _running_maximum(xp.where(along > window.NOTHING, index, -1))
    value = xp.where(last >= 0, xp.take_along_axis(along, xp.maximum(last, 0), axis=0), np.inf)
    distance = xp.where(last >= 0, (index - last).astype(height.dtype), np.inf)
    value, distance = (x if forth else x[::-1] for x in (value, distance))
    return (value, distance) if axis == 0 else (value.T, distance.T)


def _running_maximum(index: Array) -> Array:
    """Along axis 0."""
    if isinstance(index, np.ndarray):
        return np.maximum.accumulate(index, axis=0)
    from jax import lax

    return lax.cummax(index, axis=0)


def paint_pad(height: Array, gripper_xy: Array, pad: Array) -> Array:
    """`height` (84, 84) with the goal pad as training shows it, 2 cm deeper than the table.

    A pad that is only painted on the table is in no depth image, so that where it lies, `pad` (2,), has to be told.
    What stands on it stays as it was seen.
    """
    xp = namespace(height, gripper_xy, pad)
    x = xp.asarray(window.OFFSETS) * np.float32(window.PIXEL) + (gripper_xy[0] - pad[0])
    y = xp.asarray(window.OFFSETS) * np.float32(window.PIXEL) + (gripper_xy[1] - pad[1])
    half = window.PAD_SIDE / 2
    inside = (xp.abs(x) <= half)[:, None] & (xp.abs(y) <= half)[None, :]
    return xp.where(inside & (height < _TABLE), height - window.PAD_DEPTH, height)


def observe(seen: Cloud, gripper: Array, opening: window.Opening, pad: Array | None = None) -> Array:
    """(84, 84, 2) float32: the observation of training, from a cloud. Depth in metres, and zeros.

    Args:
        seen: of all cameras.
        gripper: (4,) x, y, z, yaw of the end effector in the robot's frame.
        opening: how far the task's gripper is open: `window.OPEN`, `HALF_OPEN` or `CLOSED`.
        pad: (2,) x, y of the goal pad's middle, in Block-Pushing.
    """
    xp = namespace(seen.points, gripper)
    height = height_map(without_gripper(seen, gripper, opening), gripper[:2])
    if pad is not None:
        height = paint_pad(height, gripper[:2], pad)
    below = window.depth(height, gripper[2], window.fingers(gripper[3], opening.painted)).astype(np.float32)
    return xp.stack([below, xp.zeros_like(below)], axis=-1)


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(4, 4) pose of a camera at `eye` (3,) that looks at `target` (3,), its x axis level. Not straight down."""
    forth = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forth, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forth, right), forth, eye], axis=1)
    return pose


def _check(cameras: Cameras, images: Array) -> tuple[int, int, int]:
    if images.ndim != 3:
        raise ValueError(f"images of shape {images.shape}: expected (cameras, rows, columns)")
    number = images.shape[0]
    for name, array, shape in (("intrinsics", cameras.intrinsics, (number, 4)), ("pose", cameras.pose, (number, 4, 4))):
        if array.shape != shape:
            raise ValueError(f"{name} of shape {array.shape}: expected {shape}, for {number} images")
    return images.shape

"""Three depth cameras around the table of the other world, and what real ones do to a depth image."""

import functools

import jax
import mujoco
import numpy as np

from envs_mjx.robot import noise, scene, tabletop
from envs_mjx.robot.cameras import Cameras, look_at
from envs_mjx.robot.gap import Gap

_BASELINE = 0.095
"""Metres between the two lenses of a RealSense D455, the paper's side cameras."""
_EDGE = 0.02
"""Metres between neighbouring pixels that make an edge."""
_HOLES = 0.7
"""Share of the pixels near an edge that are not measured."""


def calibration() -> Cameras:
    """The three cameras, exactly, float32."""
    rows, columns = tabletop.ROWS, tabletop.COLUMNS
    focal = rows / 2 / np.tan(np.deg2rad(tabletop.FOV) / 2)
    intrinsics = np.array([focal, focal, (columns - 1) / 2, (rows - 1) / 2], np.float32)
    poses = [look_at(np.array(eye), np.array([*scene.CENTRE, 0.0])) for eye in tabletop.EYES.values()]
    return Cameras(np.tile(intrinsics, (len(poses), 1)), np.stack(poses).astype(np.float32))


def miscalibrated(cameras: Cameras, gap: Gap, generator: np.random.Generator) -> Cameras:
    """The poses that a calibration finds: each off by a random shift and a random small turn."""
    poses = cameras.pose.astype(np.float64)
    for pose in poses:
        pose[:3, 3] += generator.normal(0, gap.camera_shift, 3)
        x, y, z = generator.normal(0, gap.camera_turn, 3)
        pose[:3, :3] = (np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])) @ pose[:3, :3]
    return Cameras(cameras.intrinsics, poses.astype(np.float32))


def degraded(depth: np.ndarray, focal: float, gap: Gap, key: jax.Array) -> np.ndarray:
    """What cameras would have measured of exact images.

    Smooth Perlin noise; stereo disparity in steps of `gap.disparity` pixels, coarser with the square of the distance;
    and holes of `gap.edge_holes` pixels along edges, where one of the two lenses sees something else.

    Args:
        depth: (C, rows, columns) in metres.
        focal: length in pixels.
        gap: how much of everything.
        key: draws the noise and the holes.
    """
    found = depth
    if gap.perlin:
        found = found + np.stack([np.asarray(_perlin(one, depth.shape[1:])) for one in jax.random.split(key, len(depth))
                                  ]) * np.float32(gap.perlin)
    if gap.disparity:
        unit = np.float32(focal * _BASELINE / gap.disparity)
        found = unit / np.round(unit / found)
    if gap.edge_holes:
        near = _near_edges(depth, gap.edge_holes)
        generator = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        found = np.where(near & (generator.random(depth.shape) < _HOLES), np.float32(0), found)
    return found.astype(np.float32)


@functools.partial(jax.jit, static_argnums=1)
def _perlin(key: jax.Array, shape: tuple[int, int]) -> jax.Array:
    return noise.perlin(key, 1.0, shape)


def _near_edges(depth: np.ndarray, pixels: int) -> np.ndarray:
    """(C, rows, columns) bool: within `pixels` pixels, along the axes, of an edge."""
    near = np.zeros(depth.shape, bool)
    for axis in (1, 2):
        edge = np.abs(np.diff(depth, axis=axis)) > _EDGE
        before, after = [(0, 0)] * 3, [(0, 0)] * 3
        before[axis], after[axis] = (1, 0), (0, 1)
        near |= np.pad(edge, before) | np.pad(edge, after)
    for _ in range(pixels - 1):
        for axis in (1, 2):
            near = near | np.roll(near, 1, axis) | np.roll(near, -1, axis)
    return near


class Rig:
    """The cameras' renderer. Close it when done: it holds OpenGL contexts."""

    def __init__(self, model: mujoco.MjModel, picture_size: int) -> None:  # pyright: ignore
        """Args: model: of `tabletop.build`; picture_size: pixels of `picture`'s sides."""
        self._depth = mujoco.Renderer(model, tabletop.ROWS, tabletop.COLUMNS)
        self._depth.enable_depth_rendering()
        self._colour = mujoco.Renderer(model, picture_size, picture_size)
        self._options = mujoco.MjvOption()  # pyright: ignore[reportAttributeAccessIssue]
        self._without = mujoco.MjvOption()  # pyright: ignore[reportAttributeAccessIssue]
        self._without.geomgroup[tabletop.GRIPPER_GROUP] = 0

    def close(self) -> None:
        """Free the OpenGL contexts."""
        self._depth.close()
        self._colour.close()

    def images(self, data: mujoco.MjData, gripper: bool = True) -> np.ndarray:  # pyright: ignore
        """(3, rows, columns) exact depth in metres, of the cameras in their order; `gripper` False leaves it out."""
        images = []
        for name in tabletop.EYES:
            self._depth.update_scene(data, name, self._options if gripper else self._without)
            images.append(self._depth.render())
        return np.stack(images)

    def picture(self, data: mujoco.MjData) -> np.ndarray:  # pyright: ignore
        """(picture_size, picture_size, 3) uint8: a view from the side, the movable object in red."""
        camera = mujoco.MjvCamera()  # pyright: ignore[reportAttributeAccessIssue]
        camera.azimuth, camera.elevation, camera.distance = 200.0, -35.0, 0.9
        camera.lookat[:] = (*scene.CENTRE, 0.05)
        self._colour.update_scene(data, camera)
        return self._colour.render()

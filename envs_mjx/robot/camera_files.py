"""What cameras' drivers record, read: depth images, point clouds, and the calibration that goes with them.

    python -m envs_mjx.robot.camera_files left.png right.npz --calibration cameras.json --domain block_pulling \\
        --gripper 0.5 0 0.2 0

makes the observation of one moment, as observation.npz and as a picture. A file belongs to the camera that it is named
after. This module needs NumPy and Pillow, neither JAX nor MuJoCo.

    {"cameras": [{"name": "left", "width": 640, "height": 480, "fx": 580.1, "fy": 580.1, "cx": 319.5, "cy": 239.5,
                  "depth_unit": 0.001, "pose": [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0.7], [0, 0, 0, 1]]}]}

is a calibration: pixels, metres for each unit of a whole-numbered depth image, and the pose of the camera's frame (x
right, y down, z forth) in the robot's.
"""

import argparse
import dataclasses
import json
import pathlib
import sys
import zipfile
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from PIL import Image

from envs_mjx.errors import UserError
from envs_mjx.robot import window
from envs_mjx.robot.cameras import Cameras, Cloud, cloud, fuse, observe

KINDS = (".npz", ".png", ".ply")
_PLY_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
              "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
              "float32": "f4", "float64": "f8"}
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


class CameraFileError(UserError):
    """A file cannot be used; the message is one line with its name, what is wrong, and what is accepted."""


@dataclasses.dataclass(frozen=True)
class Calibrated:
    """One camera."""

    cameras: Cameras
    """That one alone: intrinsics (1, 4), pose (1, 4, 4), float32."""
    rows: int
    columns: int
    depth_unit: float
    """Metres for each unit of a whole-numbered depth image: 0.001 for those of most drivers."""


def read_calibration(path: pathlib.Path) -> dict[str, Calibrated]:
    """The cameras of a calibration by name.

    Raises:
        CameraFileError: when something is missing, a number cannot be, a name comes twice, or a pose is not a rotation
            and a shift.
    """
    found = {}
    try:
        for entry in json.loads(path.read_text())["cameras"]:
            intrinsics = np.array([[float(entry[name]) for name in ("fx", "fy", "cx", "cy")]], np.float32)
            pose = np.array(entry["pose"], np.float64)
            unit, name = float(entry.get("depth_unit", 0.001)), entry["name"]
            sizes = np.array([*intrinsics[0, :2], float(entry["width"]), float(entry["height"]), unit])
            if not (np.isfinite(intrinsics).all() and np.isfinite(sizes).all() and (sizes > 0).all()):
                raise CameraFileError(f"{path}: camera {name!r}: expected finite numbers, and fx, fy, width, height "
                                      "and depth_unit above 0")
            if name in found:
                raise CameraFileError(f"{path}: two cameras of the name {name!r}: expected names that differ")
            if pose.shape != (4, 4) or not _is_rigid(pose):
                raise CameraFileError(f"{path}: pose of {name!r}: expected a rotation and a shift, (4, 4)")
            found[name] = Calibrated(
                Cameras(intrinsics, pose[None].astype(np.float32)), int(entry["height"]), int(entry["width"]), unit)
    except (OSError, json.JSONDecodeError, KeyError, TypeError, ValueError) as error:
        what = f"no {error}" if isinstance(error, KeyError) else str(error).splitlines()[0]
        raise CameraFileError(
            f"{path}: not a calibration ({what}); expected cameras with name, width, height, fx, fy, cx, cy, pose"
        ) from None
    return found


def read_depth(path: pathlib.Path, depth_unit: float = 0.001) -> np.ndarray:
    """(rows, columns) float32 metres, 0 where nothing was measured, of a .png of 16 bits or the `depth` of an .npz.

    Args:
        path: the file.
        depth_unit: metres for each unit of whole numbers; floating-point numbers are metres.
    """
    try:
        if path.suffix == ".npz":
            with path.open("rb") as file, np.load(file) as arrays:
                image = arrays["depth"]
        else:
            with Image.open(path) as picture:
                image = np.asarray(picture)
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise CameraFileError(f"{path}: no depth image ({str(error).splitlines()[0]}); expected a 16-bit .png, or an "
                              ".npz with an array 'depth'") from None
    if image.ndim != 2 or image.dtype.kind not in "iuf" or image.dtype == np.uint8:
        raise CameraFileError(
            f"{path}: {image.dtype} of shape {image.shape}: expected one channel of 16 bits, or floats")
    whole = np.issubdtype(image.dtype, np.integer)
    depth = image.astype(np.float32) * np.float32(depth_unit) if whole else image.astype(np.float32)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def read_ply(path: pathlib.Path) -> np.ndarray:
    """(N, 3) float32: x, y, z of the vertices of a PLY file, in text or binary, in metres."""
    try:
        raw = path.read_bytes()
        end = b"end_header\r\n" if b"end_header\r\n" in raw else b"end_header\n"
        header, _, body = raw.partition(end)
    except OSError as error:
        raise CameraFileError(f"{path}: cannot be read ({error.strerror})") from None
    words = [line.split() for line in header.decode("ascii", "replace").splitlines()]
    kind = next((line[1] for line in words if line[:1] == ["format"] and len(line) > 1), "")
    elements = [index for index, line in enumerate(words) if line[:1] == ["element"]]
    if not body or not elements or words[elements[0]][1:2] != ["vertex"] or kind not in ("ascii", *_PLY_ORDERS):
        raise CameraFileError(f"{path}: not a PLY file whose first element is vertex, in ascii or binary")
    number = words[elements[0]][2] if len(words[elements[0]]) > 2 else ""
    if not number.isdigit():
        raise CameraFileError(f"{path}: not a PLY file that says how many vertices there are")
    number = int(number)
    vertex = words[elements[0] : [*elements, len(words)][1]]
    properties = [line[1:] for line in vertex if line[:1] == ["property"] and len(line) > 2]
    names = [line[-1] for line in properties]
    if not {"x", "y", "z"} <= set(names) or any(line[0] not in _PLY_TYPES for line in properties):
        raise CameraFileError(f"{path}: vertices have {', '.join(names)}: expected numbers, x, y and z among them")
    try:
        if kind == "ascii":
            rows = np.array([line.split()[: len(names)] for line in body.decode().splitlines()[:number]], np.float64)
            columns: Any = {name: rows[:, index] for index, name in enumerate(names)}
        else:
            layout = np.dtype([(name, _PLY_ORDERS[kind] + _PLY_TYPES[line[0]])
                               for name, line in zip(names, properties, strict=True)])
            columns = np.frombuffer(body, layout, number)
        points = np.stack([columns[name] for name in "xyz"], axis=1).astype(np.float32)
    except (ValueError, IndexError):
        points = np.zeros((0, 3), np.float32)
    if len(points) != number:
        raise CameraFileError(f"{path}: torn: expected {number} vertices")
    return points


def read_cloud(path: pathlib.Path, calibration: Mapping[str, Calibrated]) -> Cloud:
    """The points of one file in the robot's frame.

    An image belongs to the camera that it is named after, and so does a cloud, which is then in that camera's frame; a
    cloud of any other name is in the robot's frame.
    """
    camera = calibration.get(path.stem)
    if path.suffix == ".ply":
        points = read_ply(path)
        if camera is not None:
            points = points @ camera.cameras.pose[0, :3, :3].T + camera.cameras.pose[0, :3, 3]
        return Cloud(points, np.isfinite(points).all(axis=1))
    if path.suffix not in KINDS:
        raise CameraFileError(f"{path}: accepted are {', '.join(KINDS)}")
    if camera is None:
        raise CameraFileError(f"{path}: no camera {path.stem!r} in the calibration: it has {', '.join(calibration)}")
    depth = read_depth(path, camera.depth_unit)
    if depth.shape != (camera.rows, camera.columns):
        raise CameraFileError(f"{path}: {depth.shape[0]} x {depth.shape[1]} pixels: expected {camera.rows} x "
                              f"{camera.columns}, as calibrated")
    return cloud(camera.cameras, depth[None])


def _is_rigid(pose: np.ndarray) -> bool:
    turn = pose[:3, :3]
    return (bool(np.isfinite(pose).all()) and bool(np.allclose(turn @ turn.T, np.eye(3), atol=1e-4))
            and np.linalg.det(turn) > 0 and bool(np.allclose(pose[3], [0, 0, 0, 1])))


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command's options."""
    parser = argparse.ArgumentParser(prog="python -m envs_mjx.robot.camera_files",
                                     description="The observation of one moment from recorded files.")
    parser.add_argument("files", nargs="+", type=pathlib.Path, help="depth images (.png, .npz) and clouds (.ply)")
    parser.add_argument("--calibration", required=True, type=pathlib.Path, help="the cameras, as JSON")
    parser.add_argument("--domain", required=True, choices=window.TASKS, help="tells how far the gripper is open")
    parser.add_argument("--gripper", required=True, nargs=4, type=float, metavar=("X", "Y", "Z", "YAW"),
                        help="pose of the end effector in the robot's frame, metres and radians")
    parser.add_argument("--pad", nargs=2, type=float, metavar=("X", "Y"), help="middle of the goal pad, metres")
    parser.add_argument("--out", default="observation", type=pathlib.Path, help="name of the .npz and the .png")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command."""
    options = parse(arguments)
    try:
        if (options.pad is not None) != window.TASKS[options.domain].has_pad:
            padded = " or ".join(name for name, outfit in window.TASKS.items() if outfit.has_pad)
            raise CameraFileError(f"--pad: accepted with --domain {padded}, and needed there")
        calibration = read_calibration(options.calibration)
        seen = fuse(*(read_cloud(path, calibration) for path in options.files))
        for name, numbers in (("gripper", options.gripper), ("pad", options.pad or ())):
            if not np.isfinite(numbers).all():
                raise CameraFileError(f"--{name}: got {' '.join(map(str, numbers))}, accepted: finite numbers")
        if not seen.measured.any():
            raise CameraFileError(f"{', '.join(map(str, options.files))}: expected files that measured something")
        options.out.parent.mkdir(parents=True, exist_ok=True)
    except (CameraFileError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    pad = None if options.pad is None else np.array(options.pad, np.float32)
    gripper = np.array(options.gripper, np.float32)
    observation = observe(seen, gripper, window.TASKS[options.domain].opening, pad)
    stored, picture = (options.out.with_name(options.out.name + suffix) for suffix in (".npz", ".png"))
    np.savez_compressed(stored, observation=observation)
    Image.fromarray(window.grey(observation[..., 0])).save(picture)
    print(f"{int(seen.measured.sum())} points of {len(options.files)} files: {stored}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

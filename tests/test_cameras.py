"""From depth cameras to observations: by hand, from files, with NumPy and with JAX, and against training's images."""

import contextlib
import json
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import configs
from envs_mjx import registry
from envs_mjx.robot import camera_files, cameras, depth, headless, window
from envs_mjx.robot.cameras import Cameras, Cloud
from envs_mjx.robot.task import RobotTask

EYES = ((0.5, -0.6, 0.7), (0.5, 0.6, 0.7), (0.7, 0.0, 1.0))
ROWS, COLUMNS, FOCAL = 240, 320, 300.0
GRIPPER = np.array([0.45, 0.05, 0.2, 0.3], np.float32)
BOX = np.array([[0.46, -0.06, 0.0], [0.56, 0.04, 0.05]])
"""Two opposite corners, metres."""


def rig() -> Cameras:
    poses = np.stack([cameras.look_at(np.array(eye), np.array([0.5, 0, 0])) for eye in EYES]).astype(np.float32)
    intrinsics = np.array([FOCAL, FOCAL, (COLUMNS - 1) / 2, (ROWS - 1) / 2], np.float32)
    return Cameras(np.tile(intrinsics, (len(EYES), 1)), poses)


def traced(calibrated: Cameras, boxes: list[np.ndarray]) -> np.ndarray:
    """(C, rows, columns) exact depth of a table at 0 and of upright boxes (2, 3), by slabs."""
    x, y = np.meshgrid((np.arange(COLUMNS) - (COLUMNS - 1) / 2) / FOCAL, (np.arange(ROWS) - (ROWS - 1) / 2) / FOCAL)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)  # of depth 1
    images = []
    for pose in calibrated.pose.astype(np.float64):
        eye, ray = pose[:3, 3], rays @ pose[:3, :3].T
        found = np.where(ray[..., 2] < 0, -eye[2] / np.minimum(ray[..., 2], -1e-9), np.inf)
        for box in boxes:
            near, far = np.sort((box[:, None, None] - eye) / np.where(np.abs(ray) < 1e-12, 1e-12, ray), axis=0)
            enter, leave = near.max(axis=-1), far.min(axis=-1)
            found = np.where((enter <= leave) & (enter > 0), np.minimum(found, enter), found)
        images.append(np.where(np.isfinite(found), found, 0))
    return np.stack(images).astype(np.float32)


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    return traced(rig(), [BOX])


# Numbers worked by hand


def test_a_pixel_becomes_a_point() -> None:
    """Camera 1 m above (0.5, 0.1), looking straight down, the image's x axis along the robot's y, its y along x."""
    pose = np.array([[[0, 1, 0, 0.5], [1, 0, 0, 0.1], [0, 0, -1, 1], [0, 0, 0, 1]]], np.float32)
    calibrated = Cameras(np.array([[100, 50, 1, 0]], np.float32), pose)
    seen = cameras.cloud(calibrated, np.array([[[0.5, 0.8, 0.8], [0, np.nan, 1.0]]], np.float32))
    np.testing.assert_array_equal(seen.measured, [True, True, True, False, False, True])
    np.testing.assert_allclose(seen.points[2], [0.5, 0.1 + 0.8 / 100, 0.2], atol=1e-6)
    np.testing.assert_allclose(seen.points[5], [0.5 + 1 / 50, 0.1 + 1 / 100, 0.0], atol=1e-6)


def test_looking_at_a_point() -> None:
    pose = cameras.look_at(np.array([0.2, -0.6, 0.7]), np.array([0.5, 0.0, 0.0]))
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(pose[:3, :3]), 1)
    own = np.linalg.inv(pose) @ [0.5, 0.0, 0.0, 1.0]
    np.testing.assert_allclose(own[:2], 0, atol=1e-12)
    assert own[2] > 0
    assert pose[2, 0] == 0  # level
    assert pose[2, 1] < 0  # the image's y axis points down


def test_holes_are_filled_from_the_nearest_and_then_the_lower() -> None:
    height = np.full((5, 5), window.NOTHING, np.float32)
    height[2, 0], height[2, 4], height[0, 1] = 0.05, 0.02, 0.01
    filled = cameras.fill(height)
    np.testing.assert_allclose(filled[2], [0.05, 0.05, 0.02, 0.02, 0.02])
    np.testing.assert_allclose(filled[:, 1], [0.01, 0.01, 0.05, 0.01, 0.01])
    np.testing.assert_array_equal(cameras.fill(np.full((3, 3), window.NOTHING)), 0)


def test_closing_fills_pits_and_keeps_edges() -> None:
    height = np.zeros((9, 9), np.float32)
    height[:, 4:] = 0.05
    height[4, 6] = window.NOTHING
    np.testing.assert_array_equal(cameras.close(height), np.where(np.arange(9)[None, :] >= 4, np.float32(0.05), 0) *
                                  np.ones((9, 1), np.float32))


def test_the_pad_is_painted_where_the_table_is() -> None:
    height = np.zeros((84, 84), np.float32)
    height[40:44, 40:44] = 0.05
    painted = cameras.paint_pad(height, np.array([0.5, 0.0], np.float32), np.array([0.5, 0.0], np.float32))
    np.testing.assert_allclose(np.unique(painted), [-0.02, 0, 0.05])
    rows, _ = np.nonzero(painted < 0)
    assert (rows.min(), rows.max()) == (33, 50)  # 9 cm are 18.9 pixels, their middles at half pixels
    np.testing.assert_array_equal(painted[40:44, 40:44], height[40:44, 40:44])


def test_the_grippers_points_are_taken_out() -> None:
    gripper = np.array([0.5, 0.0, 0.1, np.pi / 2], np.float32)
    points = np.array([[0.5, 0.052, 0.12], [0.5, -0.052, 0.096], [0.5, 0.052, 0.02], [0.552, 0.0, 0.12],
                       [0.3, 0.1, 0.2], [0.4, 0.1, 0.05]], np.float32)
    kept = cameras.without_gripper(Cloud(points, np.ones(6, bool)), gripper, window.OPEN).measured
    np.testing.assert_array_equal(kept, [False, False, True, True, False, True])


# Observations from images


def test_a_box_is_seen_as_in_training(images: np.ndarray) -> None:
    observation = cameras.observe(cameras.cloud(rig(), images), GRIPPER, window.OPEN)
    assert (observation.shape, observation.dtype) == ((84, 84, 2), np.float32)
    assert not observation[..., 1].any()
    middle = jnp.asarray([*BOX.mean(axis=0)[:2], 0.0], jnp.float32)
    u, v = depth.local_frame(jnp.asarray(GRIPPER[:2]), middle)
    height = jnp.maximum(depth.box(u, v, 0.05, 0.05, 0.05), 0.0)
    expected = depth.depth(height, jnp.float32(GRIPPER[2]), depth.fingers(jnp.float32(GRIPPER[3]), 29.0))
    error = np.abs(observation[..., 0] - np.asarray(expected))
    assert np.median(error) < 1e-4
    assert (error <= 0.005).mean() > 0.985  # cameras of 320 x 240


def test_fingers_in_sight_leave_no_trace(images: np.ndarray) -> None:
    """Two boxes where the fingers are, in a scene seen by the same cameras."""
    gripper = np.array([0.45, 0.05, 0.03, 0.0], np.float32)
    fingers = [np.array([[x - 0.008, 0.042, 0.025], [x + 0.008, 0.058, 0.12]]) for x in (0.398, 0.502)]
    assert (BOX[0, :2] < (0.502, 0.042)).all()  # one stands on the box's edge
    seen = cameras.cloud(rig(), traced(rig(), [BOX, *fingers]))
    without = cameras.observe(cameras.cloud(rig(), images), gripper, window.OPEN)
    error = np.abs(cameras.observe(seen, gripper, window.OPEN) - without)[..., 0]
    assert (error <= 0.005).mean() > 0.98
    assert np.abs(cameras.height_map(seen, gripper[:2])).max() > 0.1


def test_numpy_and_jax_see_the_same_and_jax_in_batches(images: np.ndarray) -> None:
    grippers = np.stack([GRIPPER, GRIPPER + np.float32(0.03)])
    pads = np.array([[0.4, 0.1], [0.5, -0.1]], np.float32)
    holes = np.where(np.random.default_rng(0).random(images.shape) < 0.2, np.float32(0), images)
    batch = np.stack([images, holes])

    def observe(images, gripper, pad):
        return cameras.observe(cameras.cloud(rig(), images), gripper, window.HALF_OPEN, pad)

    together = jax.jit(jax.vmap(observe))(batch, grippers, pads)
    assert isinstance(together, jax.Array)
    for index in range(2):
        alone = observe(batch[index], grippers[index], pads[index])
        assert isinstance(alone, np.ndarray)
        error = np.abs(alone - np.asarray(together[index]))
        assert (error > 1e-5).mean() < 5e-3  # a rounding may put a point into the next cell


def test_clouds_are_put_together(images: np.ndarray) -> None:
    whole = cameras.cloud(rig(), images)
    parts = [cameras.cloud(Cameras(*(x[i : i + 1] for x in rig())), images[i : i + 1]) for i in range(3)]
    for got, expected in zip(cameras.fuse(*parts), whole, strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-6)


def test_wrong_shapes_are_named(images: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"expected \(cameras, rows, columns\)"):
        cameras.cloud(rig(), images[0])
    with pytest.raises(ValueError, match=r"intrinsics of shape \(3, 4\): expected \(2, 4\)"):
        cameras.cloud(rig(), images[:2])


# Files


@pytest.fixture(scope="module")
def recorded(images: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """What three drivers leave behind: a PNG in millimetres, an array in metres, a cloud in its camera's frame."""
    folder = tmp_path_factory.mktemp("recorded")
    entries = [{"name": name, "width": COLUMNS, "height": ROWS, "fx": FOCAL, "fy": FOCAL, "cx": (COLUMNS - 1) / 2,
                "cy": (ROWS - 1) / 2, "pose": pose.tolist(), "depth_unit": 1e-4}
               for name, pose in zip(("left", "right", "overhead"), rig().pose, strict=True)]
    (folder / "cameras.json").write_text(json.dumps({"cameras": entries}))
    Image.fromarray(np.round(images[0] * 1e4).astype(np.uint16)).save(folder / "left.png")
    np.savez(folder / "right.npz", depth=images[1])
    own = cameras.cloud(Cameras(rig().intrinsics[2:], np.eye(4, dtype=np.float32)[None]), images[2:]).points
    header = "ply\nformat {}\ncomment of a driver\nelement vertex {}\n{}end_header\n"
    properties = "property float x\nproperty float y\nproperty float z\nproperty uchar red\n"
    rows = np.zeros(len(own), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1")])
    rows["x"], rows["y"], rows["z"] = own.T
    start = header.format("binary_little_endian 1.0", len(own), properties).encode()
    (folder / "overhead.ply").write_bytes(start + rows.tobytes())
    few = header.format("ascii 1.0", 2, "property double z\nproperty float x\nproperty float y\n")
    (folder / "text.ply").write_text(few + "0.25 1 2\n0.5 3 4\n")
    return folder


def test_files_give_the_same_observation(images: np.ndarray, recorded: pathlib.Path, tmp_path: pathlib.Path) -> None:
    files = [str(recorded / name) for name in ("left.png", "right.npz", "overhead.ply")]
    arguments = [*files, "--calibration", str(recorded / "cameras.json"), "--domain", "block_pulling", "--gripper",
                 *map(str, GRIPPER), "--out", str(tmp_path / "seen")]
    assert camera_files.main(arguments) == 0
    with np.load(tmp_path / "seen.npz") as arrays:
        got = arrays["observation"]
    expected = cameras.observe(cameras.cloud(rig(), images), GRIPPER, window.OPEN)
    assert (np.abs(got - expected) < 0.001).mean() > 0.99  # rounded to 0.1 mm, edges fall to either side
    with Image.open(tmp_path / "seen.png") as picture:
        assert picture.size == (84, 84)


@pytest.mark.parametrize(("domain", "pad"), [("block_pushing", ()), ("drawer_opening", ("--pad", "0.5", "0.1"))])
def test_the_pads_place_belongs_to_the_task_that_has_one(
    recorded: pathlib.Path, capsys: pytest.CaptureFixture[str], domain: str, pad: tuple[str, ...]
) -> None:
    arguments = [str(recorded / "left.png"), "--calibration", str(recorded / "cameras.json"), "--domain", domain,
                 "--gripper", *map(str, GRIPPER), *pad]
    assert camera_files.main(arguments) == 1
    assert capsys.readouterr().err == "error: --pad: accepted with --domain block_pushing, and needed there\n"


def test_text_clouds(recorded: pathlib.Path) -> None:
    np.testing.assert_array_equal(camera_files.read_ply(recorded / "text.ply"), [[1, 2, 0.25], [3, 4, 0.5]])


@pytest.mark.parametrize(("name", "content", "message"), [
    ("left.npz", {"image": np.zeros((2, 2))}, "expected a 16-bit .png, or an .npz with an array 'depth'"),
    ("left.npz", {"depth": np.zeros((4, 4, 3), np.float32)}, "expected one channel of 16 bits, or floats"),
    ("left.npz", {"depth": np.zeros((4, 4), np.float32)}, "4 x 4 pixels: expected 240 x 320, as calibrated"),
    ("front.npz", {"depth": np.zeros((4, 4), np.float32)}, "no camera 'front' in the calibration: it has left, right"),
    ("left.npz", {"depth": np.array([["a", "b"]])}, "expected one channel of 16 bits, or floats"),
    ("left.npz", {"depth": np.zeros((ROWS, COLUMNS), np.float32)}, "expected files that measured something"),
    ("left.png", b"", "no depth image"),
    ("left.npz", b"PK\x03\x04 torn", "no depth image"),
    ("left.ply", b"ply\n", "not a PLY file"),
    ("left.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty\nend_header\n1", "x, y and z among them"),
    ("left.ply", b"ply\nformat ascii 1.0\nelement vertex\nend_header\n1", "how many vertices"),
    ("left.ply", b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
                 b"end_header\n1 2 3\n", "torn: expected 2 vertices"),
    ("left.tiff", b"", "accepted are .npz, .png, .ply"),
])
def test_files_that_cannot_be_used_are_named(
    recorded: pathlib.Path, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str], name: str,
    content: dict | bytes, message: str
) -> None:
    if isinstance(content, dict):
        np.savez(tmp_path / name, **content)
    else:
        (tmp_path / name).write_bytes(content)
    arguments = [str(tmp_path / name), "--calibration", str(recorded / "cameras.json"), "--domain", "block_pulling",
                 "--gripper", "0.5", "0", "0.2", "0"]
    assert camera_files.main(arguments) == 1
    error = capsys.readouterr().err
    assert message in error
    assert name in error
    assert len(error.splitlines()) == 1


def test_clouds_of_other_systems(recorded: pathlib.Path, tmp_path: pathlib.Path) -> None:
    (tmp_path / "text.ply").write_bytes((recorded / "text.ply").read_bytes().replace(b"\n", b"\r\n"))
    np.testing.assert_array_equal(camera_files.read_ply(tmp_path / "text.ply"), [[1, 2, 0.25], [3, 4, 0.5]])


@pytest.mark.parametrize(("options", "message"), [
    (("--gripper", "nan", "0", "0.2", "0"), "--gripper: got nan 0.0 0.2 0.0, accepted: finite numbers"),
    (("--out", "{}/left.png/seen"), "left.png"),
])
def test_options_that_cannot_be_used_are_named(
    recorded: pathlib.Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], message: str
) -> None:
    arguments = [str(recorded / "left.png"), "--calibration", str(recorded / "cameras.json"), "--domain",
                 "block_pulling", "--gripper", *map(str, GRIPPER), *(option.format(recorded) for option in options)]
    assert camera_files.main(arguments) == 1
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1


@pytest.mark.parametrize(("entry", "message"), [
    ({"fx": 0}, "camera 'left': expected finite numbers, and fx"), ({"depth_unit": -1}, "depth_unit above 0"),
    ({"cx": "nan"}, "camera 'left': expected finite numbers"), ({"name": "right"}, "two cameras of the name 'right'"),
    ({"pose": [[1, 0, 0, float("nan")], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, "expected a rotation and a shift"),
])
def test_numbers_that_a_camera_cannot_have_are_named(
    recorded: pathlib.Path, tmp_path: pathlib.Path, entry: dict, message: str
) -> None:
    whole = json.loads((recorded / "cameras.json").read_text())
    whole["cameras"][0] |= entry
    (tmp_path / "cameras.json").write_text(json.dumps(whole))
    with pytest.raises(camera_files.CameraFileError, match=message):
        camera_files.read_calibration(tmp_path / "cameras.json")


def test_calibrations_that_cannot_be_used_are_named(recorded: pathlib.Path, tmp_path: pathlib.Path) -> None:
    path = tmp_path / "cameras.json"
    whole = json.loads((recorded / "cameras.json").read_text())
    path.write_text("{}")
    with pytest.raises(camera_files.CameraFileError, match="no 'cameras'"):
        camera_files.read_calibration(path)
    del whole["cameras"][0]["fx"]
    path.write_text(json.dumps(whole))
    with pytest.raises(camera_files.CameraFileError, match="no 'fx'"):
        camera_files.read_calibration(path)
    whole["cameras"][0]["fx"], whole["cameras"][0]["pose"][0] = 1.0, [1, 1, 1, 1]
    path.write_text(json.dumps(whole))
    with pytest.raises(camera_files.CameraFileError, match="pose of 'left': expected a rotation and a shift"):
        camera_files.read_calibration(path)


def test_a_robots_computer_needs_neither_jax_nor_mujoco() -> None:
    program = """
import sys
sys.modules["jax"] = sys.modules["mujoco"] = None
import numpy as np
from envs_mjx.robot import camera_files, cameras, window
seen = cameras.Cloud(np.zeros((1, 3), np.float32), np.ones(1, bool))
print(cameras.observe(seen, np.array([0.5, 0, 0.2, 0], np.float32), window.CLOSED).max())
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    np.testing.assert_allclose(float(run.stdout), 0.26, atol=1e-6)


# Against training, the same scenes rendered


def fused_errors(domain: str, scenes: int, gripper: bool) -> np.ndarray:
    """(scenes, 84, 84) metres."""
    if headless.bind() is None:
        pytest.skip("neither EGL nor OSMesa can render here")
    from envs_mjx.robot.gap import GAPS
    from envs_mjx.robot.realworld import RealWorld
    from launch import fusion

    training = registry.make(domain)
    assert isinstance(training, RobotTask)
    with contextlib.closing(RealWorld(training, GAPS["none"])) as world:
        return fusion.errors(world, fusion.moments(training, jax.random.key(1), scenes), gripper)


@pytest.mark.parametrize("domain", configs.ROBOTS)
def test_fused_depth_is_that_of_training(domain: str) -> None:
    error = fused_errors(domain, 4, gripper=False)
    assert np.median(error) <= 0.001
    assert (error <= 0.005).mean() >= 0.99


@pytest.mark.slow
@pytest.mark.parametrize("domain", configs.ROBOTS)
def test_fused_depth_in_many_scenes(domain: str) -> None:
    error = fused_errors(domain, 100, gripper=False)
    assert np.median(error) <= 0.001
    assert (error <= 0.005).mean() >= 0.99
    assert (fused_errors(domain, 100, gripper=True) <= 0.005).mean() >= 0.985

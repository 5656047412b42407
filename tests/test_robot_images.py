"""Depth images of the robot tasks: worked by hand, against MuJoCo's renderer, turned, and with noise."""

import dataclasses
import os
import pathlib
import pickle
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import affine_transform

from envs_mjx import registry
from envs_mjx.robot import BlockPulling, depth, noise, scene
from envs_mjx.robot.rotation import mirror_action, mirror_poses, rotate_action
from envs_mjx.robot.task import RobotState, RobotTask

DOMAINS = ("block_pulling", "block_pushing", "drawer_opening")


@pytest.fixture(scope="module", params=DOMAINS)
def env(request: pytest.FixtureRequest) -> RobotTask:
    env = registry.make(request.param)
    assert isinstance(env, RobotTask)
    return env


def resets(env: RobotTask, number: int) -> RobotState:
    return jax.jit(jax.vmap(lambda key: env.reset(key)[0]))(jax.random.split(jax.random.key(2), number))


def moved(env_state: RobotState, gripper) -> RobotState:
    qpos = jnp.asarray(env_state.qpos).at[:4].set(jnp.asarray(gripper, jnp.float32))
    return dataclasses.replace(env_state, qpos=qpos)


def away_from_edges(height: np.ndarray, pixels: int = 1) -> np.ndarray:
    """Where an image is flat within `pixels` pixels."""
    side = 2 * pixels + 1
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(height, pixels, mode="edge"), (side, side))
    return np.ptp(windows, axis=(2, 3)) < 1e-4


# Numbers worked by hand


def test_a_box_covers_its_area_and_turns() -> None:
    u, v = depth.local_frame(jnp.zeros(2), jnp.array([0.102, 0.052, 0.0]))
    height = np.asarray(depth.box(u, v, 0.05, 0.025, 0.03))
    rows, columns = np.nonzero(height == np.float32(0.03))
    # From 0.052 to 0.152 m, and from 0.027 to 0.077: pixels 52.4 to 73.4, and 47.2 to 57.7.
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (53, 73, 48, 57)
    assert (height[height != np.float32(0.03)] == depth.NOTHING).all()
    u, v = depth.local_frame(jnp.zeros(2), jnp.array([0.102, 0.052, np.pi / 2]))
    rows, columns = np.nonzero(np.asarray(depth.box(u, v, 0.05, 0.025, 0.03)) > 0)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (58, 68, 42, 62)


def test_a_capsule_is_round() -> None:
    along, across = jnp.array([[0.0, 0.0, 0.0, 0.053, 0.06]]), jnp.array([[0.0, 0.003, 0.006, 0.0, 0.0]])
    height = depth.capsule(along, across, 0.05, 0.005, 0.02)
    np.testing.assert_allclose(height, [[0.025, 0.024, depth.NOTHING, 0.024, depth.NOTHING]], atol=1e-7)


def test_a_tray_has_walls_and_a_floor() -> None:
    u, v = jnp.array([[0.0, 0.049, 0.0, 0.051, 0.0]]), jnp.array([[0.0, 0.0, -0.048, 0.0, 0.046]])
    height = depth.tray(u, v, half=0.05, wall=0.003, top=0.04, floor=0.01)
    np.testing.assert_allclose(height, [[0.01, 0.04, 0.04, depth.NOTHING, 0.01]])


def test_two_fingers_of_six_pixels() -> None:
    rows, columns = np.nonzero(depth.fingers(jnp.float32(0), 29.0))
    np.testing.assert_array_equal(np.unique(rows), [*range(10, 16), *range(68, 74)])
    np.testing.assert_array_equal(np.unique(columns), range(39, 45))
    assert np.asarray(depth.fingers(jnp.float32(0.7), 29.0)).sum() == 72
    assert np.asarray(depth.fingers(jnp.float32(0.7), 0.0)).sum() == 36


# Observations and states


def test_values(env: RobotTask) -> None:
    """Below a camera 6 cm above the gripper: the table, an object's top, the pad; fingers are 0."""
    env_state = jax.tree.map(lambda x: x[0], resets(env, 1))
    observation, state = map(np.asarray, env.render(moved(env_state, (0.5, 0.0, 0.2, 0.0))))
    top = {"block_pulling": 0.05, "block_pushing": 0.05, "drawer_opening": 0.054}[env.name]
    expected = {0.0, 0.26, round(0.26 - top, 4), *([0.28] if env.name == "block_pushing" else [])}
    assert expected <= set(np.unique(np.round(observation[..., 0].astype(float), 4)))
    assert not observation[..., 1].any()
    np.testing.assert_array_equal(state[..., 0], observation[..., 0])
    assert (state[..., 1] >= state[..., 0]).all()


def test_which_object_moves_is_invisible_and_its_state_shows_it(env: RobotTask) -> None:
    """With the other one movable, 256 scenes show the very same observation; their states show the other object."""
    states = resets(env, 256)
    share = np.asarray(states.movable).mean()
    assert 0.35 < share < 0.65
    swapped = dataclasses.replace(
        states, movable=1 - states.movable,
        qpos=jnp.concatenate([states.qpos[:, :4], jax.vmap(
            lambda poses, movable: env.joints(poses[1 - movable]))(states.poses, states.movable)], axis=1))
    render = jax.jit(jax.vmap(env.render))
    (seen, state), (seen_swapped, state_swapped) = render(states), render(swapped)
    np.testing.assert_array_equal(seen, seen_swapped)
    assert (np.asarray(state != state_swapped).any(axis=(1, 2, 3))).mean() > 0.95
    nearer = np.minimum(state[..., 1], state_swapped[..., 1])
    np.testing.assert_array_equal(nearer, seen[..., 0])


@pytest.mark.slow
def test_a_classifier_cannot_tell_which_object_moves_before_contact(env: RobotTask) -> None:
    """From pairs of observations of 5 000 scenes, at the reset and from elsewhere above; from states it can."""
    number, fitted = 5000, 4000

    def views(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        key_reset, key_place = jax.random.split(key)
        env_state, first = env.reset(key_reset)
        place = jax.random.uniform(key_place, (4,), jnp.float32, -1.0, 1.0) * jnp.array([0.05, 0.05, 0.05, 3.0])
        second = env.show(dataclasses.replace(env_state, qpos=env_state.qpos.at[:4].add(place)))

        def coarse(image: jax.Array) -> jax.Array:
            return image.reshape(21, 4, 21, 4, 2).mean(axis=(1, 3)).ravel()

        seen, known = (jnp.concatenate([coarse(first.observation), coarse(second.observation)]),
                       jnp.concatenate([coarse(first.state), coarse(second.state)]))
        return seen, known, env_state.movable

    keys = jax.random.split(jax.random.key(7), number)
    seen, known, movable = jax.device_get(jax.jit(lambda keys: jax.lax.map(views, keys, batch_size=50))(keys))

    def accuracy(x: np.ndarray) -> float:
        """Of ridge regression on the pixels and 1 000 random features of them, on scenes that it was not fitted to."""
        x = (x - x[:fitted].mean(0)) / (x[:fitted].std(0) + 1e-6)
        weights = np.random.default_rng(0).normal(size=(x.shape[1], 1000)) / np.sqrt(x.shape[1])
        x = np.concatenate([x, np.maximum(x @ weights, 0), np.ones((number, 1))], axis=1)
        gram = x[:fitted].T @ x[:fitted] + 0.1 * fitted * np.eye(x.shape[1])
        guess = x[fitted:] @ np.linalg.solve(gram, x[:fitted].T @ (2.0 * movable[:fitted] - 1))
        return float(np.mean((guess > 0) == movable[fitted:]))

    found = accuracy(seen), accuracy(known)
    print(f"{env.name}: movable object from observations {found[0]:.3f}, from states {found[1]:.3f}")
    assert abs(found[0] - 0.5) < 0.05  # three standard errors of 1 000 scenes
    assert found[1] > 0.75


_RENDER = """
import sys
import jax, numpy as np
from envs_mjx import registry
from envs_mjx.robot.view import View
import pickle
name, path = sys.argv[1:]
with open(path, "rb") as file:
    states = pickle.load(file)
view = View(registry.make(name))
pictures = [(view.height(s), view.height(s, immovable=False), view.picture(s)) for s in states]
view.close()
np.savez(path, **dict(zip(("height", "masked", "picture"), map(np.stack, zip(*pictures)))))
"""


def test_against_mujocos_renderer(env: RobotTask, tmp_path: pathlib.Path) -> None:
    """Within 1 mm off silhouettes, and at most 0.05 % of pixels on them."""
    rng = np.random.default_rng(0)
    states = resets(env, 8)
    states = [jax.device_get(moved(jax.tree.map(lambda x, i=i: x[i], states), (
        0.5 + rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1), 0.2, 0.3))) for i in range(8)]
    if env.name == "drawer_opening":
        states = [dataclasses.replace(s, qpos=np.append(s.qpos[:4], np.float32(0.012 * i)))
                  for i, s in enumerate(states)]
    path = tmp_path / "states.npz"
    path.write_bytes(pickle.dumps(states))
    for backend in ("egl", "osmesa"):
        run = subprocess.run([sys.executable, "-c", _RENDER, env.name, str(path)], capture_output=True, text=True,
                             env={**os.environ, "MUJOCO_GL": backend}, check=False)
        if run.returncode == 0:
            break
    else:
        pytest.skip("MuJoCo's renderer found neither EGL nor OSMesa")
    rendered = np.load(path)
    assert (np.ptp(rendered["picture"], axis=(1, 2)) > 50).all()
    movable, immovable, _ = map(np.asarray, jax.vmap(env.heights)(jax.tree.map(lambda *x: jnp.stack(x), *states)))
    for height, expected in ((np.maximum(movable, immovable), rendered["height"]), (movable, rendered["masked"])):
        height = np.maximum(height, 0)
        wrong = np.abs(height - expected) > 1e-3
        assert wrong.mean() < 5e-4
        assert not wrong[np.stack([away_from_edges(h) for h in height])].any()


# Rotation


def turned(image: np.ndarray, angle: float) -> np.ndarray:
    """An image (84, 84, channels) turned about its middle: bilinear, the nearest value from beyond the border."""
    cos, sin = np.cos(angle), np.sin(angle)
    matrix, middle = np.array([[cos, sin], [-sin, cos]]), np.array([41.5, 41.5])
    shift: Any = middle - matrix @ middle
    return np.stack([affine_transform(channel, matrix, shift, order=1, mode="nearest")
                     for channel in np.moveaxis(image, -1, 0)], axis=-1)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_quarter_turn_is_exact(env: RobotTask, quarters: int) -> None:
    """Turning the image is turning the scene, up to pixels whose middle is on an edge."""
    env_state = moved(jax.tree.map(lambda x: x[0], resets(env, 1)), (0.53, 0.02, 0.15, 0.4))
    angle = quarters * np.pi / 2
    for image, expected in zip(env.render(env_state), env.render(env.turn(env_state, jnp.float32(angle))), strict=True):
        got = turned(np.asarray(image), angle)
        np.testing.assert_allclose(got, np.rot90(image, -quarters, (1, 0)), atol=1e-5)
        assert (np.abs(got - expected) > 1e-5).mean() < 5e-4


@pytest.mark.parametrize("angle", [0.3, 2.0, -1.1])
def test_any_turn_is_that_of_the_scene(env: RobotTask, angle: float) -> None:
    """Within the circle that stays in the image, two pixels off edges: the painted fingers do not turn, nor the pad."""
    env_state = moved(jax.tree.map(lambda x: x[0], resets(env, 1)), (0.53, 0.02, 0.15, 0.4))
    got = turned(np.asarray(env.render(env_state)[1]), angle)
    expected = np.asarray(env.render(env.turn(env_state, jnp.float32(angle)))[1])
    offsets = np.arange(84) - 41.5
    inside = np.hypot(offsets[:, None], offsets[None, :]) < 40
    for channel in (0, 1):
        sure = inside & away_from_edges(got[..., channel], 2) & away_from_edges(expected[..., channel], 2)
        assert sure.sum() > 1500
        np.testing.assert_allclose(got[..., channel][sure], expected[..., channel][sure], atol=1e-4)


def test_mirroring_the_scene_flips_the_image(env: RobotTask) -> None:
    """Exactly, as a pixel's middle is mirrored onto another's."""
    env_state = moved(jax.tree.map(lambda x: x[0], resets(env, 1)), (0.53, 0.02, 0.15, 0.4))
    for image, expected in zip(env.render(env_state), env.render(env.mirror(env_state)), strict=True):
        assert (np.abs(np.asarray(image)[:, ::-1] - expected) > 1e-5).mean() < 5e-4


def test_a_mirrored_step_is_the_step_of_the_mirrored(env: RobotTask) -> None:
    """Free motion and contact: the gripper goes down onto an object and drags it."""
    start = jax.tree.map(lambda x: x[0], resets(env, 1))
    x, y, yaw = np.asarray(env.object_poses(start))[int(start.movable)]
    start = moved(start, (float(x), float(y) + 0.01, env.plan.work + 0.04, float(yaw)))
    step = jax.jit(lambda env_state, action: env.step(jax.random.key(0), env_state, action)[0])
    there, back = start, env.mirror(start)
    for action in ([0.0, 0.0, -0.8, 0.0], [0.4, 0.5, 0.0, 0.2], [0.4, 0.5, 0.0, 0.2]):
        there, back = step(there, jnp.array(action)), step(back, mirror_action(jnp.array(action)))
    assert bool(there.touched)
    np.testing.assert_allclose(env.mirror(there).qpos, back.qpos, atol=2e-3)


def test_augmenting_turns_moments_and_actions_alike(env: RobotTask) -> None:
    """One key, one motion: places and actions alike, about half of them mirrored before; the objects stay sorted."""
    states = jax.tree.map(lambda x: x[:16], resets(env, 64))
    action = jnp.array([0.3, 0.4, -0.3, 0.9])
    keys = jax.random.split(jax.random.key(0), 16)
    moved_states, actions = jax.vmap(env.augment, (0, 0, None))(keys, states, action)
    mirrored = np.asarray(actions)[:, 3] < 0
    assert 0 < mirrored.sum() < 16
    angle = np.asarray(moved_states.qpos)[:, 3] - np.where(mirrored, -1, 1) * np.asarray(states.qpos)[:, 3]
    assert np.ptp(angle) > 1
    for index in range(16):
        before = mirror_action(action) if mirrored[index] else action
        np.testing.assert_allclose(actions[index], rotate_action(before, jnp.float32(angle[index])), atol=1e-6)
    cos, sin = np.cos(angle), np.sin(angle)
    matrix = np.moveaxis(np.array([[cos, -sin], [sin, cos]]), -1, 0)
    loose, loose_moved = (np.take_along_axis(np.asarray(s.poses), np.asarray(s.movable)[:, None, None], axis=1)[:, 0]
                          for s in (states, moved_states))
    loose = np.where(mirrored[:, None], mirror_poses(jnp.asarray(loose)), loose)
    middle = scene.CENTRE[None]
    expected = np.einsum("nij,nj->ni", matrix, loose[:, :2] - middle) + middle
    np.testing.assert_allclose(loose_moved[:, :2], expected, atol=1e-6)
    np.testing.assert_allclose(loose_moved[:, 2], loose[:, 2] + angle, atol=1e-6)
    if env.name == "drawer_opening":
        np.testing.assert_array_equal(moved_states.movable, states.movable)
    else:
        np.testing.assert_array_equal(moved_states.qpos[:, 4:], loose_moved)
        assert (np.diff(moved_states.poses[:, :, 1], axis=1) >= 0).all()
        assert (np.asarray(moved_states.movable) != states.movable).any()
    assert (np.asarray(moved_states.noise_key) != states.noise_key).any()


def test_turned_actions() -> None:
    action = jnp.array([0.6, 0.2, -0.3, 0.9])
    np.testing.assert_allclose(rotate_action(action, jnp.float32(np.pi / 2)), [-0.2, 0.6, -0.3, 0.9], atol=1e-6)
    np.testing.assert_allclose(rotate_action(jnp.array([1.0, 1.0, 0.0, 0.0]), jnp.float32(np.pi / 4)),
                               [0, np.sqrt(2), 0, 0], atol=1e-6)


# Noise


def test_noise_is_that_of_the_textbook() -> None:
    """Corner gradients, quintic fade, interpolated first along columns, then along rows."""
    keys = jax.random.split(jax.random.key(0), 12)
    seen = set()
    for key in keys:
        key_cells, key_gradients = jax.random.split(key)
        cells = noise.CELLS[int(jax.random.randint(key_cells, (), 0, 4, jnp.int32))]
        angle = np.asarray(jax.random.uniform(key_gradients, (7, 7), jnp.float32, 0.0, 2 * np.pi))
        seen.add(cells)
        x, y = np.meshgrid(np.arange(84) / 84 * cells, np.arange(84) / 84 * cells, indexing="ij")
        i, j = np.floor(x).astype(int), np.floor(y).astype(int)
        u, v = x - i, y - j

        def corner(a: int, b: int, i=i, j=j, u=u, v=v, angle=angle) -> np.ndarray:
            turn = angle[i + a, j + b]
            return np.cos(turn) * (u - a) + np.sin(turn) * (v - b)

        def fade(t: np.ndarray) -> np.ndarray:
            return 6 * t**5 - 15 * t**4 + 10 * t**3

        low, high = (corner(a, 0) + fade(v) * (corner(a, 1) - corner(a, 0)) for a in (0, 1))
        expected = 0.007 * np.sqrt(2) * (low + fade(u) * (high - low))
        np.testing.assert_allclose(noise.perlin(key), expected, atol=2e-7)
    assert len(seen) > 2


def test_noise_in_images() -> None:
    """Only in the depth channel, within 7 mm, the same for the same state, different from step to step."""
    noisy, plain = BlockPulling(noise=noise.AMPLITUDE), BlockPulling()
    (env_state, first), (_, second) = noisy.reset(jax.random.key(0)), noisy.reset(jax.random.key(1))
    clean = plain.show(env_state)
    added = np.asarray(first.observation - clean.observation)
    assert 0.001 < np.abs(added[..., 0]).max() <= 0.007
    assert not added[..., 1].any()
    np.testing.assert_array_equal(first.state[..., 0], first.observation[..., 0])
    np.testing.assert_array_equal(first.state[..., 1], clean.state[..., 1])
    np.testing.assert_array_equal(noisy.show(env_state).observation, first.observation)
    assert (np.asarray(second.observation - plain.reset(jax.random.key(1))[1].observation) != added).any()

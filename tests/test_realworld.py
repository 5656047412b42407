"""The other world: its endings, what its sensors do, the halves of Table 1, and the command that plays there."""

import copy
import dataclasses
import json
import pathlib
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
import pytest

import configs
from envs_mjx import registry
from envs_mjx.robot import headless, real_trial, sensors, tabletop
from envs_mjx.robot.gap import GAPS, Gap
from envs_mjx.robot.real_trial import ExpertPolicy, RealEpisode
from envs_mjx.robot.realworld import IMMOVABLE, MOVABLE, NOTHING_TOUCHED, RealState, RealWorld
from envs_mjx.robot.task import NOT_FINITE, OUTCOMES, RUNNING, STOPPED, SUCCESS, TIME_LIMIT, RobotTask
from mijax import transfer

NONE = GAPS["none"]


def opengl() -> None:
    if headless.bind() is None:
        pytest.skip("neither EGL nor OSMesa can render here")


@pytest.fixture(scope="module", params=configs.ROBOTS)
def world(request: pytest.FixtureRequest) -> Iterator[RealWorld]:
    opengl()
    training = registry.make(request.param)
    assert isinstance(training, RobotTask)
    world = RealWorld(training, NONE)
    yield world
    world.close()


@pytest.fixture
def hard(world: RealWorld) -> RealWorld:
    """Another world with the hard gap. It shares the model and the cameras: they keep nothing from call to call."""
    hard = copy.copy(world)
    hard.gap = GAPS["hard"]
    return hard


# Sensors, by hand


def test_disparity_comes_in_steps() -> None:
    depth = np.linspace(0.8, 1.0, 64, dtype=np.float32).reshape(1, 8, 8)
    gap = dataclasses.replace(NONE, disparity=0.5)
    found = sensors.degraded(depth, 500.0, gap, jax.random.key(0))
    steps = 500 * 0.095 / found / 0.5
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)
    # Half a step of 0.5 pixels at 1 m: 1 / (500 x 0.095) x 0.25 = 5.3 mm.
    assert 0.003 < np.abs(found - depth).max() < 0.0055


def test_holes_are_at_edges_only() -> None:
    depth = np.ones((1, 20, 20), np.float32)
    depth[0, :, 10:] = 0.9
    found = sensors.degraded(depth, 500.0, dataclasses.replace(NONE, edge_holes=2), jax.random.key(0))
    columns = np.nonzero((found == 0).any(axis=(0, 1)))[0]
    np.testing.assert_array_equal(columns, [8, 9, 10, 11])
    assert 0.5 < (found[0, :, 8:12] == 0).mean() < 0.9
    np.testing.assert_array_equal(found[found > 0], depth[found > 0])


def test_noise_is_smooth_and_bounded() -> None:
    found = sensors.degraded(np.ones((3, 48, 64), np.float32), 500.0, dataclasses.replace(NONE, perlin=0.005),
                             jax.random.key(1)) - 1
    assert 0.001 < np.abs(found).max() <= 0.005
    assert np.abs(np.diff(found, axis=2)).max() < 0.002
    assert (found[0] != found[1]).any()


def test_no_gap_is_no_difference() -> None:
    depth = np.random.default_rng(0).random((3, 4, 5)).astype(np.float32)
    np.testing.assert_array_equal(sensors.degraded(depth, 500.0, NONE, jax.random.key(0)), depth)
    exact = sensors.calibration()
    for got, expected in zip(sensors.miscalibrated(exact, NONE, np.random.default_rng(0)), exact, strict=True):
        np.testing.assert_array_equal(got, expected)


def test_a_calibration_is_off_by_what_it_says() -> None:
    gap = Gap(0, 0, 0, camera_shift=0.003, camera_turn=0.006, disparity=0, edge_holes=0, perlin=0)
    exact, generator = sensors.calibration(), np.random.default_rng(0)
    poses = np.stack([sensors.miscalibrated(exact, gap, generator).pose for _ in range(200)])
    shift = poses[..., :3, 3] - exact.pose[:, :3, 3]
    np.testing.assert_allclose(shift.std(), 0.003, rtol=0.1)
    turn = poses[..., :3, :3] @ np.swapaxes(exact.pose[:, :3, :3], 1, 2)
    np.testing.assert_allclose(turn[..., 2, 1].std(), 0.006, rtol=0.1)


# Steps


def test_which_object_moves_is_invisible(world: RealWorld) -> None:
    shown = [world.reset(jax.random.key(3), movable)[1].observation for movable in (0, 1)]
    np.testing.assert_allclose(shown[0], shown[1], atol=1e-5)


def test_a_step_can_be_repeated_and_shows_what_it_should(hard: RealWorld) -> None:
    """Pure functions: the same arguments give the same, whatever was played in between."""
    first, _ = hard.reset(jax.random.key(0))
    action = np.array([0.5, -0.5, -1.0, 0.5], np.float32)
    once, shown = hard.step(jax.random.key(1), first, action)
    hard.step(jax.random.key(9), hard.reset(jax.random.key(8))[0], -action)
    again, shown_again = hard.step(jax.random.key(1), first, action)
    np.testing.assert_array_equal(once.physics, again.physics)
    np.testing.assert_array_equal(shown.observation, shown_again.observation)
    assert (np.asarray(shown.observation).shape, shown.observation.dtype) == ((84, 84, 2), np.float32)
    assert not np.asarray(shown.state).any()
    np.testing.assert_allclose(once.robot.qpos[:4], [0.525, -0.025, 0.15, np.pi / 16], atol=2e-3)
    assert once.seen is not once.robot  # images are late


def test_pressing_onto_an_object_is_a_protective_stop(world: RealWorld) -> None:
    env_state, _ = world.reset(jax.random.key(0), 1)
    above = world.training.object_poses(jax.tree.map(jax.numpy.asarray, env_state.robot))[0]
    if world.training.name == "drawer_opening":
        above = env_state.robot.poses[0]  # the cabinet itself
    opening = world.training.opening.finger
    place = np.asarray(above)[:2] + np.array([-opening, 0.0])  # one finger on its middle
    robot = dataclasses.replace(env_state.robot, qpos=np.concatenate([[*place, 0.1, 0.0], env_state.robot.qpos[4:]]))
    env_state = world.set_up(robot, jax.random.key(0))
    for number in range(4):
        env_state, shown = world.step(jax.random.key(number), env_state, np.array([0, 0, -1, 0], np.float32))
        if env_state.outcome != RUNNING:
            break
    assert OUTCOMES[env_state.outcome] == "protective stop"
    assert env_state.pressed > 50
    assert (bool(shown.terminated), float(shown.reward)) == (True, 0.0)
    assert env_state.first_touched == IMMOVABLE


@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_broken_simulation_and_a_broken_policy_end_the_episode(world: RealWorld) -> None:
    start = world.begin(jax.random.key(4))
    world.advance(jax.random.key(5), start, np.zeros(4))
    broken = dataclasses.replace(start, physics=np.where(start.physics == 0, np.nan, start.physics))
    for state, action in ((broken, np.zeros(4)), (start, np.array([0, np.nan, 0, 0]))):
        after = world.advance(jax.random.key(5), state, action)
        assert after.outcome == NOT_FINITE
        np.testing.assert_array_equal(after.robot.qpos, start.robot.qpos)


def test_the_expert_succeeds_whichever_comes_first(world: RealWorld) -> None:
    """Both episodes are of one scene, and of one choice of the expert."""
    policy, key = ExpertPolicy(world.training), jax.random.key(2)
    episodes = [real_trial.play_beginning_with(world, policy, key, first) for first in (IMMOVABLE, MOVABLE)]
    assert [episode.outcome for episode in episodes] == [SUCCESS, SUCCESS]
    assert [episode.first_touched for episode in episodes] == [IMMOVABLE, MOVABLE]
    assert episodes[0].length > episodes[1].length + 3
    first, second = (episode.states[0].robot for episode in episodes)
    np.testing.assert_array_equal(first.poses, second.poses)
    assert first.movable != second.movable
    assert max(episode.states[-1].pressed for episode in episodes) < 30
    if world.training.name == "block_pulling":
        frames = real_trial.frames(world, episodes[1])
        assert len(frames) == episodes[1].length + 1
        assert frames[0].shape == frames[-1].shape


def test_there_are_blocks_and_drawers_only() -> None:
    task: Any = object()
    with pytest.raises(TypeError, match="no scene for object"):
        tabletop.build(task)


# The table


def test_halves_are_counted_by_what_was_touched_first() -> None:
    def episode(outcome: int, first: int, length: int) -> RealEpisode:
        state = object.__new__(RealState)
        for name, value in (("outcome", outcome), ("first_touched", first)):
            object.__setattr__(state, name, value)
        return RealEpisode([state] * (length + 1))

    rows = real_trial.halves([episode(SUCCESS, IMMOVABLE, 20), episode(STOPPED, IMMOVABLE, 10),
                              episode(SUCCESS, MOVABLE, 8), episode(TIME_LIMIT, NOTHING_TOUCHED, 50)])
    got = [(row.name, row.episodes, row.success, row.protective_stops, row.misses, row.mean_length) for row in rows]
    assert got == [("the immovable object", 2, 1, 1, 0, 15.0), ("the movable object", 1, 1, 0, 0, 8.0),
                   ("neither", 1, 0, 0, 1, 50.0), ("all", 4, 2, 1, 1, 22.0)]
    lines = transfer.table(rows).splitlines()
    assert lines[0].split() == ["touched", "first", "success", "protective", "stop", "miss", "mean", "length"]
    assert lines[-1].split() == ["all", "2/4", "1/4", "1/4", "22.0"]
    assert len({len(line) for line in lines}) == 1


@pytest.mark.parametrize(("arguments", "message"), [
    ((), "got no run folder, accepted: one, or --planner with --domain"),
    (("runs/x", "--gap", "huge"), "--gap: got 'huge', accepted: none, mild, hard"),
    (("runs/x", "--episodes", "0"), "--episodes: got 0, accepted: a number >= 1"),
    (("--planner",), "--planner: got True, accepted: with --domain, one of block_pulling, block_pushing, drawer"),
    (("--planner", "--domain", "sphinx"), "--domain: got 'sphinx', accepted: with --planner a robot task: block_pul"),
    (("runs/x", "--planner", "--domain", "block_pulling"), "--planner: got 'runs/x', accepted: no run folder"),
    (("--planner", "--domain", "block_pulling", "--seeds", "2"), "--seeds: got '2', accepted: with a run only"),
    (("runs/x", "--domain", "block_pulling"), "--domain: got 'block_pulling', accepted: with --planner only"),
    (("nowhere",), "nowhere: no such run folder"),
])
def test_bad_input_is_one_line(arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert transfer.main(arguments) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1
    assert message in captured.err


def test_a_run_of_another_kind_is_refused(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = dataclasses.asdict(configs.preset("heaven_hell"))
    (tmp_path / "config.json").write_text(json.dumps(config))
    assert transfer.main([str(tmp_path)]) == 1
    assert "accepted: a run on a robot task (block_pulling, block_pushing, drawer_opening), not on heaven_hell" in (
        capsys.readouterr().err)


@pytest.mark.slow
@pytest.mark.parametrize("domain", configs.ROBOTS)
def test_the_expert_from_the_command_line(
    domain: str, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    opengl()
    arguments = ["--planner", "--domain", domain, "--episodes", "20", "--gap", "none", "--gif", "--out", str(tmp_path)]
    assert transfer.main(arguments) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("all"))
    assert int(line.split()[1].split("/")[0]) >= 19
    assert (tmp_path / "success.gif").exists()
    stored = json.loads((tmp_path / "transfer.json").read_text())
    assert [episode["touched_first"] for episode in stored["episodes"]] == ["immovable", "movable"] * 10
    assert stored["played"] == f"{domain}, the scripted expert, gap none"
    assert stored["versions"]["jax"]


@pytest.mark.slow
@pytest.mark.lenient
def test_a_run_from_the_command_line(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An agent that has learnt nothing yet."""
    opengl()
    from mijax import train

    run = tmp_path / "run"
    assert train.main([
        "--domain", "block_pulling", "--agent", "base", "--steps", "200", "--sac.demonstrations", "2",
        "--sac.replay-steps", "2000", "--sac.batch-episodes", "2", "--sac.pretrain-updates", "2",
        "--stage1.episodes", "20", "--stage1.heldout-episodes", "10", "--stage1.epochs", "1",
        "--stage1.batch-size", "50", "--evaluation.every", "100", "--evaluation.episodes", "2", "--out", str(run)]) == 0
    capsys.readouterr()
    assert transfer.main([str(run), "--episodes", "2", "--gap", "hard", "--gif"]) == 0
    said = capsys.readouterr().out
    assert "block_pulling, base, seed 0" in said
    assert (run / "transfer_hard" / "seed_0" / "transfer.json").exists()
    assert list((run / "transfer_hard" / "seed_0").glob("*.gif"))

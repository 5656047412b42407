"""Dynamics, endings and experts of the robot tasks."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import configs
import envs_mjx.robot
from envs_mjx import registry
from envs_mjx.robot import BlockPulling, BlockPushing, DrawerOpening, drawer_opening, scene, window
from envs_mjx.robot.blocks import square_gap
from envs_mjx.robot.planner import Planner, PlannerState, Trajectory, demonstrations
from envs_mjx.robot.rotation import rotate_action
from envs_mjx.robot.task import (
    LEFT,
    NOT_FINITE,
    RUNNING,
    STOPPED,
    SUCCESS,
    TIME_LIMIT,
    RobotState,
    RobotTask,
    moments_in_view,
)
from envs_mjx.robot.trial import policy_trial
from mijax.demonstrations import demonstrate

DOMAINS = configs.ROBOTS


def make(name: str) -> RobotTask:
    env = registry.make(name)
    assert isinstance(env, RobotTask)
    return env


def replay(env: RobotTask, trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Play the actions of one episode from its first state with the same model, in float64, solved to the end.

    With the 4 iterations that are enough for MJX, C's own Newton solver at times pushes an object the wrong way when a
    contact opens (by 5 mm, measured); with 100 both agree.

    Returns:
        qpos: (length + 1, nq); over: (length + 1,) bool, whether the task is solved.
    """
    start: RobotState = jax.tree.map(lambda x: x[0], trajectory.states)
    solved = jax.jit(lambda qpos: env.solved(dataclasses.replace(start, qpos=qpos)))
    model = copy.copy(env.physics.model)
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 100, 50, 1e-8
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    scene.place(model, env.placed, np.asarray(env.placed_poses(start), np.float64))
    data.qpos[:] = start.qpos
    places, over = [np.array(data.qpos)], [False]
    for action in np.asarray(trajectory.actions[: int(trajectory.length)], np.float64):
        begin = data.qpos[:4].copy()
        target = begin + np.clip(action, -1, 1) * scene.ACTION_SCALE
        target[:3] = np.clip(target[:3], scene.WORKSPACE_LOW, scene.WORKSPACE_HIGH)
        done = over[-1]
        for substep in range(1, scene.SUBSTEPS + 1):
            if not done:
                data.ctrl[:] = begin + (target - begin) * min(substep / scene.RAMP_SUBSTEPS, 1)
                mujoco.mj_step(model, data)  # pyright: ignore[reportAttributeAccessIssue]
                done = bool(solved(jnp.asarray(data.qpos, jnp.float32)))
        places.append(np.array(data.qpos))
        over.append(done)
    return np.stack(places), np.array(over)


def largest_object_error(env: RobotTask, trajectory: Trajectory, places: np.ndarray) -> float:
    """Metres: between the movable object's joint positions in MJX and in C, over an episode. Yaw does not count."""
    slides = slice(4, 6) if env.physics.model.nq > 5 else slice(4, 5)
    return float(np.abs(np.asarray(trajectory.states.qpos)[: len(places), slides] - places[:, slides]).max())


# Geometry


def test_gap_of_squares() -> None:
    def gap(x: float, y: float, yaw: float) -> float:
        first, second = jnp.array([0.2, 0.1, 0.3]), jnp.array([x, y, yaw])
        cos, sin = jnp.cos(0.3), jnp.sin(0.3)
        turned = jnp.stack([cos * second[0] - sin * second[1] + 0.2, sin * second[0] + cos * second[1] + 0.1,
                            second[2] + 0.3])
        both = square_gap(first, turned, 0.05), square_gap(turned, first, 0.05)
        np.testing.assert_allclose(both[0], both[1], atol=1e-6)
        return float(both[0])

    np.testing.assert_allclose(gap(0.12, 0.03, 0.0), 0.02, atol=1e-6)  # face to face
    np.testing.assert_allclose(gap(0.13, 0.14, 0.0), 0.05, atol=1e-6)  # corner to corner: 3-4-5
    np.testing.assert_allclose(gap(0.15, 0.0, np.pi / 4), 0.15 - 0.05 - 0.05 * np.sqrt(2), atol=1e-6)
    assert gap(0.09, 0.03, 0.0) < 0
    assert gap(0.11, 0.0, np.pi / 4) < 0


def test_draws_are_those_of_the_paper() -> None:
    keys = jax.random.split(jax.random.key(0), 2000)
    poses = np.asarray(jax.vmap(make("block_pulling").draw)(keys)[0])
    x, y = np.moveaxis(poses[..., :2], -1, 0)
    np.testing.assert_array_equal(x[:, 0], x[:, 1])
    assert 0.385 <= x.min() < 0.39 < 0.61 < x.max() <= 0.615
    assert 0.17 <= (y[:, 1] - y[:, 0]).min() < 0.172
    # Uniform on the triangle y1 >= y0 + 0.17 within +-0.115: the mean gap is 0.17 + 0.06 / 3.
    np.testing.assert_allclose((y[:, 1] - y[:, 0]).mean(), 0.19, atol=1e-3)
    assert -0.115 <= y.min() < -0.114
    poses, goal = jax.vmap(make("block_pushing").draw)(keys)
    places = np.asarray(poses[..., :2]) - scene.CENTRE
    apart = np.linalg.norm(places[:, 0] - places[:, 1], axis=-1)
    to_pad = np.linalg.norm(places - (np.asarray(goal) - scene.CENTRE)[:, None], axis=-1)
    assert np.abs(places).max() <= 0.14
    assert np.abs(np.asarray(goal) - scene.CENTRE).max() <= 0.135
    assert apart.min() > 0.12
    assert to_pad.min() > 0.09
    assert (apart[:, None] + to_pad[:, ::-1] - to_pad).min() > 0.1
    poses = np.asarray(jax.vmap(make("drawer_opening").draw)(keys)[0])
    m0, m1 = (np.stack([np.cos(poses[:, 0, 2] + turn), np.sin(poses[:, 0, 2] + turn)], axis=1)
              for turn in (0, np.pi / 2))
    away = np.sum((poses[:, 0, :2] - scene.CENTRE) * m0, axis=1)
    assert 0.15 <= away.min() + 1e-6 < away.max() <= 0.20 + 1e-6
    np.testing.assert_allclose(poses[:, 1, :2] - poses[:, 0, :2], 0.12 * m1, atol=1e-6)


# Single steps, ten cubes at once


@pytest.fixture(scope="module")
def pushed() -> tuple[RobotState, RobotState, RobotState]:
    """Ten situations of Block-Pushing, and what follows after one and after two steps."""
    env = BlockPushing(stop_force=12.5)
    base = env.reset(jax.random.key(0))[0]

    def situation(gripper, cube, time: int = 0, velocity: float = 0.0) -> RobotState:
        poses = jnp.array([[0.32, -0.18, 0.0], [0.68, 0.18, 0.0]], jnp.float32)
        qpos = jnp.array([*gripper, *cube], jnp.float32)
        return dataclasses.replace(base, qpos=qpos, qvel=jnp.zeros(7).at[4].set(velocity), poses=poses,
                                   goal=jnp.array([0.5, 0.13]), movable=jnp.int32(0), time=jnp.int32(time))

    def pushing(quarters: int) -> RobotState:
        """The cube 6 cm before the gripper, askew and to the side, all turned about the middle of the workspace."""
        turn = quarters * np.pi / 2
        cos, sin = np.cos(turn), np.sin(turn)
        place = 0.5 + cos * 0.008 - sin * 0.06, sin * 0.008 + cos * 0.06
        state = situation((0.5, 0.0, 0.03, turn), (*place, 0.3 + turn))
        return dataclasses.replace(state, goal=jnp.array([0.4, 0.3]))  # far from anywhere it goes

    far = (0.6, -0.15)
    situations = [
        situation((0.5, 0.0, 0.2, 0.0), (*far, 0.3), time=49), *map(pushing, range(4)),
        situation((0.5, 0.0, 0.2, 0.0), (*far, 0.3)), situation((0.5, 0.0, 0.2, 0.0), (0.76, 0.0, 0.3)),
        situation((0.5, 0.0, 0.2, 0.0), (0.5, 0.07, 0.3), velocity=0.0),
        # A finger above the other cube, low and high.
        *(situation((0.644, 0.18, height, 0.0), (*far, 0.3)) for height in (0.065, 0.12))]
    situations[7] = dataclasses.replace(situations[7], qpos=situations[7].qpos.at[5].set(0.09))
    actions = jnp.array([[1.0, -1.0, 0.5, 1.0], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0],
                         [1.0, 0.0, 0.0, 0.0], [jnp.nan, 0.0, 0.0, 0.0], [0.0] * 4, [0.0] * 4,
                         [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, -1.0, 0.0]])
    before = jax.tree.map(lambda *x: jnp.stack(x), *situations)
    step = jax.jit(jax.vmap(lambda s, a: env.step(jax.random.key(0), s, a)[0]))
    after = step(before, actions)
    return before, after, step(after, jnp.nan_to_num(actions))


def test_the_gripper_arrives(pushed) -> None:
    before, after, _ = pushed
    expected = np.asarray(before.qpos)[0, :4] + [0.05, -0.05, 0.025, np.pi / 8]
    np.testing.assert_allclose(after.qpos[0, :3], expected[:3], atol=2.5e-3)
    np.testing.assert_allclose(after.qpos[0, 3], expected[3], atol=0.02)


def test_the_target_stays_in_the_workspace() -> None:
    target = scene.target_of(jnp.array([0.69, -0.19, 0.02, 3.0, 0.0]), jnp.array([1.0, -2.0, -1.0, 1.0]))
    np.testing.assert_allclose(target, [0.7, -0.2, 0.01, 3.0 + np.pi / 8], atol=1e-6)


def test_pushing_turns_with_the_scene(pushed) -> None:
    """A quarter turn of scene and action turns what follows: the physics prefers no direction of the four."""
    _, after, later = pushed
    for state in (after, later):
        qpos = np.asarray(state.qpos, np.float64)[1:5]
        assert np.hypot(qpos[:, 4] - 0.5, qpos[:, 5]).min() > 0.07  # pushed
        for quarters in range(1, 4):
            turn = quarters * np.pi / 2
            matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
            for first in (0, 4):
                expected = matrix @ (qpos[0, first : first + 2] - scene.CENTRE) + scene.CENTRE
                np.testing.assert_allclose(qpos[quarters, first : first + 2], expected, atol=5e-4)
            np.testing.assert_allclose(qpos[quarters, 6], qpos[0, 6] + turn, atol=0.02)


def test_what_is_not_finite_ends_the_episode_and_stays_out(pushed) -> None:
    before, after, _ = pushed
    assert after.outcome[5] == NOT_FINITE
    np.testing.assert_array_equal(after.qpos[5], before.qpos[5])


def test_endings(pushed) -> None:
    env, after = BlockPushing(), pushed[1]
    np.testing.assert_array_equal(
        after.outcome, [TIME_LIMIT, *[RUNNING] * 4, NOT_FINITE, LEFT, SUCCESS, STOPPED, RUNNING])
    shown = jax.vmap(env.show)(after)
    np.testing.assert_array_equal(shown.reward, [0, 0, 0, 0, 0, 0, 0, 1, 0, 0])
    np.testing.assert_array_equal(shown.terminated, [0, 0, 0, 0, 0, 1, 1, 1, 1, 0])
    np.testing.assert_array_equal(shown.truncated, [1, 0, 0, 0, 0, 0, 0, 0, 0, 0])
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(shown))


# Experts


@pytest.fixture(scope="module", params=DOMAINS)
def played(request: pytest.FixtureRequest) -> tuple[RobotTask, Trajectory, np.ndarray]:
    """32 episodes of an expert; the even ones begin with the immovable object."""
    env = make(request.param)
    first = jnp.arange(32) % 2
    play = jax.jit(lambda keys: jax.lax.map(lambda x: Planner(env).play(*x), (keys, first), batch_size=16))
    return env, jax.device_get(play(jax.random.split(jax.random.key(4), 32))), np.asarray(first)


def test_experts_succeed(played) -> None:
    _, episodes, first = played
    assert episodes.success.mean() > 0.96
    lengths = [np.median(episodes.length[first == which]) for which in (0, 1)]
    assert lengths[1] + 8 <= lengths[0] <= lengths[1] + 16  # what changing over costs
    assert 12 <= episodes.length.mean() <= 18.5  # the paper's 15.3, 15.5, 15.4 within 20 %
    moves = np.abs(np.diff(episodes.states.qpos[:, :, 4:], axis=1)).max(axis=(1, 2))
    assert (moves[episodes.success] > 0.01).all()
    assert np.isfinite(episodes.states.qpos).all()
    assert (np.abs(episodes.actions) <= 1).all()


def test_the_same_actions_in_mujoco_c(played) -> None:
    env, episodes, _ = played
    for index in range(4):
        episode = jax.tree.map(lambda x, i=index: x[i], episodes)
        places, over = replay(env, episode)
        assert over[-1] == episode.success
        assert largest_object_error(env, episode, places) < 0.005


def test_images_come_back_from_a_trajectory(played) -> None:
    env, episodes, _ = played
    end = int(episodes.length[0])
    last = jax.tree.map(lambda x: jnp.asarray(x[0, end]), episodes.states)
    shown = env.show(last)
    assert shown.reward == 1
    assert shown.terminated
    assert (np.asarray(env.show(jax.tree.map(lambda x: jnp.asarray(x[0, end - 1]), episodes.states)).reward) == 0).all()


@pytest.mark.parametrize(("task", "begin", "end"), [
    (BlockPulling, (0.42, 0.05), (0.6, 0.05)), (BlockPushing, (0.5, -0.03), (0.5, 0.215)),
    (DrawerOpening, (0.5, 0.05), (0.3, 0.05))])
def test_strokes(task: type[RobotTask], begin: tuple[float, float], end: tuple[float, float]) -> None:
    """The object is at (0.5, 0.05), the other one 10 cm along x from it, the pad 13.5 cm along y."""
    stroke = task().stroke(jnp.array([0.5, 0.05, 0.0]), jnp.array([0.6, 0.05, 0.0]), jnp.array([0.5, 0.185]))
    np.testing.assert_allclose([stroke.begin, stroke.end], [begin, end], atol=1e-6)
    way = np.subtract(end, begin)
    np.testing.assert_allclose(stroke.forth, way / np.linalg.norm(way), atol=1e-6)


@pytest.mark.parametrize("domain", DOMAINS)
def test_an_expert_knows_its_task_by_any_name(domain: str) -> None:
    env = make(domain)
    named = type("Mine", (type(env),), {"name": "mine"})()
    env_state, _ = env.reset(jax.random.key(0))
    action, other = (expert.act(expert.start_with(jnp.int32(0), env_state), env_state)[0]
                     for expert in (Planner(env), Planner(named)))
    np.testing.assert_array_equal(action, other)


@pytest.mark.parametrize("domain", DOMAINS)
def test_an_expert_begins_with_the_nearer_object_where_an_imitator_would_go_between_both(domain: str) -> None:
    env = make(domain)

    def chosen_and_nearer(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        env_state = env.reset(key)[0]
        distance = jnp.linalg.norm(env.object_poses(env_state)[:, :2] - env_state.qpos[None, :2], axis=1)
        return Planner(env).start(key, env_state).chosen, jnp.argmin(distance)

    chosen, nearer = jax.jit(jax.vmap(chosen_and_nearer))(jax.random.split(jax.random.key(0), 64))
    share = float((chosen == nearer).mean())
    assert share == 1 if domain in ("block_pushing", "drawer_opening") else 0.3 < share < 0.7


def test_changing_over() -> None:
    """An expert whose object stands still works on the other one, after retreating for two steps."""
    env = DrawerOpening()
    state = env.reset(jax.random.key(1))[0]
    for changes_over in (True, False):
        expert = Planner(env, changes_over)
        patience = env.plan.patience
        memory = dataclasses.replace(expert.start_with(jnp.int32(1), state), stage=jnp.int32(2))
        hook = env.object_poses(state)[1]
        still = dataclasses.replace(state, qpos=state.qpos.at[:4].set(jnp.concatenate([hook[:2], jnp.array([
            env.plan.work]), hook[2:] + np.pi / 2])))
        actions, chosen = [], []
        for _ in range(patience + 3):
            action, memory = expert.act(memory, still)
            actions.append(action)
            chosen.append(int(memory.chosen))
        assert chosen == [1] * patience + [0 if changes_over else 1] * 3
        ups = [bool(np.allclose(action, [0, 0, 1, 0])) for action in actions]
        assert ups == [False] * patience + [changes_over] * 2 + [False]


def test_an_expert_stays_with_what_it_has_moved() -> None:
    """It begins anew there, where one whose object never moved changes over."""
    env = BlockPushing()
    state = env.reset(jax.random.key(1))[0]
    expert = Planner(env)
    for moved in (False, True):
        memory = dataclasses.replace(expert.start_with(jnp.int32(0), state), stage=jnp.int32(2))
        if moved:
            memory = dataclasses.replace(memory, seen=memory.seen - 0.01)
        stages = []
        for _ in range(env.plan.patience + 2):
            stages.append(int(memory.stage))
            _, memory = expert.act(memory, state)
        assert stages[-1] == 0
        assert int(memory.chosen) == (0 if moved else 1)


@pytest.mark.parametrize("angle", [0.7, 2.0, 3.9])
def test_an_expert_of_a_turned_scene_does_the_turned_action(angle: float) -> None:
    env = BlockPulling()
    expert = Planner(env)
    for seed in range(4):
        state = env.reset(jax.random.key(seed))[0]
        actions = [expert.act(expert.start_with(shown.movable, shown), shown)[0]
                   for shown in (state, env.turn(state, jnp.float32(angle)))]
        assert np.linalg.norm(actions[0][:2]) == pytest.approx(1.0, abs=1e-5)
        np.testing.assert_allclose(rotate_action(actions[0], jnp.float32(angle))[:3], actions[1][:3], atol=1e-5)


def without_physics(env: RobotTask, key: jax.Array, env_state: RobotState, action: jax.Array
                    ) -> tuple[RobotState, None]:
    """A step in which nothing is touched."""
    del key
    moved = env_state.qpos.at[:4].set(scene.target_of(env_state.qpos, action))
    time = env_state.time + 1
    outcome = jnp.where(time >= env.horizon, TIME_LIMIT, RUNNING)
    return dataclasses.replace(env_state, qpos=moved, time=time, outcome=outcome), None


def test_a_shaky_expert_sees_where_it_went(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside what was done is what the expert meant to do in the recorded states. Nothing is touched."""
    monkeypatch.setattr(DrawerOpening, "step", without_physics)
    env, noise = DrawerOpening(expert_noise=0.1), 0.1
    shown = jax.jit(lambda key: demonstrations(env, key, 32))(jax.random.key(0))
    same = jax.jit(lambda key: jax.lax.map(Planner(env, noise=noise).play, jax.random.split(key, 48), batch_size=16))
    np.testing.assert_array_equal(shown.actions, same(jax.random.key(0)).actions[:32])  # no success: order is kept

    def intended(states: RobotState, first: jax.Array) -> jax.Array:
        expert = Planner(env)
        start = expert.start_with(first, jax.tree.map(lambda x: x[0], states))

        def act(memory: PlannerState, state: RobotState) -> tuple[PlannerState, jax.Array]:
            action, memory = expert.act(memory, state)
            return memory, action

        return jax.lax.scan(act, start, states)[1]

    states = jax.tree.map(lambda x: x[:, :-1], shown.states)
    meant = np.asarray(jax.jit(jax.vmap(intended))(states, shown.first))
    np.testing.assert_allclose(shown.intended, meant, atol=1e-5)
    free = np.abs(meant) < 0.5  # not cut off at the largest action
    assert np.std((shown.actions - meant)[free]) == pytest.approx(noise, rel=0.05)
    assert np.abs(shown.actions).max() <= 1


def test_an_expert_that_fails_half_the_time_plays_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forty-eight episodes a round, for 32 demonstrations: successes of the first round, then of the second."""
    def step(env: RobotTask, key: jax.Array, env_state: RobotState, action: jax.Array) -> tuple[RobotState, None]:
        moved, _ = without_physics(env, key, env_state, action)
        return dataclasses.replace(moved, outcome=jnp.where(moved.movable == 1, SUCCESS, moved.outcome)), None

    monkeypatch.setattr(DrawerOpening, "step", step)
    env, key = DrawerOpening(), jax.random.key(0)
    shown = jax.jit(lambda key: demonstrations(env, key, 32))(key)
    assert shown.success.all()
    play = jax.jit(lambda key: jax.lax.map(Planner(env, noise=env.expert_noise).play, jax.random.split(key, 48)))
    rounds = [play(k) for k in (key, jax.random.fold_in(key, 48 + 1))]
    poses = np.concatenate([np.asarray(r.states.poses)[np.asarray(r.success)] for r in rounds])
    np.testing.assert_array_equal(shown.states.poses, poses[:32])


def test_the_closed_gripper_fits_between_a_handle_s_side_bars() -> None:
    width = 2 * (window.CLOSED.finger + window.FINGER_RADIUS)
    assert width + 0.015 < drawer_opening.SIDE_APART - 2 * drawer_opening.SIDE_RADIUS


def test_arguments_of_a_task() -> None:
    assert registry.make("block_pushing,stop_force=12.5,noise=0.007").stop_force == 12.5  # pyright: ignore
    for name, value, got in (("expert_noise", "-1", "-1"), ("noise", "abc", "'abc'"), ("noise", "1e999", "inf"),
                             ("stop_force", "True", "True")):
        with pytest.raises(registry.UnknownDomain, match=f"{name}: got {got}, accepted: a finite number >= 0"):
            registry.make(f"block_pushing,{name}={value}")


def test_a_policy_accepts_as_much_noise_as_it_was_trained_with() -> None:
    for noise, margin in ((0.0, 0.021), (0.05, 0.05)):
        env = registry.make(f"block_pulling,noise={noise}")
        assert env.interface.observation_range == pytest.approx((-margin, window.DEEPEST + margin))


def test_a_task_whose_import_fails_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    class NoGraphics:
        @staticmethod
        def import_module(name: str) -> None:
            raise AttributeError(f"{name}: no attribute 'glGetError'")  # as MuJoCo does where MUJOCO_GL cannot be had

    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setattr(envs_mjx.robot, "importlib", NoGraphics)
    cause = r"ImportError: .*block_pushing: no attribute 'glGetError' \(MUJOCO_GL is 'osmesa'\)"
    with pytest.raises(registry.UnknownDomain, match=cause):
        registry.make("block_pushing")


@pytest.mark.slow
@pytest.mark.parametrize("domain", [*DOMAINS, "drawer_opening,stop_force=12.5"])
def test_eighty_demonstrations_from_one_call(domain: str) -> None:
    """Also where three episodes in five of the expert end in a protective stop."""
    demos = demonstrate(make(domain), jax.random.key(0), 80)
    assert demos.action.shape == (80, 50, 4)
    assert demos.success.all()


@pytest.mark.slow
@pytest.mark.parametrize("domain", DOMAINS)
def test_never_changing_over_fails_half_the_time(domain: str) -> None:
    env = make(domain)
    play = jax.jit(lambda keys: jax.lax.map(Planner(env, changes_over=False).play, keys, batch_size=16))
    assert 0.35 < play(jax.random.split(jax.random.key(1), 128)).success.mean() < 0.65


@pytest.mark.slow
@pytest.mark.parametrize("domain", DOMAINS)
def test_200_episodes_in_mujoco_c(domain: str) -> None:
    env = make(domain)
    play = jax.jit(lambda keys: jax.lax.map(Planner(env).play, keys, batch_size=16))
    episodes = jax.device_get(play(jax.random.split(jax.random.key(2), 200)))
    errors, agree = [], []
    for index in range(200):
        episode = jax.tree.map(lambda x, i=index: x[i], episodes)
        places, over = replay(env, episode)
        agree.append(over[-1] == episode.success)
        errors.append(largest_object_error(env, episode, places))
    assert np.mean(agree) >= 0.98
    assert np.mean(np.array(errors) < 0.005) >= 0.98


@pytest.mark.slow
@pytest.mark.lenient
def test_a_trial_of_a_policy_tells_what_was_touched_first():
    """Against one episode after the other, of a gripper that goes down and to one side."""
    env = make("block_pulling")
    key, episodes = jax.random.key(5), 20
    towards = jnp.array([0.0, -1.0, -1.0, 0.0])

    def act(memory, observation, previous_action):
        return memory + 1, jnp.broadcast_to(towards, previous_action.shape)

    played = policy_trial(
        env, act, lambda batch: jnp.zeros(batch, jnp.int32), lambda batch: jnp.zeros((batch, 4)), key, episodes)
    keys = jax.random.split(key, (2, 16)).reshape(-1)[:episodes]
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    for number in range(4):
        env_state, _ = reset(keys[number])
        first = None
        for time in range(env.horizon):
            later, timestep = step(jax.random.fold_in(keys[number], time), env_state, towards)
            if first is None and bool(later.touched):
                apart = np.linalg.norm(np.asarray(env.object_poses(later))[:, :2] - np.asarray(later.qpos)[:2], axis=1)
                first = int(np.argmin(apart)) == int(later.movable)
            env_state = later
            if bool(timestep.done):
                break
        assert played.length[number] == int(env_state.time)
        assert played.outcome[number] == int(env_state.outcome)
        assert np.asarray(played.touched)[number] == (first is not None)
        if first is not None:
            assert played.movable_first is not None
            assert played.movable_first[number] == first


def test_moments_tell_where_things_are_and_not_which_is_which():
    near, far = np.array([0.03, -0.06]), np.array([-0.12, 0.1])
    number, x, y, difference, product, total = np.asarray(moments_in_view(jnp.stack([near, far])))
    np.testing.assert_allclose((number, x, y), (2.0, *(near + far)), atol=1e-6)
    products = np.array([[total + difference, product], [product, total - difference]])  # 2 (a a^T + b b^T)
    np.testing.assert_allclose(products - np.outer((x, y), (x, y)), np.outer(near - far, near - far), atol=1e-6)
    np.testing.assert_allclose(moments_in_view(jnp.stack([far, near])), moments_in_view(jnp.stack([near, far])))
    beyond = np.array([0.225, 0.0])
    alone = moments_in_view(jnp.asarray(near)[None])
    np.testing.assert_allclose(moments_in_view(jnp.stack([near, beyond])), alone, atol=1e-6)
    np.testing.assert_allclose(moments_in_view(jnp.array([[0.2, 0.0]]))[:2], [0.5, 0.1], atol=1e-6)

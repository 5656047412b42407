"""Other libraries' environments as ours, and ours as theirs."""

import functools
import pathlib
from typing import Any

import gymnasium
import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnax.environments import spaces as gymnax_spaces
from gymnax.wrappers import FlattenObservationWrapper

from envs_mjx import registry
from envs_mjx.adapters.gymnasium import AsGymnasium, FromGymnasium
from envs_mjx.adapters.gymnax import FromGymnax
from envs_mjx.base import ContinuousActions, Variable
from envs_mjx.contract import check_contract
from examples.gymnasium_memory import LENGTH, Maze, TMaze
from mijax import train
from mijax.run_folder import RunFolder

ROBOTS = {"block_pulling", "block_pushing", "drawer_opening"}


@pytest.mark.filterwarnings("ignore:.*A Box observation space m")
@pytest.mark.parametrize("name", [
    pytest.param(name, marks=[pytest.mark.slow] if name in ROBOTS else []) for name in registry.names()])
def test_every_domain_passes_gymnasiums_own_check(name: str):
    check_env(AsGymnasium(name), skip_render_check=True)


def test_an_episode_from_the_host_is_an_episode():
    env, ours = AsGymnasium("heaven_hell"), registry.make("heaven_hell")
    with pytest.raises(gymnasium.error.ResetNeeded):
        AsGymnasium("heaven_hell").step(0)
    seen, info = env.reset(seed=3)
    again, _ = env.reset(seed=3)
    np.testing.assert_array_equal(seen, again)
    _, key = jax.random.split(jax.random.key(3))
    np.testing.assert_array_equal(info["state"], ours.reset(key)[1].state)
    side = info["state"][2]
    for action in (1, 1, 1, *[0 if side > 0 else 2] * 3):
        seen, reward, terminated, truncated, info = env.step(action)
    assert (reward, terminated, truncated, info["success"]) == (1.0, True, False, True)
    assert env.state_space.contains(info["state"])
    sides = {float(env.reset()[1]["state"][2]) for _ in range(20)}
    assert sides == {-1.0, 1.0}
    env.reset(seed=0)
    ends = [env.step(3)[3] for _ in range(ours.horizon)]
    assert ends == [False] * (ours.horizon - 1) + [True]


@pytest.mark.lenient  # their arithmetic mixes types
def test_a_gymnax_environment_keeps_our_contract():
    env = registry.make("examples.gymnax_memory:MemoryChain")
    check_contract(env)
    assert [(v.name, v.hidden) for v in env.variables] == [("context", True), ("query", False), ("time", False)]
    step = jax.jit(env.step)
    bits = set()
    for seed in range(8):
        state, timestep = env.reset(jax.random.key(seed))
        bit = int(timestep.state[0])
        bits.add(bit)
        for time in range(1, 7):
            assert not timestep.done
            state, timestep = step(jax.random.key(time), state, jnp.int32(bit))
            np.testing.assert_array_equal(timestep.state, [bit, 0, time])
        assert timestep.terminated and timestep.reward == 1  # noqa: PT018
    assert bits == {0, 1}


@pytest.mark.lenient
def test_gymnax_bounds_and_time_limits():
    env = FromGymnax(*gymnax.make("Pendulum-v1"), horizon=3)
    assert isinstance(env.action_spec, ContinuousActions)
    check_contract(env)
    state, _ = env.reset(jax.random.key(0))
    for time in range(3):
        state, timestep = env.step(jax.random.key(1), state, jnp.ones((1,)))
        assert bool(timestep.truncated) == (time == 2)
    theirs, params = gymnax.make("Pendulum-v1")
    state, _ = env.reset(jax.random.key(0))
    expected = theirs.step_env(jax.random.key(1), state[0], jnp.array([2.0]), params)
    np.testing.assert_allclose(env.step(jax.random.key(1), state, jnp.ones((1,)))[1].reward, expected[2], rtol=1e-6)


@pytest.mark.lenient
def test_what_does_not_fit_is_named():
    with pytest.raises(ValueError, match="no field 'contex', accepted: time, context"):
        FromGymnax(*gymnax.make("MemoryChain-bsuite"), hidden=("contex",))
    env, params = gymnax.make("Catch-bsuite")
    with pytest.raises(ValueError, match="FlattenObservationWrapper is no environment of gymnax"):
        FromGymnax(FlattenObservationWrapper(env), params)  # pyright: ignore[reportArgumentType]
    endless, params = gymnax.make("Pendulum-v1")
    endless.action_space = lambda params=None: gymnax_spaces.Box(-np.inf, np.inf, (1,))
    with pytest.raises(ValueError, match="or a flat Box with bounds"):
        FromGymnax(endless, params)


@pytest.mark.lenient
def test_gymnax_observations_of_other_shapes_are_flattened():
    for name, size in (("Catch-bsuite", 50), ("DeepSea-bsuite", 64)):
        env = FromGymnax(*gymnax.make(name), horizon=5)
        assert env.observation_spec.shape == (size,)
        check_contract(env)


def play(env: FromGymnasium, keys: jax.Array, actions: jax.Array) -> tuple:
    """Compiled: (T, E, ...) time steps of E episodes under (T, E, ...) actions, and the last moment."""

    @jax.jit
    def run(keys: jax.Array, actions: jax.Array) -> tuple:
        def step(moment: Any, action: jax.Array) -> tuple:
            return jax.vmap(env.step)(keys, moment, action)

        return jax.lax.scan(step, jax.vmap(env.reset)(keys)[0], actions)

    return run(keys, actions)


def test_a_gymnasium_environment_keeps_our_contract():
    check_env(TMaze(), skip_render_check=True)
    env = registry.make("examples.gymnasium_memory:Maze")
    check_contract(env)
    actions = jnp.array([[0] * 8] * LENGTH + [[1] * 8] + [[0] * 8] * 2, jnp.int32)  # left, then two steps too many
    moment, steps = play(Maze(), jax.random.split(jax.random.key(0), 8), actions)
    side = np.asarray(moment.state[:, 1])
    assert set(side) == {-1.0, 1.0}
    np.testing.assert_array_equal(steps.state[:, :, 1], np.tile(side, (LENGTH + 3, 1)))
    np.testing.assert_array_equal(steps.observation[:, :, 1], np.zeros((LENGTH + 3, 8)))
    np.testing.assert_array_equal(steps.reward[LENGTH], -side)
    np.testing.assert_array_equal(steps.terminated[:LENGTH + 1].any(axis=1), [False] * LENGTH + [True])
    np.testing.assert_array_equal(steps.reward[LENGTH + 1 :], np.zeros((2, 8)))
    np.testing.assert_array_equal(moment.time, [LENGTH + 1] * 8)
    np.testing.assert_array_equal(jax.vmap(env.ground_truth)(moment), moment.state)
    waits = play(Maze(), jax.random.split(jax.random.key(0), 8), jnp.ones((20, 8), jnp.int32))[1]
    np.testing.assert_array_equal(waits.truncated[:, 0], [False] * 19 + [True])
    assert not waits.terminated.any()


def test_moments_of_the_host_may_be_stepped_in_any_order():
    """What a simulator no longer holds is played again: a moment twice, in another process, with little room."""
    env, small = Maze(), Maze()
    small._room = 1
    small._make_room = lambda batch: None
    keys = jax.random.split(jax.random.key(1), 5)
    actions = jax.random.randint(jax.random.key(2), (12, 5), 0, 3, jnp.int32)
    last, steps = play(env, keys, actions)
    other, again = play(small, keys, actions)
    jax.tree.map(np.testing.assert_array_equal, (last, steps), (other, again))
    assert len(small._live) == 1
    step = jax.jit(jax.vmap(env.step))
    first, second = step(keys, last, actions[0]), step(keys, last, actions[0])
    elsewhere = jax.jit(jax.vmap(Maze().step))(keys, last, actions[0])
    for other in (second, elsewhere):
        jax.tree.map(np.testing.assert_array_equal, first, other)
    nested = jax.vmap(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), (2, 3)))[1]
    alone = env.reset(jax.random.split(jax.random.key(0), (2, 3))[1, 2])[1]
    np.testing.assert_array_equal(nested.state[1, 2], alone.state)


def test_gymnasium_bounds_and_time_limits():
    env = FromGymnasium(functools.partial(gymnasium.make, "Pendulum-v1"), horizon=3)
    assert isinstance(env.action_spec, ContinuousActions)
    assert (env.name, env.observation_spec.shape) == ("Pendulum-v1", (3,))
    check_contract(env)
    moment, steps = play(env, jax.random.split(jax.random.key(0), 1), jnp.ones((3, 1, 1)))
    theirs = gymnasium.make("Pendulum-v1")
    theirs.reset(seed=int(moment.seed[0]))
    for time in range(3):
        seen, reward, *_ = theirs.step(np.array([2.0], np.float32))
        np.testing.assert_allclose(steps.observation[time, 0], seen, rtol=1e-6)
        np.testing.assert_allclose(steps.reward[time, 0], float(reward), rtol=1e-6)
    np.testing.assert_array_equal(steps.truncated[:, 0], [False, False, True])


class Forgetting(TMaze):
    """Draws from outside of its own generator."""

    draw = np.random.default_rng(0)

    def reset(self, **kwargs: Any) -> tuple:
        super().reset(**kwargs)
        self._side = int(self.draw.integers(1_000_000))
        return self._show()


class Turning(TMaze):
    """Acts with whole numbers."""

    action_space = spaces.Box(0, 3, (2,), np.int64)  # pyright: ignore[reportAssignmentType]


class Talking(TMaze):
    """Observes text."""

    observation_space = spaces.Text(3)  # pyright: ignore[reportAssignmentType]


def test_what_does_not_fit_of_gymnasium_is_named():
    with pytest.raises(ValueError, match="horizon: TMaze has no time limit"):
        FromGymnasium(TMaze)
    with pytest.raises(ValueError, match="has no 'truth', accepted: state"):
        FromGymnasium(TMaze, horizon=9, state="truth")
    with pytest.raises(ValueError, match="its observations are Text"):
        FromGymnasium(Talking, horizon=9)
    with pytest.raises(ValueError, match="with the same seed and actions differ"):
        FromGymnasium(Forgetting, horizon=9, state="state")
    with pytest.raises(ValueError, match="one for each of the state's 2 numbers"):
        FromGymnasium(TMaze, horizon=9, variables=(Variable("place", hidden=False),))
    with pytest.raises(ValueError, match="horizon: got 0, accepted: a number of steps >= 1"):
        FromGymnasium(TMaze, horizon=0)
    with pytest.raises(ValueError, match=r"make: got <.*TMaze.*>, accepted: a callable"):
        FromGymnasium(TMaze(), horizon=9)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="a flat Box of real numbers with bounds"):
        FromGymnasium(Turning, horizon=9)


class Counted(TMaze):
    """Counts how many there are."""

    open = 0

    def __init__(self) -> None:
        super().__init__()
        Counted.open += 1

    def close(self) -> None:
        Counted.open -= 1


def test_simulators_of_a_large_batch_are_given_back():
    env = FromGymnasium(Counted, horizon=3, state="state", room=8)
    assert Counted.open == 0
    keys, actions = jax.random.split(jax.random.key(0), 40), jnp.zeros((3, 40), jnp.int32)
    _, steps = play(env, keys, actions)
    assert Counted.open >= 40
    for seed in range(4):
        play(env, jax.random.split(jax.random.key(seed), 2), actions[:, :2])
    assert Counted.open <= 8
    _, again = play(env, keys, actions)
    jax.tree.map(np.testing.assert_array_equal, steps, again)
    env.close()
    assert Counted.open == 0


@pytest.mark.parametrize("seed", [2**31, 2**32, 2**63 + 5, 2**70])
def test_seeds_of_gymnasium_have_any_number_of_bits(seed: int):
    env, same, small = (AsGymnasium("heaven_hell") for _ in range(3))
    sides, others, smalls = ([e.reset(seed=s if i == 0 else None)[1]["state"][2] for i in range(24)]
                             for e, s in ((env, seed), (same, seed), (small, seed % 2**31)))
    assert sides == others
    assert sides != smalls


def test_actions_and_arrays_from_the_host():
    env = AsGymnasium("heaven_hell")
    seen, info = env.reset(seed=0)
    seen -= 1  # arrays are the caller's
    info["state"] -= 1
    for action in (7, -3, 1.7):
        with pytest.raises(gymnasium.error.InvalidAction, match=r"accepted: Discrete\(4\)"):
            env.step(action)


@pytest.mark.slow
@pytest.mark.lenient
def test_training_on_the_host_resumes_bit_for_bit(tmp_path: pathlib.Path):
    arguments = [
        "--domain", "examples.gymnasium_memory:Maze", "--agent", "base", "--memory", "gru", "--seeds.strategy", "map",
        "--network.critic-hidden", "8", "--dqn.batch-episodes", "4", "--dqn.replay-steps", "2000",
        "--dqn.warmup-episodes", "4", "--dqn.final-learning-rate", "1", "--evaluation.every", "100",
        "--evaluation.episodes", "4", "--checkpoint.every", "1"]

    def rows(name: str) -> list[dict]:
        found = RunFolder.open(tmp_path / name).metrics(0)
        return [{key: value for key, value in row.items() if not key.startswith("wall/")} for row in found]

    assert train.main([*arguments, "--steps", "480", "--out", str(tmp_path / "whole")]) == 0
    assert train.main([*arguments, "--steps", "280", "--out", str(tmp_path / "parts")]) == 0
    assert train.main(["--resume", str(tmp_path / "parts"), "--steps", "480"]) == 0
    assert len(rows("whole")) == 4
    assert rows("whole") == rows("parts")

"""Other libraries' environments as ours, and ours as theirs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx import registry
from envs_mjx.base import ContinuousActions

gymnasium = pytest.importorskip("gymnasium")
gymnax = pytest.importorskip("gymnax")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from envs_mjx.adapters.gymnasium import AsGymnasium  # noqa: E402
from envs_mjx.adapters.gymnax import FromGymnax  # noqa: E402

ROBOTS = {"block_pulling", "block_pushing", "drawer_opening"}


@pytest.mark.filterwarnings("ignore:.*A Box observation space m")
@pytest.mark.filterwarnings("ignore:.*not within the observation space")
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
    registry.check_contract(env)
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
    registry.check_contract(env)
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

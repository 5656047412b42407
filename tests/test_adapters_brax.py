"""Ours as brax's environments, on which brax's PPO trains with a privileged critic, and brax's as ours."""

import json
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx import registry
from envs_mjx.base import ContinuousActions, DiscreteActions, Variable
from envs_mjx.contract import check_contract
from mijax.results import load, summarise
from mijax.run_folder import RunError, RunFolder

pytest.importorskip("brax")

from brax.envs import base, fast, training

from envs_mjx.adapters.brax import AsBrax, FromBrax, on_recent_jax, wrap
from examples import brax_ppo
from mijax.trained import training_of


@pytest.fixture(autouse=True)
def their_arithmetic():
    """brax adds vectors to scalars."""
    with jax.numpy_rank_promotion("allow"):
        yield


@pytest.mark.lenient
@pytest.mark.parametrize("critic", ["state", "history_state"])
@pytest.mark.parametrize("name", registry.names())
def test_every_domain_is_a_brax_environment(name: str, critic: Any):
    env = AsBrax(name, history=3, critic=critic)
    key = jax.random.PRNGKey(0)
    first = jax.eval_shape(env.reset, key)
    action = jnp.zeros((env.action_size,))
    after = jax.eval_shape(env.step, first, action)
    assert jax.tree.structure(first) == jax.tree.structure(after)
    jax.tree.map(lambda x, y: np.testing.assert_equal((x.shape, x.dtype), (y.shape, y.dtype)), first, after)
    assert {key: value.shape for key, value in first.obs.items()} == env.observation_size
    assert all(value.dtype == jnp.float32 for value in first.obs.values())
    spec = env.env.action_spec
    assert env.action_size == (spec.num if isinstance(spec, DiscreteActions) else spec.size)
    with_state = env.observation_size["privileged_state"][0]
    assert with_state == np.prod(env.env.state_spec.shape) + (critic == "history_state") * first.obs["state"].size
    batch = jax.eval_shape(wrap(env, env.episode_length).reset, jax.random.split(key, 2))
    assert batch.obs["state"].shape == (2, *first.obs["state"].shape)


@pytest.mark.lenient
def test_an_episode_of_brax_is_an_episode_of_ours():
    env, ours = AsBrax("heaven_hell", history=2, critic="history_state"), registry.make("heaven_hell")
    state = env.reset(jax.random.key_data(jax.random.key(5)))
    np.testing.assert_array_equal(state.obs["state"], env.reset(jax.random.key(5)).obs["state"])
    key_reset, key = jax.random.split(jax.random.key(5))
    moment, timestep = ours.reset(key_reset)
    side, previous = float(timestep.state[2]), (jnp.zeros(3), jnp.zeros(4))
    for action in (1, 1, 1, *[0 if side > 0 else 2] * 3):
        np.testing.assert_array_equal(
            state.obs["state"], jnp.concatenate([*previous, timestep.observation, state.obs["state"][-4:]]))
        np.testing.assert_array_equal(state.obs["privileged_state"][-3:], timestep.state)
        assert not state.done
        previous = timestep.observation, state.obs["state"][-4:]
        state = env.step(state, 0.5 * jax.nn.one_hot(action, 4) - 0.2)
        key_step, key = jax.random.split(key)
        moment, timestep = ours.step(key_step, moment, jnp.int32(action))
        np.testing.assert_array_equal(state.obs["state"][-4:], jax.nn.one_hot(action, 4))
        assert float(state.reward) == float(timestep.reward)
    assert (float(state.reward), float(state.done), float(state.metrics["success"])) == (1, 1, 1)
    assert float(state.info["time_out"]) == 0


@pytest.mark.lenient
def test_time_limit_is_a_truncation_and_episodes_start_anew():
    env = AsBrax("heaven_hell")
    number, batch = env.episode_length, wrap(env, 1000)
    start = jax.jit(batch.reset)(jax.random.split(jax.random.PRNGKey(0), 8))
    step, state = jax.jit(batch.step), start
    stay = jnp.tile(jax.nn.one_hot(3, 4), (8, 1))  # down, against the wall
    for time in range(1, 2 * number + 1):
        state = step(state, stay)
        ends = time % number == 0
        np.testing.assert_array_equal(state.done, [float(ends)] * 8)
        np.testing.assert_array_equal(state.info["truncation"], state.done)
        np.testing.assert_array_equal(state.info["steps"], [(time - 1) % number + 1] * 8)
        if time == number:
            second = state.obs
    np.testing.assert_array_equal(second["state"], start.obs["state"])
    sides = np.stack([start.obs["privileged_state"][:, 2], second["privileged_state"][:, 2],
                      state.obs["privileged_state"][:, 2]])
    assert (sides != sides[0]).any(), "hidden variables are drawn anew"
    np.testing.assert_array_equal(state.info["episode_metrics"]["length"], [number] * 8)
    # brax's own wrapper goes back to the first moment, hidden variables included: why there is another
    theirs = training.wrap(env, env.episode_length)
    first = theirs.reset(jax.random.split(jax.random.PRNGKey(0), 8))
    state, step = first, jax.jit(theirs.step)
    for _ in range(number):
        state = step(state, stay)
    np.testing.assert_array_equal(state.done, [1.0] * 8)
    np.testing.assert_array_equal(state.info["time_out"], state.done)
    np.testing.assert_array_equal(state.obs["privileged_state"], first.obs["privileged_state"])


def test_what_brax_cannot_have_is_named():
    with pytest.raises(ValueError, match="history: got 0, accepted: at least 1"):
        AsBrax("heaven_hell", history=0)
    with pytest.raises(ValueError, match="critic: got 'all'"):
        AsBrax("heaven_hell", critic="all")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="action_repeat: got 2, accepted: 1"):
        wrap(AsBrax("heaven_hell"), 50, action_repeat=2)
    with pytest.raises(ValueError, match="randomization_fn"):
        wrap(AsBrax("heaven_hell"), 50, randomization_fn=lambda sys: sys)


def test_jax_is_as_before_after_training():
    before = hasattr(jax, "device_put_replicated")
    with on_recent_jax():
        tree = jax.device_put_replicated({"x": jnp.arange(3)}, jax.devices()[:1])  # pyright: ignore
        np.testing.assert_array_equal(tree["x"], [[0, 1, 2]])
    assert hasattr(jax, "device_put_replicated") == before


class Cart(base.Env):
    """A mass on a line, in the manner of MuJoCo Playground: a policy sees the place, training the velocity too."""

    def reset(self, rng: jax.Array) -> base.State:
        place = jax.random.uniform(rng, (), minval=-1.0, maxval=1.0)
        return self._show(jnp.stack([place, 0.0]), {"rng": rng}, place * 0)

    def step(self, state: base.State, action: jax.Array) -> base.State:
        physics: Any = state.pipeline_state
        rng, key = jax.random.split(state.info["rng"])
        push = action[0] + 0.1 * jax.random.normal(key)
        velocity = physics[1] + 0.1 * push
        return self._show(jnp.stack([physics[0] + 0.1 * velocity, velocity]), {"rng": rng}, -jnp.abs(physics[0]))

    def _show(self, physics: Any, info: dict, reward: jax.Array) -> base.State:
        obs = {"state": physics[:1], "privileged_state": physics}
        done = jnp.where(jnp.abs(physics[0]) > 1.5, 1.0, 0.0)
        return base.State(physics, obs, reward, done, info=info)

    @property
    def observation_size(self) -> dict:
        return {"state": (1,), "privileged_state": (2,)}

    @property
    def action_size(self) -> int:
        return 1

    @property
    def backend(self) -> str:
        return "none"


class CartPlace(FromBrax):
    """Can be made by name."""

    def __init__(self) -> None:
        super().__init__(Cart(), horizon=12, variables=(
            Variable("place", hidden=False), Variable("velocity", hidden=True)))


@pytest.mark.lenient
def test_an_environment_of_brax_keeps_our_contract():
    env = CartPlace()
    check_contract(env)
    assert isinstance(env.action_spec, ContinuousActions)
    assert env.action_spec.size == 1
    assert (env.observation_spec.shape, env.state_spec.shape) == ((1,), (2,))
    theirs = Cart().reset(jax.random.key_data(jax.random.key(3)))
    moment, timestep = env.reset(jax.random.key(3))
    for time in range(1, 13):
        np.testing.assert_array_equal(timestep.state, theirs.obs["privileged_state"])
        np.testing.assert_array_equal(env.ground_truth(moment), timestep.state)
        np.testing.assert_array_equal(timestep.observation, timestep.state[:1])
        assert not timestep.done
        push = jnp.full((1,), 0.3 if time % 2 else -0.3)
        theirs = Cart().step(theirs, push)
        moment, timestep = env.step(jax.random.key(time), moment, push)
        assert float(timestep.reward) == float(theirs.reward)
    assert timestep.truncated
    assert not timestep.terminated


@pytest.mark.lenient
def test_a_part_of_one_observation_is_what_a_policy_sees():
    env = FromBrax(fast.Fast(), horizon=4, observed=(0,))
    check_contract(env)
    assert (env.observation_spec.shape, env.state_spec.shape) == ((1,), (2,))
    assert [variable.hidden for variable in env.variables] == [False, True]
    both = FromBrax(fast.Fast(asymmetric_obs=True, obs_mode="dict_state"), horizon=4)  # pyright: ignore
    assert (both.observation_spec.shape, both.state_spec.shape, both.variables) == ((2,), (4,), ())


@pytest.mark.lenient
def test_what_cannot_be_ours_is_named():
    with pytest.raises(ValueError, match="AutoResetWrapper resets within a step"):
        FromBrax(training.AutoResetWrapper(fast.Fast()), horizon=4)
    with pytest.raises(ValueError, match="shows no 'pixels', accepted: privileged_state, state"):
        FromBrax(Cart(), horizon=4, observation_key="pixels")
    with pytest.raises(ValueError, match="state_key: Cart shows no 'priviledged_state', accepted: "):
        FromBrax(Cart(), horizon=4, state_key="priviledged_state")
    with pytest.raises(ValueError, match="accepted: numbers from 0 to 1"):
        FromBrax(fast.Fast(), horizon=4, observed=(2,))
    with pytest.raises(ValueError, match="one for each of the state's 2 numbers"):
        FromBrax(Cart(), horizon=4, variables=(Variable("place", hidden=False),))


@pytest.mark.slow
@pytest.mark.lenient
def test_ppo_with_a_privileged_critic_writes_a_run_like_ours(tmp_path: pathlib.Path):
    options = brax_ppo.PPOOptions(
        steps=64, seeds="2", out=tmp_path / "run", history=2, num_envs=4, unroll=4, minibatches=2, epochs=1,
        hidden=(8,), evaluations=2, episodes=3)
    run = brax_ppo.train(options, say=lambda text: None)
    assert run.seeds() == (0, 1)
    for seed in run.seeds():
        rows = run.metrics(seed)
        assert [row["step"] for row in rows] == [0, 32, 64]
        assert all({"evaluation/success", "evaluation/return", "wall/training"} <= set(row) for row in rows)
    summary = json.loads((run.path / "summary.json").read_text())
    assert (summary["agent"], summary["memory"]) == ("ppo", "window 2")
    assert summary["seeds"]["0"]["fraction_of_optimum"] is not None
    assert summarise(run)["domain"] == "heaven_hell"
    assert load([run.path])[0].curves("evaluation/return")
    assert (run.path / "curve.png").exists()
    with pytest.raises(RunError, match="its agent 'ppo' is another program's"):
        training_of(run)
    with pytest.raises(RunError, match="already holds a run"):
        brax_ppo.train(options)
    assert brax_ppo.main(["--out", str(run.path)]) == 1
    assert brax_ppo.main(["--num-envs", "3"]) == 1
    config = RunFolder.open(run.path).config()
    assert config["critic"] == "history_state"
    assert not {"out", "seeds"} & set(config)

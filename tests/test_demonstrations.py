"""Stage 1 from an expert's episodes: transitions of moments, and copies that a symmetry moves."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from envs_mjx import registry
from envs_mjx.base import ArraySpec, ContinuousActions, Demonstrations, Environment, TimeStep, Variable
from envs_mjx.contract import check_contract
from mijax.config import ConfigError, Stage1Config
from mijax.demonstrations import demonstrate
from mijax.representation import learn_representation
from mijax.representation.dataset import Transitions, collect
from mijax.representation.probe import probe
from mijax.representation.problem import Problem

STEPS = 3


@struct.dataclass
class _Place:
    place: jax.Array  # (2,)
    side: jax.Array  # () float32, hidden
    time: jax.Array  # () int32


class Plane(Environment):
    """A point that moves as it is told, for three steps; the world may be turned about its origin."""

    name = "plane"
    horizon = 5
    observation_spec, state_spec = ArraySpec((2,)), ArraySpec((3,))
    action_spec = ContinuousActions(2)
    variables = (Variable("side", hidden=True, num_values=2), Variable("x", hidden=False))

    def reset(self, key):
        key_place, key_side = jax.random.split(key)
        place = jax.random.normal(key_place, (2,))
        env_state = _Place(place, jax.random.bernoulli(key_side).astype(jnp.float32), jnp.int32(0))
        return env_state, self.show(env_state)

    def step(self, key, env_state, action):
        env_state = _Place(env_state.place + action, env_state.side, env_state.time + 1)
        return env_state, self.show(env_state)

    def show(self, env_state):
        over = env_state.time >= STEPS
        return TimeStep(env_state.place, jnp.append(env_state.place, env_state.side), over.astype(jnp.float32), over,
                        jnp.zeros((), bool))

    def ground_truth(self, env_state):
        return jnp.stack([env_state.side, env_state.place[0]])

    def demonstrations(self, key, number):
        def play(key):
            actions = jax.random.uniform(key, (self.horizon, 2), jnp.float32, -1.0, 1.0)
            first = self.reset(key)[0]

            def step(env_state, action):
                env_state = self.step(key, env_state, action)[0]
                return env_state, env_state

            later = jax.lax.scan(step, first, actions)[1]
            return jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), first, later), actions

        moments, actions = jax.vmap(play)(jax.random.split(key, number))
        return Demonstrations(moments, actions, jnp.full(number, STEPS, jnp.int32), jnp.ones(number, bool))

    def augment(self, key, env_state, action):
        angle = jax.random.uniform(key, (), jnp.float32, 0.5, 2 * np.pi - 0.5)
        turn = jnp.stack([jnp.stack([jnp.cos(angle), -jnp.sin(angle)]), jnp.stack([jnp.sin(angle), jnp.cos(angle)])])
        return _Place(turn @ env_state.place, env_state.side, env_state.time), turn @ action


class Clumsy(Plane):
    """Its expert fails now and then."""

    def demonstrations(self, key, number):
        shown = super().demonstrations(key, number)
        return Demonstrations(shown.env_state, shown.action, shown.length, jnp.arange(number) > 0)


@pytest.fixture(scope="module")
def data() -> Transitions:
    return collect(Plane(), jax.random.key(0), 40, "demonstrations")


def test_the_toy_keeps_the_contract() -> None:
    check_contract(Plane())


def test_experts_that_are_missing_or_fail_are_named() -> None:
    with pytest.raises(ConfigError, match="heaven_hell has no expert"):
        demonstrate(registry.make("heaven_hell"), jax.random.key(0), 2)
    with pytest.raises(ConfigError, match="the expert of plane solved 3 of 4 episodes"):
        demonstrate(Clumsy(), jax.random.key(0), 4)
    with pytest.raises(ConfigError, match=r"--stage1\.copies: got 2, accepted: 0, unless --stage1\.data is demonstr"):
        Stage1Config(copies=2)


def test_transitions_of_demonstrations(data: Transitions) -> None:
    assert data.size == 40 * STEPS
    assert len(data.states) == 40 * (STEPS + 1)
    moved = np.asarray(data.observations)[data.next_observation] - np.asarray(data.observations)[data.observation]
    np.testing.assert_allclose(moved, data.action, atol=1e-6)
    np.testing.assert_array_equal(np.asarray(data.states)[data.state][:, 2], data.ground_truth[:, 0])
    last = np.append(np.diff(np.asarray(data.episode)) > 0, True)
    np.testing.assert_array_equal(data.terminal, last)
    np.testing.assert_array_equal(data.reward, last)
    shown = jax.vmap(Plane().show)(data.moments)
    np.testing.assert_array_equal(shown.state, data.states)


def test_a_copy_is_the_transition_in_a_turned_world(data: Transitions) -> None:
    env = Plane()
    config = Stage1Config(data="demonstrations", episodes=40, copies=2, batch_size=20, rewarded=3)
    problem = Problem.of(env, config, data)
    assert problem.size == 3 * data.size
    chosen = jnp.concatenate([jnp.arange(10), data.size + jnp.arange(10)])
    batch = jax.jit(problem.batch)(chosen, jax.random.key(1))
    shown = batch.shown
    assert shown is not None
    assert batch.rows.size == 23
    np.testing.assert_allclose(shown.next_observation - shown.observation, batch.rows.action, atol=1e-5)
    observations = np.asarray(data.observations)[data.observation]
    np.testing.assert_array_equal(shown.observation[:10], observations[:10])
    assert (np.abs(shown.observation[10:20] - observations[:10]).max(axis=1) > 1e-3).all()
    lengths = (np.linalg.norm(x, axis=1) for x in (shown.observation[10:20], observations[:10]))
    np.testing.assert_allclose(*lengths, rtol=1e-5)
    np.testing.assert_array_equal(shown.state[:, 2], data.states[batch.rows.state, 2])
    assert (batch.rows.reward[20:] == 1).all()
    again = jax.jit(problem.batch)(chosen, jax.random.key(2)).shown
    assert again is not None
    assert (again.observation[10:] != shown.observation[10:]).any()


def test_each_held_out_episode_is_moved_as_a_whole(data: Transitions) -> None:
    moved = collect(Plane(), jax.random.key(0), 40, "demonstrations", moved=True)
    here, there = (np.asarray(d.observations)[d.observation] for d in (data, moved))
    after = np.asarray(moved.observations)[moved.next_observation]
    np.testing.assert_allclose(after - there, moved.action, atol=1e-5)
    np.testing.assert_allclose(moved.ground_truth[:, 1], there[:, 0], atol=1e-6)
    turned = np.angle((there @ [1, 1j]) / (here @ [1, 1j])).reshape(40, STEPS)
    np.testing.assert_allclose(np.exp(1j * turned), np.exp(1j * turned[:, :1]).repeat(STEPS, axis=1), atol=1e-3)
    assert len(np.unique(turned[:, 0].round(3))) > 30
    np.testing.assert_array_equal(moved.reward, data.reward)


def test_variables_are_in_units_of_what_copies_show() -> None:
    """Where x hardly differs before the world is turned."""
    class Upright(Plane):
        def reset(self, key):
            env_state, _ = super().reset(key)
            env_state = dataclasses.replace(env_state, place=env_state.place * jnp.array([0.01, 1.0]))
            return env_state, self.show(env_state)

        def demonstrations(self, key, number):
            def play(key):
                first = self.reset(key)[0]
                moments = jax.tree.map(lambda x: jnp.broadcast_to(x, (self.horizon + 1, *x.shape)), first)
                return dataclasses.replace(moments, time=jnp.arange(self.horizon + 1))

            return Demonstrations(jax.vmap(play)(jax.random.split(key, number)), jnp.zeros((number, self.horizon, 2)),
                                  jnp.full(number, STEPS, jnp.int32), jnp.ones(number, bool))

    env = Upright()
    still = collect(env, jax.random.key(0), 200, "demonstrations")
    for copies, unit in ((0, 0.01), (2, 0.7)):
        problem = Problem.of(env, Stage1Config(
            data="demonstrations", episodes=200, copies=copies, batch_size=20), still)
        one = problem.seen(jnp.array([[0.0, unit]])) - problem.seen(jnp.zeros((1, 2)))
        assert float(one[0, 0]) == pytest.approx(1.0, rel=0.25)


@pytest.mark.lenient
def test_stage_1_learns_from_copies(monkeypatch: pytest.MonkeyPatch) -> None:
    moved = []

    def spy(*arguments: Any, **options: Any) -> Transitions:
        moved.append(options["moved"])
        return collect(*arguments, **options)

    monkeypatch.setattr("mijax.representation.probe.collect", spy)
    config = Stage1Config(data="demonstrations", episodes=40, heldout_episodes=40, copies=1, batch_size=40, epochs=3,
                          features=4)
    representation, history = learn_representation(Plane(), config, jax.random.key(0))
    assert history.updates == 3 * (2 * 40 * STEPS // 40)
    report = probe(representation, Plane(), config, jax.random.key(1), history)
    assert {d.variable for d in report.decodings} == {"side", "x"}
    probe(representation, Plane(), dataclasses.replace(config, copies=0), jax.random.key(1))
    assert moved == [True, False]

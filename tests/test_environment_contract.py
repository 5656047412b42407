"""One conformance suite over every registered environment, and the registry's errors."""

import dataclasses
import functools
import subprocess
import sys
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import configs
from envs_mjx import registry
from envs_mjx.base import (
    ArraySpec,
    ContinuousActions,
    Demonstrations,
    DiscreteActions,
    Environment,
    EnvState,
    TimeStep,
    shows_again,
)
from envs_mjx.contract import ContractError, check_contract
from envs_mjx.grid import HeavenHell
from envs_mjx.grid.world import GridState, GridWorld

NUM_EPISODES = 64


class Episodes(NamedTuple):
    """Random episodes of one environment, on the host: E episodes, T = horizon steps after the reset."""

    env: Environment
    keys: jax.Array  # (E,) of the resets
    actions: jax.Array  # (E, T, ...)
    states: EnvState  # (E, T + 1, ...)
    timesteps: TimeStep  # (E, T + 1, ...)
    truth: np.ndarray  # (E, T + 1, variables)
    valid: np.ndarray  # (E, T + 1) bool, up to the end of the episode


@pytest.fixture(scope="module", params=(*registry.names(), "examples.signpost:Signpost"))
def episodes(request: pytest.FixtureRequest) -> Episodes:
    env = registry.make(request.param)

    def play(key):
        keys = jax.random.split(key, env.horizon)
        actions = jax.vmap(env.action_spec.sample)(keys)
        first = env.reset(key)

        def step(env_state, inputs):
            following = env.step(inputs[0], env_state, inputs[1])
            return following[0], following

        _, rest = jax.lax.scan(step, first[0], (keys, actions))
        states, timesteps = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)
        return actions, states, timesteps, jax.vmap(env.ground_truth)(states)

    keys = jax.random.split(jax.random.key(5), NUM_EPISODES)
    actions, states, timesteps, truth = jax.device_get(jax.jit(jax.vmap(play))(keys))
    ended_before = np.cumsum(timesteps.done, axis=1) - timesteps.done
    return Episodes(env, keys, actions, states, timesteps, truth, ended_before == 0)


def test_check_contract(episodes: Episodes) -> None:
    check_contract(episodes.env)


def test_names_are_the_registered_ones() -> None:
    assert [registry.make(name).name for name in registry.names()] == list(registry.names())


def test_truncates_at_the_horizon_unless_terminated(episodes: Episodes) -> None:
    timesteps, valid, horizon = episodes.timesteps, episodes.valid, episodes.env.horizon
    assert not (timesteps.terminated & timesteps.truncated).any()
    assert not timesteps.truncated[:, :horizon][valid[:, :horizon]].any()
    reached = valid[:, horizon]
    assert reached.any()
    assert timesteps.done[reached, horizon].all()


def test_step_never_resets_and_reset_draws_anew(episodes: Episodes) -> None:
    """What is hidden stays the same up to the last step of an episode, and differs between episodes."""
    drawn = getattr(episodes.states, "movable", None)  # on the robots "the nearer one" changes as the gripper moves
    columns = [i for i, variable in enumerate(episodes.env.variables) if variable.hidden]
    assert columns
    for values in [episodes.truth[..., i] for i in columns] if drawn is None else [drawn]:
        assert (values == values[:, :1])[episodes.valid].all()
        assert len(np.unique(values[:, 0])) > 1


def test_same_key_same_episode(episodes: Episodes) -> None:
    """Alone as in a batch: jit equals vmap."""
    env, last = episodes.env, 3
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    env_state, timestep = reset(episodes.keys[last])
    keys = jax.random.split(episodes.keys[last], env.horizon)
    close = functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5)
    for time in range(4):
        expected = jax.tree.map(lambda x, t=time: x[last, t], (episodes.states, episodes.timesteps))
        jax.tree.map(close, (env_state, timestep), expected)
        if timestep.done:
            break
        env_state, timestep = step(keys[time], env_state, episodes.actions[last, time])


def test_success_ends_an_episode(episodes: Episodes) -> None:
    success = np.asarray(jax.vmap(jax.vmap(episodes.env.success))(episodes.timesteps))
    assert not (success & ~episodes.timesteps.done)[episodes.valid].any()


def test_every_observation_is_listed(episodes: Episodes) -> None:
    listed = episodes.env.all_observations()
    if listed is None:
        pytest.skip("the environment lists none")
    seen = np.asarray(episodes.timesteps.observation)[episodes.valid].reshape(-1, listed[0].size)
    assert {row.tobytes() for row in seen} <= {row.tobytes() for row in listed.reshape(len(listed), -1)}


def test_hidden_variable_is_invisible_off_the_information_cells(episodes: Episodes) -> None:
    env = episodes.env
    if not isinstance(env, GridWorld):
        pytest.skip("swapping the hidden variable needs a grid world")
    cells = np.flatnonzero(~env.tables.walls.reshape(-1)).astype(np.int32)
    num_goals = len(env.tables.goals)

    def arrive(cell, goal):
        """Every way of arriving anywhere from `cell`."""
        actions = jnp.arange(4, dtype=jnp.int32)
        before = GridState(cell, goal, jnp.int32(0))
        after, timesteps = jax.vmap(lambda action: env.step(jax.random.key(0), before, action))(actions)
        return timesteps.observation, timesteps.state, jax.vmap(env.reveals)(after)

    over_goals = jax.vmap(arrive, (None, 0))
    goals = jnp.arange(num_goals, dtype=jnp.int32)
    seen, states, reveals = jax.device_get(jax.jit(jax.vmap(over_goals, (0, None)))(cells, goals))
    seen, states = (x.reshape(len(cells), num_goals, 4, -1) for x in (seen, states))
    assert (reveals == reveals[:, :1]).all()
    assert (seen == seen[:, :1]).all(-1)[~reveals].all()
    assert (seen == states)[reveals].all()
    for at_cell in states[:, :, 0]:
        assert len(np.unique(at_cell, axis=0)) == num_goals


def test_moments_show_what_was_seen(episodes: Episodes) -> None:
    env = episodes.env
    if jax.eval_shape(lambda key: env.demonstrations(key, 1), jax.random.key(0)) is None:
        pytest.skip("the environment has no expert, and need not show moments again")
    states, timesteps = jax.tree.map(lambda x: x[:4, :6], (episodes.states, episodes.timesteps))
    shown = jax.jit(jax.vmap(jax.vmap(env.show)))(states)
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-6), shown, timesteps)


# The registry


def test_unknown_names() -> None:
    with pytest.raises(registry.UnknownDomain, match=r"'heven_hell': accepted are heaven_hell, sphinx, carflag_2d"):
        registry.make("heven_hell")
    with pytest.raises(registry.UnknownDomain, match="importing 'no_such_module' failed: ModuleNotFoundError"):
        registry.make("no_such_module:Env")
    with pytest.raises(registry.UnknownDomain, match="no class 'Nothing'"):
        registry.make("envs_mjx.grid:Nothing")
    with pytest.raises(registry.UnknownDomain, match="importing '' failed"):
        registry.make(":Nothing")
    with pytest.raises(registry.UnknownDomain, match="makes a dict, not an"):
        registry.make("builtins:dict")
    with pytest.raises(registry.UnknownDomain, match="cannot be made without arguments"):
        registry.make("envs_mjx.base:DiscreteActions")


def test_arguments_follow_the_name(monkeypatch: pytest.MonkeyPatch) -> None:
    class Sized(HeavenHell):
        def __init__(self, size: int = 3, word: str = "", flag: bool = False) -> None:
            super().__init__()
            self.given = size, word, flag

    monkeypatch.setattr(registry, "_factories", {"sized": Sized})
    assert registry.make("sized").given == (3, "", False)  # pyright: ignore[reportAttributeAccessIssue]
    made = registry.make("sized,size=5,word=deep,flag=True")
    assert made.given == (5, "deep", True)  # pyright: ignore[reportAttributeAccessIssue]
    assert configs.preset("heaven_hell,size=5").dqn == configs.preset("heaven_hell").dqn
    for wrong, message in (("sized,depth=5", "unknown argument 'depth', accepted: size, word, flag"),
                           ("sized,5", "got '5', accepted: name,argument=value"),
                           ("sized,size=", "got 'size=', accepted: name,argument=value")):
        with pytest.raises(registry.UnknownDomain, match=message):
            registry.make(wrong)


def test_arguments_of_factories_that_do_not_list_them(monkeypatch: pytest.MonkeyPatch) -> None:
    def any_size(**options: int) -> HeavenHell:
        assert options == {"size": 5}
        return HeavenHell()

    monkeypatch.setattr(registry, "_factories", {"any": any_size, "dict": dict, "max": max})
    assert isinstance(registry.make("any,size=5"), HeavenHell)
    for domain, message in (("dict,size=5", "makes a dict"), ("max,size=5", "cannot be made: TypeError")):
        with pytest.raises(registry.UnknownDomain, match=message):
            registry.make(domain)


def test_environment_of_the_current_directory(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_worlds.py").write_text(
        "from envs_mjx.grid import HeavenHell\nclass Mine(HeavenHell):\n    name = 'mine'\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    env = registry.make("my_worlds:Mine")
    check_contract(env)
    assert env.name == "mine"
    (tmp_path / "lazy_worlds.py").write_text("def __getattr__(name):\n    raise ImportError('no physics here')\n")
    with pytest.raises(registry.UnknownDomain, match="importing 'lazy_worlds' failed: ImportError: no physics here"):
        registry.make("lazy_worlds:Mine")


def test_register(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_factories", dict(registry._factories))
    registry.register("again", HeavenHell)
    registry.register("again", HeavenHell)
    assert "again" in registry.names()
    assert isinstance(registry.make("again"), HeavenHell)
    with pytest.raises(ValueError, match="'again' is taken"):
        registry.register("again", "envs_mjx.grid:Sphinx")
    with pytest.raises(ValueError, match="without a colon"):
        registry.register("a:b", HeavenHell)


def test_registry_needs_no_physics() -> None:
    code = ("import sys; from envs_mjx import registry; registry.make('sphinx'); "
            "assert not {'mujoco', 'brax'} & set(sys.modules)")
    subprocess.run([sys.executable, "-c", code], check=True)


def _with_timestep(**changes):
    """Heaven-Hell whose step returns other values of some fields."""

    class Broken(HeavenHell):
        def step(self, key, env_state, action):
            env_state, timestep = super().step(key, env_state, action)
            return env_state, timestep.replace(  # pyright: ignore[reportAttributeAccessIssue]
                **{name: change(getattr(timestep, name)) for name, change in changes.items()})

    return Broken()


def _with(**attributes):
    """Heaven-Hell with other attributes or methods."""
    return type("Broken", (HeavenHell,), attributes)()


def _resetting(where: int):
    """Heaven-Hell, short, whose step resets at the end: with its own key, or the first or second split from it."""

    class Resetting(HeavenHell):
        horizon = 5

        def step(self, key, env_state, action):
            env_state, last = super().step(key, env_state, action)
            begun, first = self.reset([key, *jax.random.split(key)][where])
            first = dataclasses.replace(
                first, reward=last.reward, terminated=last.terminated, truncated=last.truncated)
            return jax.tree.map(lambda x, y: jnp.where(last.done, x, y), (begun, first), (env_state, last))

    return Resetting()


class _Late(HeavenHell):
    """Shows something that is not listed, in the middle of an episode."""

    def step(self, key, env_state, action):
        later, timestep = super().step(key, env_state, action)
        observation = timestep.observation + jnp.where(later.time == 8, 5.0, 0.0)
        return later, dataclasses.replace(timestep, observation=observation)


@pytest.mark.parametrize(("env", "message"), [
    (_with_timestep(reward=lambda x: x.astype(jnp.int32)), r"reward of step is 'int32\[\]', expected float32\[\]"),
    (_with_timestep(reward=lambda x: x[None]), r"reward of step is 'float32\[1\]', expected float32\[\]"),
    (_with_timestep(terminated=lambda x: x.astype(jnp.float32)), r"terminated of step is 'float32\[\]', expected bool"),
    (_with_timestep(observation=lambda x: x[:2]), r"observation of step is 'float32\[2\]', expected float32\[3\]"),
    (_with_timestep(observation=lambda x: x / 0), "observation of step is 'not finite'"),
    (_with(state_spec=ArraySpec((4,))), r"state of reset is 'float32\[3\]', expected float32\[4\]"),
    (_with(horizon=0), "horizon is 0, expected at least 1"),
    (_with_timestep(truncated=jnp.zeros_like), "an episode is not over after its horizon of 50 steps"),
    *((_resetting(where), "step returns the first moment of a new episode where one ends") for where in range(3)),
    (_with(observation_spec=ArraySpec((3, 1))), r"observation_spec is \(3, 1\), expected a vector \(D,\) or an image"),
    (_with(state_spec=ArraySpec(())), r"state_spec is \(\), expected a vector"),
    (_with(__eq__=lambda self, other: True, __hash__=None), "cannot be hashed, as programs compiled for it"),
    (_with(action_spec=ContinuousActions(2)), "step cannot be traced by JAX"),
    (_with(variables=()), r"ground_truth is 'float32\[3\]', expected float32\[0\]"),
    (_with(ground_truth=lambda self, env_state: jnp.array([2.0, 0.0, 0.0])),
     r"'side' after reset is 2.0, expected a class in 0 \.\. 1"),
    (_with(all_observations=lambda self: []), "all_observations is 'list', expected an ndarray"),
    (_with(all_observations=lambda self: np.zeros((4, 2), np.float32)), r"all_observations is 'float32\[2\]'"),
    (_with(all_observations=lambda self: np.zeros((4, 3), np.float32)), "different observations .* is 1, expected 4"),
    (_with(all_observations=lambda self: np.zeros((1, 3), np.float32)), "expected one listed by all_observations"),
    (_Late(), "observation of step is .* expected one listed by all_observations"),
    (_with(show=lambda self, env_state: self.reset(jax.random.key(0))[1]), "the largest change of .* by show is"),
    (_with(reset=lambda self, key: None), "what reset returns is 'NoneType'"),
    (_with(step=lambda self, key, env_state, action: (env_state.cell, self.reset(key)[1])), "the EnvState of step"),
    (_with(step=lambda self, key, env_state, action: (
        env_state.replace(time=env_state.time * 1.0), self.reset(key)[1])), r"EnvState.time of step is 'float32\[\]'"),
    (_with(augment=lambda self, key, env_state, action: env_state), "what augment returns is 'GridState', expected"),
    (_with(augment=lambda self, key, env_state, action: (env_state, action * 1.0)), "action of augment is 'float32"),
    (_with(demonstrations=lambda self, key, number: ()), "what demonstrations returns is 'tuple', expected Demonstr"),
    (_with(demonstrations=lambda self, key, number: Demonstrations(
        jax.tree.map(lambda x: jnp.zeros((number, 51, *x.shape), x.dtype), self.reset(key)[0]),
        jnp.zeros((number, 49), jnp.int32), jnp.zeros(number, jnp.int32), jnp.zeros(number, bool))),
     r"action of demonstrations is 'int32\[2, 49\]', expected int32\[2, 50\]"),
    (_with(demonstrations=lambda self, key, number: Demonstrations(
        jax.tree.map(lambda x: jnp.zeros((number, 51, *x.shape), x.dtype), self.reset(key)[0]),
        jnp.zeros((number, 50), jnp.int32), jnp.zeros(number, jnp.int32), jnp.zeros(number, bool),
        jnp.zeros((number, 50)))), r"intended of demonstrations is 'float32\[2, 50\]', expected int32\[2, 50\]"),
    (_with(step=lambda self, key, env_state, action: 1 if action > 0 else 2), "step cannot be traced by JAX: Tracer"),
])
@pytest.mark.lenient
def test_broken_contracts(env: Environment, message: str) -> None:
    with pytest.raises(ContractError, match=message) as caught:
        check_contract(env)
    assert "\n" not in str(caught.value)


def test_a_method_of_the_same_name_does_not_show_moments() -> None:
    env = _with(show=lambda self, env_state: jnp.zeros((8, 8, 3)))
    assert not shows_again(env)
    check_contract(env)


class _Contexts(Environment):
    """Legal: what a step shows is drawn as a reset draws it; a key of JAX's own type is remembered."""

    name, horizon = "contexts", 3
    observation_spec = state_spec = ArraySpec((1,))
    action_spec = DiscreteActions(2)

    def reset(self, key):
        return (jnp.int32(0), key), self._show(key, jnp.int32(0))

    def step(self, key, env_state, action):
        del action
        return (env_state[0] + 1, env_state[1]), self._show(key, env_state[0] + 1)

    def _show(self, key, time):
        seen = jax.random.uniform(key, (1,))
        return TimeStep(seen, seen, jnp.zeros(()), jnp.zeros((), bool), time >= self.horizon)


def test_what_looks_like_a_reset_may_be_none() -> None:
    check_contract(_Contexts())

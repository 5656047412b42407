"""What a run leaves on disk comes back, and what does not belong together is refused."""

import dataclasses
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from envs_mjx import registry
from envs_mjx.base import ArraySpec, DiscreteActions, Environment, TimeStep
from mijax import stage1, train
from mijax.agents.variants import stage1_of
from mijax.checkpoint import Checkpoints, load_latest
from mijax.config import Config
from mijax.representation.model import init_parameters, networks_for
from mijax.representation.storage import RepresentationError, save_representation
from mijax.run_folder import RunError, RunFolder
from mijax.trained import BEFORE_THERE_WAS, Training, seed_of, seeds_of, training_of
from mijax.types import Representation


class Mine(Environment):
    """An environment of one's own, told by its class: a walk of 3 steps, whose name is not what it is made by."""

    name, horizon = "mine", 3
    observation_spec, state_spec, action_spec = ArraySpec((1,)), ArraySpec((2,)), DiscreteActions(2)

    def reset(self, key):
        del key
        time = jnp.zeros((), jnp.int32)
        return time, self._show(time)

    def step(self, key, env_state, action):
        del key, action
        return env_state + 1, self._show(env_state + 1)

    def _show(self, time):
        last = time == self.horizon
        return TimeStep(jnp.zeros(1), jnp.zeros(2), last.astype(jnp.float32), last, jnp.zeros((), bool))


def with_representation(run: RunFolder, env: Environment) -> RunFolder:
    """The run with untrained features of seed 0."""
    zeros = [jnp.zeros((1, *spec.shape), spec.dtype) for spec in (env.state_spec, env.observation_spec)]
    features = Config().stage1.features
    parameters = init_parameters(networks_for(env, features), jax.random.key(0), *zeros)
    representation = Representation(parameters["phi"], parameters["psi"], jnp.zeros(features), jnp.ones(()),
                                    jnp.zeros(2, jnp.uint32))
    save_representation(representation, env, stage1.folder_of(run, 0))
    return run


def test_options_seeds_and_tracker_come_back(tmp_path: pathlib.Path) -> None:
    asked = Training(Config(agent="ua", memory="gru"), (3, 7), "tensorboard")
    run = RunFolder.create(tmp_path / "run", asked.as_dict())
    assert training_of(run) == asked
    for seed in (3, 7):
        run.seed_path(seed).mkdir()
    assert seeds_of(run, None) == (3, 7)
    assert seeds_of(run, "7,") == (7,)
    assert (seed_of(run, None), seed_of(run, 7)) == (3, 7)
    for text, named in (("0,", "no seed 0"), ("2", "no seed 0")):
        with pytest.raises(RunError, match=rf"has {named} \(it has 3, 7\)"):
            seeds_of(run, text)


@pytest.mark.parametrize(("section", "option", "before"), BEFORE_THERE_WAS)
def test_runs_from_before_there_was_an_option(
    section: str, option: str, before: object, tmp_path: pathlib.Path
) -> None:
    stored = Training(Config(), (0,)).as_dict()
    assert stored[section].pop(option) != before
    read = training_of(RunFolder.create(tmp_path / "run", stored)).config
    assert getattr(getattr(read, section), option) == before


@pytest.mark.parametrize(("stored", "message"), [
    ({}, "holds representations but no agent"), ({"agent": "ppo"}, "its agent 'ppo' is another program's")])
def test_runs_of_others(stored: dict[str, Any], message: str, tmp_path: pathlib.Path) -> None:
    run = RunFolder.create(tmp_path / "run", {"domain": "heaven_hell"} | stored)
    with pytest.raises(RunError, match=message):
        training_of(run)
    assert train.main(["--resume", str(run.path)]) == 1


@pytest.mark.parametrize("domain", [f"{__name__}:Mine", "heaven_hell"])
def test_features_are_taken_over_by_the_environment_they_are_of(domain: str, tmp_path: pathlib.Path) -> None:
    env = registry.make(domain)
    source = with_representation(RunFolder.create(tmp_path / "source", {"domain": domain}), env)
    features = Config().stage1.features
    said: list[str] = []
    taken_over = stage1.reuse(source, env, features, (0, 4), said.append)
    run = RunFolder.create(tmp_path / "run", {"domain": domain}, taken_over)
    assert said == [f"{source.path}: has no stage 1 of seed 4; that of its seed 0 takes its place"]
    assert (stage1.folder_of(run, 4) / "representation.json").exists()
    with pytest.raises(RepresentationError, match=f"its domain is {env.name}, this run's is sphinx"):
        stage1.reuse(source, registry.make("sphinx"), features, (4,), said.append)


def test_believer_and_ours_do_not_share_features(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    ours, believers = Config(), Config(agent="believer")
    runs = [with_representation(RunFolder.create(tmp_path / config.agent, Training(config, (0,)).as_dict()),
                                registry.make("heaven_hell")) for config in (ours, believers)]
    with_options = {"domain": "heaven_hell", "stage1": dataclasses.asdict(stage1_of(believers))}
    runs.append(with_representation(RunFolder.create(tmp_path / "alone", with_options), registry.make("heaven_hell")))
    for agent, run in (("believer", runs[0]), ("mi", runs[1]), ("mi", runs[2])):
        out = tmp_path / f"{agent}_on_{run.path.name}"
        assert train.main(["--agent", agent, "--representation", str(run.path), "--out", str(out)]) == 1
        assert "features of the other kind" in capsys.readouterr().err
        assert not out.exists()


def test_options_that_are_not_read_are_named() -> None:
    options = train.parse(["--agent", "base", "--dqn.discount", "0.9", "--sac.discount", "0.5", "--zp.weight", "3",
                           "--dqn.pretrain-updates", "7"])
    unread = train.unread_options(options.config, registry.make("heaven_hell"))
    assert unread == ["--dqn.pretrain-updates", "--sac.discount", "--zp.weight"]
    options = train.parse(["--agent", "believer", "--stage1.lambda-club", "3", "--stage1.lambda-r", "3"])
    assert train.unread_options(options.config, registry.make("heaven_hell")) == ["--stage1.lambda-club"]
    options = train.parse([
        "--agent", "believer", "--information.intrinsic-weight", "3", "--information.no-start-from-psi"])
    assert train.unread_options(options.config, registry.make("heaven_hell")) == ["--information.intrinsic-weight"]
    options = train.parse(["--information.intrinsic-weight", "0", "--information.folds", "2"])
    assert train.unread_options(options.config, registry.make("heaven_hell")) == ["--information.folds"]
    options = train.parse(["--agent", "mdp", "--information.no-start-from-psi", "--stage1.epochs", "7"])
    assert train.unread_options(options.config, registry.make("heaven_hell")) == ["--information.start-from-psi"]
    assert train.unread_options(train.parse(["--preset", "paper"]).config, registry.make("heaven_hell")) == []


@struct.dataclass
class Tiny:
    """In the place of a learner's state, which is a pytree like this one."""

    some: jax.Array
    none: jax.Array
    key: jax.Array


def test_arrays_without_entries_survive(tmp_path: pathlib.Path) -> None:
    state: Any = Tiny(jnp.arange(3), jnp.zeros((2, 0)), jax.random.key(1))
    checkpoints = Checkpoints(RunFolder.create(tmp_path / "run", {"domain": "heaven_hell"}), 0)
    checkpoints.save(10, state)
    step, loaded = load_latest({0: checkpoints}, jax.eval_shape(lambda: state), print)
    checkpoints.close()
    again: Any = loaded[0]
    assert step == 10
    assert again.none.shape == (2, 0)
    np.testing.assert_array_equal(again.some, state.some)
    np.testing.assert_array_equal(jax.random.key_data(again.key), jax.random.key_data(state.key))


def test_what_is_newer_than_the_checkpoint_gone_on_from_is_written_again(tmp_path: pathlib.Path) -> None:
    checkpoints = Checkpoints(RunFolder.create(tmp_path / "run", {"domain": "heaven_hell"}), 0)
    states: list[Any] = [Tiny(jnp.full(3, i), jnp.zeros((2, 0)), jax.random.key(i)) for i in range(3)]
    for step, state in ((10, states[0]), (20, states[1])):
        checkpoints.save(step, state)
    checkpoints.drop_after(10)
    assert checkpoints.steps() == (10,)
    checkpoints.save(20, states[2])
    again: Any = checkpoints.load(20, jax.eval_shape(lambda: states[0]))
    checkpoints.close()
    np.testing.assert_array_equal(again.some, states[2].some)

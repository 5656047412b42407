"""Greedy episodes seen from inside, and their figure."""

import dataclasses
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compass import Compass
from PIL import Image

from envs_mjx import registry
from mijax import page, report
from mijax.checkpoint import Checkpoints
from mijax.config import Config, DQNConfig, EvaluationConfig, InformationConfig, NetworkConfig, Stage1Config
from mijax.episode import Trace, trace
from mijax.learner import Learner, LearnerState, make_learner
from mijax.representation import learn_representation
from mijax.representation.model import init_parameters, networks_for
from mijax.representation.storage import save_representation
from mijax.run_folder import RunFolder
from mijax.seeds import training_key
from mijax.stage1 import folder_of
from mijax.trained import Training
from mijax.types import Representation

STAGE1 = Stage1Config(episodes=20, epochs=1, batch_size=200, features=4)
CONFIG = Config(
    stage1=STAGE1, steps=1000,
    network=NetworkConfig(action_embedding=4, observation_embedding=4, gru_width=8, critic_hidden=(16,),
                          auxiliary_hidden=(8,)),
    dqn=DQNConfig(batch_episodes=4, warmup_episodes=4, replay_steps=400), evaluation=EvaluationConfig(every=20),
    information=InformationConfig(intrinsic_form="explained_variance"),
)
pytestmark = pytest.mark.lenient


@pytest.fixture(scope="module")
def ours() -> tuple[Learner, LearnerState]:
    """An untrained `mi` with a transformer."""
    learner = make_learner(registry.make("heaven_hell"), CONFIG)
    representation, _ = learn_representation(learner.env, STAGE1, jax.random.key(0))
    return learner, jax.jit(learner.init)(training_key(0), representation)


@pytest.fixture(scope="module")
def seen(ours: tuple[Learner, LearnerState]) -> Trace:
    return trace(*ours, jax.random.key(3), 5)


def test_whole_episodes_show_the_values_that_acting_followed(seen: Trace) -> None:
    steps = np.arange(51) < seen.length[:, None]
    np.testing.assert_array_equal(seen.q.argmax(-1)[steps], seen.action[steps])
    world = registry.make("heaven_hell")
    ended = world.tables.terminal[seen.env_state.cell, seen.env_state.goal]  # pyright: ignore
    for row, length in enumerate(seen.length):
        assert ended[row, length] or length == 50
        assert not ended[row, :length].any()


def test_the_bonus_is_what_explaining_more_pays(seen: Trace) -> None:
    assert seen.bonus is not None
    assert seen.explained is not None
    assert seen.explained_by_agent is not None
    assert seen.explained.shape == seen.explained_by_agent.shape == seen.bonus.shape == (5, 51)
    assert (seen.bonus[:, 0] == 0).all()
    # where the state does not change, neither does z_s, and the bonus is the step in what is explained
    cell = seen.env_state.cell
    stays = (cell[:, 1:] == cell[:, :-1]) & (np.arange(1, 51) <= seen.length[:, None])
    assert stays.any()
    np.testing.assert_allclose(seen.bonus[:, 1:][stays], np.diff(seen.explained, axis=1)[stays], atol=1e-4)


def test_attention_is_causal_and_sums_to_one(seen: Trace) -> None:
    assert seen.attention is not None
    assert seen.attention.shape == (5, 2, 51, 51)
    for row, length in enumerate(seen.length):
        own = seen.attention[row, :, : length + 1]
        np.testing.assert_allclose(own.sum(-1), 1, atol=1e-5)
        assert np.triu(own[..., : length + 1], 1).max() == 0


def test_peaks_are_compared_with_the_first_information(seen: Trace) -> None:
    bonus, reveals = np.zeros((3, 51)), np.zeros((3, 51), bool)
    bonus[0, [4, 9]], reveals[0, [4, 5]] = (0.8, 0.2), True  # peaks when it is first told
    bonus[1, [4, 9, 40]], reveals[1, 9] = (0.8, 0.2, 5.0), True  # peaks before; 40 is beyond its end
    bonus[2, 3] = 0.5  # is never told
    made = dataclasses.replace(seen, bonus=bonus, reveals=reveals, length=np.array([12, 12, 12]))
    assert made.peaks().tolist() == [4, 4, 3]
    assert made.first_information().tolist() == [4, 9, -1]
    assert made.peaks_at_information() == 0.5
    assert np.isnan(dataclasses.replace(made, reveals=reveals & False).peaks_at_information())


@pytest.mark.parametrize(("agent", "memory"), [("mi", "gpt"), ("base", "gru")])
def test_the_command_draws_an_episode_of_each_kind(
    ours: tuple[Learner, LearnerState], tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch, agent: str, memory: str
) -> None:
    learner, state = ours
    config = dataclasses.replace(CONFIG, agent=agent, memory=memory)
    run = RunFolder.create(tmp_path / "run", Training(config, (2,)).as_dict())
    if agent == "base":
        learner = make_learner(learner.env, config)
        state = jax.jit(learner.init)(training_key(2), None)
    else:
        assert state.representation is not None
        save_representation(state.representation, learner.env, folder_of(run, 2))
    checkpoints = Checkpoints(run, 2)
    checkpoints.save(200, state)
    checkpoints.close()
    assert report.main([str(run.path), "--episode"]) == 0
    figure = run.path / "episode_seed_2.png"
    assert str(figure) in capsys.readouterr().out
    image = Image.open(figure).convert("RGB")
    colours = {colour for count, colour in image.getcolors(image.width * image.height) or [] if count > 30}
    assert ((214, 39, 40) in colours) is (agent == "mi")  # the red ring
    assert (96, 186, 110) in colours  # the goal's cell
    run.append(2, {"step": 200, "evaluation/success": 0.5})
    monkeypatch.setattr(report, "EPISODES", 1)  # the program of the figure, which is compiled already
    assert report.main([str(run.path), "--html"]) == 0
    shown = page.read_data(run.path / page.FILE)["runs"][0]["episodes"]
    assert (shown["seed"], shown["step"], len(shown["episodes"])) == (2, 200, 1)
    (one,) = shown["episodes"]
    np.testing.assert_array_equal(np.array(one["q"])[:-1].argmax(1), one["action"][:-1])
    assert (one["explained"] is None) is (agent == "base")
    assert (one["attention"] is None) is (memory == "gru")


def test_continuous_actions_are_traced() -> None:
    learner = make_learner(Compass(), CONFIG)
    shapes = [jnp.zeros((1, *spec.shape)) for spec in (learner.env.state_spec, learner.env.observation_spec)]
    encoders = init_parameters(networks_for(learner.env, STAGE1.features), jax.random.key(5), *shapes)
    representation = Representation(encoders["phi"], encoders["psi"], jnp.zeros(STAGE1.features), jnp.float32(1),
                                    jnp.zeros(2, jnp.uint32))
    agent = jax.jit(learner.agent.init)(training_key(0), representation)
    unused: Any = None
    state = LearnerState(agent, representation, unused, unused, unused, unused)
    seen = trace(learner, state, jax.random.key(3), 6)
    assert seen.action.shape == (6, 5, 2)
    assert seen.q.shape == (6, 5, 1)
    assert np.isfinite(seen.q).all()
    assert seen.length.tolist() == [Compass.choice + 1] * 6
    assert seen.bonus is not None
    assert seen.attention is not None
    np.testing.assert_allclose(seen.attention[:, :, :4].sum(-1), 1, atol=1e-5)
    # the action that was taken is the one that leads to the next observation
    pointed = np.sum(seen.action[:, Compass.choice] * seen.state[:, 0, :2], axis=-1)
    norm = np.linalg.norm(seen.action[:, Compass.choice], axis=-1)
    np.testing.assert_array_equal(seen.reward[:, Compass.choice + 1] > 0, pointed > 0.7071 * norm)


def test_what_cannot_be_drawn_is_named(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = RunFolder.create(tmp_path / "run", Training(CONFIG, (0,)).as_dict())
    run.seed_path(0).mkdir()
    for arguments, message in (
        ([str(run.path), "--seed", "4"], "has no seed 4 (it has 0)"),
        ([str(run.path), str(run.path)], "--episode: got 2 runs, accepted: one"),
        ([str(run.path)], "seed 0 has no checkpoint yet"),
    ):
        assert report.main([*arguments, "--episode"]) == 1
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1

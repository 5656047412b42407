"""Checkpoints of a run are played, tabled and drawn."""

import functools
import json
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import failure_of
from PIL import Image

from envs_mjx import registry
from envs_mjx.grid import draw
from envs_mjx.grid.optimal import optimum
from mijax import evaluate
from mijax.agents.forgetful import Forgetful
from mijax.checkpoint import Checkpoints
from mijax.config import Config, DQNConfig, EvaluationConfig, NetworkConfig
from mijax.learner import make_learner
from mijax.run_folder import RunFolder
from mijax.seeds import evaluation_key, training_key
from mijax.trained import Training, load_learner_state

CONFIG = Config(
    agent="base", memory="gru", steps=1000,
    network=NetworkConfig(action_embedding=4, observation_embedding=4, gru_width=8, critic_hidden=(16,)),
    dqn=DQNConfig(batch_episodes=4, warmup_episodes=4, replay_steps=400), evaluation=EvaluationConfig(every=20),
)
LEARNER = make_learner(registry.make("heaven_hell"), CONFIG)
STEP = 200
pytestmark = pytest.mark.lenient


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A run of seeds 0 and 3 that was stopped before its first update."""
    path = tmp_path_factory.mktemp("runs") / "run"
    folder = RunFolder.create(path, Training(CONFIG, (0, 3)).as_dict())
    init = jax.jit(LEARNER.init)
    for seed in (0, 3):
        checkpoints = Checkpoints(folder, seed)
        checkpoints.save(STEP, init(training_key(seed), None))
        checkpoints.close()
    return path


failure = functools.partial(failure_of, evaluate.main)


def test_the_table_holds_what_the_learner_measures(run: pathlib.Path, capsys: pytest.CaptureFixture[str]):
    assert evaluate.main([str(run), "--episodes", "32"]) == 0
    title, head, *lines = capsys.readouterr().out.splitlines()
    assert title == "heaven_hell, base, gru: 32 greedy episodes per seed"
    assert head.split() == ["seed", "step", "success", "return", "discounted", "return", "of", "optimum", "length",
                            "reveals"]
    assert [line.split()[0] for line in lines] == ["0", "3", "mean"]
    _, state = load_learner_state(RunFolder.open(run), 3, LEARNER)
    results = jax.jit(LEARNER.evaluate, static_argnums=2)(state, evaluation_key(3, STEP), 32)
    means = {name: float(np.mean(values)) for name, values in results.items()}
    best = optimum(LEARNER.env, CONFIG.evaluation.discount)
    assert best is not None
    means["of_optimum"] = means["discounted_return"] / best.discounted_return
    assert lines[1].split() == ["3", str(STEP), *(f"{means[name]:.3f}" for name in evaluate.COLUMNS if name in means)]


def test_a_cut_memory_is_an_episode_that_began_later():
    """Up to the cut both act alike; then as if the oldest step that is remembered were the first."""
    agent, params, kept = LEARNER.agent, jax.jit(LEARNER.agent.init)(jax.random.key(0), None).target, 3
    cut, act = Forgetful(agent, kept), jax.jit(agent.act)
    spec = LEARNER.env.observation_spec
    seen = jax.random.uniform(jax.random.key(1), (5, 2, *spec.shape), minval=0.0, maxval=9.0).astype(spec.dtype)
    before = jnp.array([[-1, -1], [0, 1], [2, 3], [1, 1], [3, 0]], jnp.int32)

    def told(first: int, last: int) -> np.ndarray:
        """The agent's memory after steps `first` to `last`."""
        memory = agent.initial_memory(2)
        for step in range(first, last + 1):
            memory, _ = act(params, memory, seen[step], before[step])
        return np.asarray(memory.recurrent)

    window = cut.initial_memory(2)
    for step in range(5):
        window, action = jax.jit(cut.act)(params, window, seen[step], before[step])
        first = max(0, step - kept + 1)
        memory = agent.initial_memory(2)
        expected = jnp.zeros(2, jnp.int32)
        for earlier in range(first, step + 1):
            memory, expected = act(params, memory, seen[earlier], before[earlier])
        np.testing.assert_array_equal(action, expected)
    assert np.abs(told(0, 4) - told(2, 4)).max() > 1e-3


def test_what_cannot_be_drawn_is_said_before_anything_is_played(
    run: pathlib.Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(draw, "GridWorld", ())
    assert "'heaven_hell' cannot be drawn" in failure_of(evaluate.main, capsys, str(run), "--gif")


def test_an_episode_is_drawn_and_printed(run: pathlib.Path, capsys: pytest.CaptureFixture[str]):
    assert evaluate.main([str(run), "--seeds", "3,", "--episodes", "4", "--gif", "--text"]) == 0
    said = capsys.readouterr().out
    _, state = load_learner_state(RunFolder.open(run), 3, LEARNER)
    states = evaluate.play(LEARNER, state, evaluation_key(3, STEP))
    times = [int(env_state.time) for env_state in states]
    assert times == list(range(len(times)))
    ended = bool(LEARNER.env.tables.terminal[states[-1].cell, states[-1].goal])  # pyright: ignore
    assert ended or times[-1] == LEARNER.env.horizon
    assert [line.split()[1] for line in said.splitlines() if line.startswith("step")] == [str(t) for t in times]
    gif = run / "seed_3" / "episode.gif"
    assert str(gif) in said
    with Image.open(gif) as image:
        assert 1 <= getattr(image, "n_frames", 1) <= len(times)  # equal frames in a row are stored once
    assert not (run / "seed_0" / "episode.gif").exists()


def test_what_cannot_be_evaluated_is_named(
    run: pathlib.Path, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
):
    assert "no such run folder" in failure(capsys, str(tmp_path / "nothing"))
    assert "--remember: got -1" in failure(capsys, str(run), "--remember", "-1")
    assert "--remember: got 51, accepted: a number <= 50" in failure(capsys, str(run), "--remember", "51")
    assert "--episodes: got 0" in failure(capsys, str(run), "--episodes", "0")
    assert "has no seed 7 (it has 0, 3)" in failure(capsys, str(run), "--seeds", "0,7")
    fresh = RunFolder.create(tmp_path / "fresh", Training(CONFIG, (0,)).as_dict())
    assert "has no seed (it has none)" in failure(capsys, str(fresh.path))
    fresh.seed_path(0).mkdir()
    assert "seed 0 has no checkpoint yet" in failure(capsys, str(fresh.path))
    assert not (fresh.seed_path(0) / "checkpoints").exists()
    representation = RunFolder.create(tmp_path / "represented", {"domain": "sphinx", "stage1": {}})
    assert "holds representations but no agent" in failure(capsys, str(representation.path))
    stored = json.loads((fresh.path / "config.json").read_text())
    (fresh.path / "config.json").write_text(json.dumps(stored | {"sac": {"wings": 2}}))
    message = f"{fresh.path / 'config.json'}: --sac.wings: this version has no such option"
    assert message in failure(capsys, str(fresh.path))
    (fresh.path / "config.json").write_text(json.dumps(stored | {"domain": "mars"}))
    assert "'mars'" in failure(capsys, str(fresh.path))

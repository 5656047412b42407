"""The paper's experiments: which runs they need, that they never make one twice, and their figures and tables."""

import dataclasses
import pathlib
import shutil
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image
from tiny_runs import TINY, comparable

from launch import paper
from launch.experiments import AGENTS, DOMAINS, EXPERIMENTS, ablations, memories, overlap, parts
from mijax import figures, tables
from mijax.results import ReportedRun
from mijax.run_folder import RunError, RunFolder

OPTIONS = (*TINY, "--network.gru-width", "8", "--stage1.epochs", "1", "--seeds.strategy", "map")
pytestmark = pytest.mark.lenient


def test_every_figure_is_planned_cheap_domains_first() -> None:
    assert set(EXPERIMENTS) == {"fig3", "fig4", "fig5", "fig6", "fig29", "fig30", "fig31", "fig32", "parts"}
    assert [arm.options[1] for arm in AGENTS] == ["mi", "base", "zp", "ba", "ua", "believer"]
    assert paper.plan("fig3", None) == [("fig3", DOMAINS)]
    assert paper.plan("fig3", "sphinx") == [("fig3", ("sphinx",))]
    everything = paper.plan("all", None)
    assert {name for name, _ in everything} == set(EXPERIMENTS)
    last_domains = [DOMAINS.index(domains[-1]) for _, domains in everything]
    assert last_domains == sorted(last_domains)
    assert "fig4" not in {name for name, _ in paper.plan("all", "sphinx")}


def test_experiments_share_their_runs() -> None:
    (gpt, gru), = memories("sphinx").values()
    (both, *_), = ablations("sphinx").values()
    assert gpt.name == both.name == AGENTS[0].name
    assert gru.options[-2:] == ("--memory", "gru")
    (with_bonus, without, _), = ablations("carflag_2d").values()  # whose preset has no bonus
    assert "--information.intrinsic-weight" in with_bonus.options
    assert with_bonus.name != AGENTS[0].name
    assert without.options[-2:] == ("--information.intrinsic-weight", "0")  # the last one counts
    ours, believers = overlap("heaven_hell").values()
    assert ours[2] == believers[2]  # the raw state has nothing to do with features
    assert {arm.features for arm in believers} == {"believer", None}


def test_figures_of_a_domain_have_its_name() -> None:
    every = paper.Request(pathlib.Path("out"), None, (0,), None, ())
    one = dataclasses.replace(every, domain="examples.signpost:Signpost")
    assert [str(request.place("fig3", ".md")) for request in (every, one)] == [
        "out/fig3.md", "out/fig3_examples.signpost.Signpost.md"]


def test_who_looks_through_whose_features() -> None:
    """On robots every agent looks through psi's body; Believer's is its own."""
    request = paper.Request(pathlib.Path("nowhere"), None, (0,), None, ())
    robots, grid = ([paper.features_of(arm, request.parse(domain, arm).config) for arm in AGENTS]
                    for domain in ("block_pulling", "heaven_hell"))
    assert robots == ["ours"] * 5 + [None]
    assert grid == ["ours"] + [None] * 5
    (whole, *fewer), = parts("block_pulling").values()
    trained = [request.parse("block_pulling", arm).config for arm in (whole, *fewer)]
    assert len({str(config) for config in trained}) == len(trained) == 6


def test_only_what_an_agent_reads_must_be_the_same(tmp_path: pathlib.Path) -> None:
    request = paper.Request(tmp_path, None, (0,), None, ())
    options = request.parse("heaven_hell", AGENTS[1])
    stored: dict[str, Any] = dataclasses.asdict(options.config) | {"seed_list": [0]}
    others: dict[str, dict[str, Any]] = {"believer": {"samples": 3}, "sac": {"discount": 0.5}, "stage1": {"epochs": 3}}
    run = RunFolder.create(tmp_path / "run", stored | {name: stored[name] | group for name, group in others.items()})
    paper.check_same(run, options)
    run = RunFolder.create(tmp_path / "other", stored | {"dqn": stored["dqn"] | {"discount": 0.5}})
    with pytest.raises(RunError, match=r"--dqn\.discount 0\.5, wanted 0\.97"):
        paper.check_same(run, options)


def test_a_figure_says_what_it_was_given() -> None:
    request = paper.Request(pathlib.Path("out"), None, (0, 1), 600, ())
    assert paper.note_on(request, ["sphinx"], {"sphinx": 600}) == (
        "Sphinx: 2 seeds, 600 steps (paper: 5 seeds, 500,000 steps)")
    whole = dataclasses.replace(request, seeds=(0, 1, 2, 3, 4), extra=("--sac.demonstrations", "3"))
    assert paper.note_on(whole, ["block_pulling"], {"block_pulling": 40_000}) == (
        "Block-Pulling: 5 seeds, 40,000 steps. With --sac.demonstrations 3")


def test_agents_are_charged_for_the_random_steps_of_their_features() -> None:
    request = paper.Request(pathlib.Path("out"), "heaven_hell", (0, 1), None, ())
    ours, base, *_, believer = (paper.stage1_samples(request, "heaven_hell", arm) for arm in AGENTS)
    assert ours == {0: 6423, 1: 6647}
    assert base == {0: 0, 1: 0}
    assert min(believer.values()) > 6000


def test_curves_are_drawn_where_the_numbers_are(monkeypatch: pytest.MonkeyPatch, tmp_path: pathlib.Path) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, path: drawn.append(figure))
    steps = tuple(range(10, 210, 10))
    ours = dataclasses.replace(run_solved_at("ours", [None, 10, 10, 10, 10, 10], steps), colour="#0000ff",
                               begun=dict.fromkeys(range(6), 40))
    figures.draw_groups({"Sphinx": [ours]}, tmp_path / "figure.png", title="title")
    mean, middle = drawn[0].axes

    def curve(axis: Axes) -> np.ndarray:
        return next(np.asarray(line.get_xydata()) for line in axis.lines if line.get_linewidth() == 1.8)

    def band(axis: Axes) -> np.ndarray:
        return np.asarray(axis.collections[0].get_paths()[0].vertices)[:, 1]

    np.testing.assert_array_equal(curve(mean)[[0, -1], 0], [50, 240])
    np.testing.assert_allclose(curve(mean)[:, 1], 5 / 6)
    np.testing.assert_allclose(curve(middle)[:, 1], 1)
    std = np.std([0, 1, 1, 1, 1, 1], ddof=1)
    np.testing.assert_allclose([band(mean).min(), band(mean).max()], [5 / 6 - std, 5 / 6 + std])
    assert band(middle).min() < 1
    for axis in drawn[0].axes:
        assert 40 in {line.get_xdata()[0] for line in axis.lines}  # pyright: ignore[reportIndexIssue]


def command(out: pathlib.Path) -> list[str]:
    """The options that all runs here share."""
    return ["--domain", "heaven_hell", "--steps", "600", "--out", str(out), *OPTIONS]


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """Fig. 5 on Heaven-Hell, one seed, a few steps."""
    out = tmp_path_factory.mktemp("paper")
    assert paper.main(["fig5", "--seeds", "1", *command(out)]) == 0
    return out


def test_one_arm_of_an_experiment_is_trained_once(tmp_path: pathlib.Path) -> None:
    arguments = ["fig3", "--seeds", "1", "--arms", "base", *command(tmp_path)]
    assert paper.main(arguments) == 0
    text = (tmp_path / "fig3_heaven_hell.md").read_text()
    assert "1 seed, 600 steps (paper: 5 seeds, 500,000 steps). With --" in text
    assert "Left out: Ours, ZP-DRQN" in text
    assert "| DTQN" in text
    before = contents(tmp_path)
    (tmp_path / "fig3_heaven_hell.png").unlink()
    assert paper.main(arguments) == 0
    assert contents(tmp_path) == before
    with Image.open(tmp_path / "fig3_heaven_hell.png") as image:
        assert min(image.size) > 300


def contents(out: pathlib.Path) -> dict[pathlib.Path, tuple[int, int]]:
    """Size and time of every file of the runs."""
    files = (path for path in (out / "runs").rglob("*") if path.is_file())
    return {path: (path.stat().st_size, path.stat().st_mtime_ns) for path in files}


@pytest.mark.slow
def test_an_experiment_leaves_its_figure_and_table(done: pathlib.Path) -> None:
    text = (done / "fig5_heaven_hell.md").read_text()
    assert "1 seed, 600 steps (paper: 5 seeds, 500,000 steps)" in text
    assert "P(Ours better), area" in text
    assert "--steps 600" in text
    with Image.open(done / "fig5_heaven_hell.png") as image:
        assert min(image.size) > 300
    places = {path.parent.parent.name for path in done.glob("runs/heaven_hell/*/*/summary.json")}
    assert places == {"mi-600", "mi-gru-600"}
    features = [path for path in (done / "runs" / "heaven_hell").rglob("representation.msgpack")
                if "seed_0" in path.parts]
    assert len(features) == 3  # the shared ones, and a copy in each run
    assert len({path.read_bytes() for path in features}) == 1


@pytest.mark.slow
def test_what_is_there_is_not_made_again_and_seeds_are_added(done: pathlib.Path) -> None:
    before = contents(done)
    assert paper.main(["fig5", "--seeds", "1", *command(done)]) == 0
    assert contents(done) == before
    assert paper.main(["fig32", "--seeds", "2", *command(done)]) == 0
    after = contents(done)
    assert before.items() <= after.items()
    assert RunFolder.open(done / "runs/heaven_hell/mi-600/seeds_1").seeds() == (1,)
    assert {path.name for path in done.glob("fig32*")} >= {"fig32_heaven_hell.png", "fig32_heaven_hell.md",
                                                             "fig32_heaven_hell_episode.png"}
    assert "| heaven_hell | 1 " in (done / "fig32_heaven_hell.md").read_text()


@pytest.mark.slow
def test_an_arm_can_be_left_out(done: pathlib.Path) -> None:
    assert paper.main(["fig5", "--seeds", "1", "--arms", "mi", *command(done)]) == 0
    text = (done / "fig5_heaven_hell.md").read_text()
    assert "Left out: Ours with a GRU" in text
    assert "--arms mi" in text


@pytest.mark.slow
def test_a_run_that_was_stopped_goes_on(done: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = RunFolder.open(done / "runs/heaven_hell/mi-gru-600/seeds_0")
    summary = run.summary()
    (run.path / "summary.json").unlink()
    before = comparable(run.path, 0)
    newest = max((run.seed_path(0) / "checkpoints").glob("[0-9]*"), key=lambda path: int(path.name))
    shutil.rmtree(newest)
    started = []
    real = paper.train.train

    def watched(options, say):
        started.append(options.resume)
        return real(options, say)

    monkeypatch.setattr(paper.train, "train", watched)
    assert paper.main(["fig5", "--seeds", "1", *command(done)]) == 0
    assert started == [run.path]
    again = run.summary()
    assert again is not None
    assert summary is not None
    assert again["seeds"]["0"]["steps"] == summary["seeds"]["0"]["steps"]
    assert comparable(run.path, 0) == before


@pytest.mark.parametrize(("arguments", "message"), [
    (["fig7"], "experiment: got 'fig7', accepted: fig4, fig3"),
    (["fig3", "--domain", "mars"], "unknown domain 'mars'"),
    (["fig3", "--seeds", "x"], "--seeds: got 'x'"),
    (["fig3", "--steps", "0"], "--steps: got 0"),
    (["fig3", "--arms", "mi,me"], "--arms: got 'mi,me', accepted: some of mi,base,zp,ba,ua,believer"),
    (["fig32", "--domain", "block_pulling"], "--domain: got 'block_pulling', accepted: one with discrete actions"),
    (["parts", "--domain", "heaven_hell"], "one whose mi reads --sac.rotated-copies, which parts changes"),
    (["fig3", "--agent", "mi"], "--agent: got 'a value', accepted: nothing here"),
    (["fig3", "--hosts", "auto"], "--hosts: got 'a value', accepted: nothing here"),
])
def test_bad_input_is_one_line(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert paper.main([*arguments, "--out", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.slow
def test_runs_of_other_options_are_not_taken(done: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert paper.main(["fig5", "--seeds", "1", *command(done), "--dqn.discount", "0.5"]) == 1
    assert "was made with --dqn.discount 0.97, wanted 0.5" in capsys.readouterr().err


def run_solved_at(label: str, solved_at: list[int | None], steps: Sequence[int] = (10, 20, 30, 40)) -> ReportedRun:
    metrics = {seed: [{"step": step, "evaluation/success": float(at is not None and step >= at)} for step in steps]
               for seed, at in enumerate(solved_at)}
    seeds = {str(seed): {"success": float(at is not None), "steps_to_solve": at, "wall": {}}
             for seed, at in enumerate(solved_at)}
    return ReportedRun(label, "#000000", {"domain": "test", "seeds": seeds}, metrics)


def test_the_table_compares_ours_with_each() -> None:
    runs = [run_solved_at("ours", [10, 20]), run_solved_at("same", [10, 20]), run_solved_at("worse", [None, 30])]
    ours, same, worse = tables.comparison_table(runs)
    assert (ours["area_mean"], ours["solved"]) == (0.875, 2)
    assert "p_area" not in ours
    assert (same["p_area"], same["p_steps"]) == (0.5, 0.5)
    assert (worse["p_area"], worse["p_steps"], worse["solved"]) == (1.0, 1.0, 1)
    np.testing.assert_allclose(worse["area_std"], np.std([0.0, 0.5], ddof=1))
    text = tables.comparison_markdown([runs[0], runs[2]])
    assert "1.000 [1.000, 1.000]" in text


def test_the_table_counts_the_steps_before_a_run_by_seed() -> None:
    ours, theirs, worse = run_solved_at("ours", [10, 20]), run_solved_at("theirs", [10, 20]), run_solved_at("w", [None])
    later = dataclasses.replace(ours, begun={0: 20, 1: 10})  # solved at 30 and 30; two and three of four evaluations
    assert [list(steps) for steps, _ in later.curves("evaluation/success")] == [[30, 40, 50, 60], [20, 30, 40, 50]]
    first, second, _ = tables.comparison_table([later, theirs, worse])
    assert (first["area_mean"], first["steps_to_solve"]) == (0.5, 30)
    assert (second["area_mean"], second["p_steps"], second["p_area"]) == (0.875, 0.0, 0.0)

    late = dataclasses.replace(ours, begun={0: 40, 1: 40})  # solved after the last step of the others: no better
    first, *_, never = tables.comparison_table([late, theirs, worse])
    assert (first["solved"], first["area_mean"], never["p_steps"], never["p_area"]) == (2, 0.0, 0.5, 0.5)


def test_the_area_counts_the_random_steps_at_the_start_of_a_run() -> None:
    warm = run_solved_at("warm", [30], steps=(30, 40))
    first, second = tables.comparison_table([run_solved_at("ours", [30]), warm])
    assert first["area_mean"] == second["area_mean"] == 0.5

"""The page of a report: its data against the tables, and what it does in a browser."""

import base64
import csv
import io
import pathlib
import re
from collections.abc import Iterator

import numpy as np
import pytest
from chromium import PROGRAM, Chromium
from PIL import Image

from envs_mjx import registry
from envs_mjx.base import ArraySpec
from envs_mjx.grid.world import GridState
from mijax import page, report, results
from mijax.config import Config
from mijax.episode import Trace
from mijax.learner import make_learner
from mijax.page import episodes
from mijax.results import ReportedRun
from mijax.run_folder import RunError, RunFolder

LENGTH, TOLD = 6, 4
CELLS = (24, 31, 32, 33, 34, 33, 32)
"""From the start down and right to the priest, and back."""


def make_run(path: pathlib.Path, agent: str, solved_at: int, seeds: tuple[int, ...] = (0, 1, 2)) -> RunFolder:
    """Success goes from 0 to 1 in evaluation `solved_at` plus the seed, of ten."""
    run = RunFolder.create(path, {"domain": "heaven_hell", "agent": agent, "memory": "gpt", "dqn": {"discount": 0.97}})
    for seed in seeds:
        for evaluation in range(10):
            success = float(evaluation >= solved_at + seed)
            run.append(seed, {
                "step": 1000 * (evaluation + 1), "update": evaluation, "evaluation/success": success,
                "evaluation/return": 2 * success - 1, "evaluation/length": 50 - 36 * success,
                "loss/td": 0.1 / (1 + evaluation), "wall/update": 2.0})
    run.write_summary(results.summarise(run, optimum={"return": 1.0, "success": 1.0}))
    return run


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[ReportedRun]:
    folder = tmp_path_factory.mktemp("runs")
    for agent, solved_at in (("mi", 2), ("base", 7)):
        make_run(folder / agent, agent, solved_at)
    return results.load([folder / "mi", folder / "base"])


@pytest.fixture(scope="module")
def played() -> episodes.Episodes:
    """An episode of Heaven-Hell, made by hand: the agent asks, and from then on attends to what it was told."""
    learner = make_learner(registry.make("heaven_hell"), Config())
    tokens = 51
    cells = np.full((1, tokens), CELLS[-1], np.int32)
    cells[0, : LENGTH + 1] = CELLS
    reveals = cells == CELLS[TOLD]
    explained = np.where(np.arange(tokens) >= TOLD, 0.95, 0.05)[None]
    bonus = np.zeros((1, tokens))
    bonus[0, TOLD] = 0.9
    attention = np.zeros((1, 2, tokens, tokens))
    for step in range(tokens):
        attention[0, 0, step, min(step, TOLD)] = 1.0
        attention[0, 1, step, step] = 1.0
    q = np.tile(np.arange(4.0), (1, tokens, 1))
    trace = Trace(
        env_state=GridState(cell=cells, goal=np.zeros((1, tokens), np.int32),  # pyright: ignore[reportArgumentType]
                            time=np.arange(tokens, dtype=np.int32)[None]),  # pyright: ignore[reportArgumentType]
        observation=np.zeros((1, tokens, 3)), state=np.zeros((1, tokens, 3)), truth=np.zeros((1, tokens, 3)),
        reward=np.where(np.arange(tokens) == LENGTH, 1.0, 0.0)[None], reveals=reveals, length=np.array([LENGTH]),
        action=np.full((1, tokens), 3), q=q, bonus=bonus, explained=explained, explained_by_agent=None,
        attention=attention)
    return episodes.episode_data(learner, trace, seed=2, step=5000)


@pytest.fixture(scope="module")
def written(runs: list[ReportedRun], played: episodes.Episodes, tmp_path_factory: pytest.TempPathFactory
            ) -> pathlib.Path:
    path = tmp_path_factory.mktemp("page") / page.FILE
    page.write_page(runs, path, [played, "seed 0 has no checkpoint yet"], note="a line under the title")
    return path


def test_the_data_are_the_tables(runs: list[ReportedRun], written: pathlib.Path, tmp_path: pathlib.Path) -> None:
    report.write_report(runs, tmp_path)
    data = page.read_data(written)
    for name in ("runs", "seeds"):
        with (tmp_path / f"{name}.csv").open(newline="") as file:
            lines = list(csv.DictReader(file))
        table = data[f"{name.removesuffix('s')}_table"]
        assert len(table) == len(lines)
        for shown, line in zip(table, lines, strict=True):
            assert {key: "" if shown.get(key) is None else str(shown[key]) for key in line} == line


def test_the_curves_are_those_of_the_seeds(runs: list[ReportedRun], written: pathlib.Path) -> None:
    curves = page.read_data(written)["runs"][0]["curves"]
    assert list(curves) == ["evaluation/success", "evaluation/return", "evaluation/length", "loss/td"]
    success = curves["evaluation/success"]
    assert success["steps"] == list(range(1000, 11_000, 1000))
    assert [seed["values"].index(1.0) for seed in success["seeds"]] == [2, 3, 4]
    assert success["mean"][3] == pytest.approx(2 / 3, abs=1e-5)
    assert success["std"][3] == pytest.approx(3**-0.5, abs=1e-5)
    assert success["iqm"][3] == success["mean"][3]  # nothing is cut of three seeds
    assert all("steps" not in seed for seed in success["seeds"])


def test_seeds_may_have_been_evaluated_at_other_steps(tmp_path: pathlib.Path) -> None:
    run = make_run(tmp_path / "run", "mi", 2, seeds=(0, 1))
    run.append(1, {"step": 12_500, "loss/td": 0.5})
    curve = page.page_data(results.load([run.path]), [None])["runs"][0]["curves"]["loss/td"]
    assert curve["steps"][-1] == 10_000  # the last that both have
    assert curve["seeds"][1]["steps"][-1] == 12_500


def test_published_results_are_read(tmp_path: pathlib.Path) -> None:
    run = make_run(tmp_path / "run", "mi", 2)
    before = page.page_data(results.load([run.path]), [None])
    for seed in run.seeds():
        (run.seed_path(seed) / "metrics.jsonl").rename(run.path / f"metrics_seed_{seed}.jsonl")
        run.seed_path(seed).rmdir()
    assert page.page_data(results.load([run.path]), [None]) == before


def test_options_tell_what_differs(written: pathlib.Path) -> None:
    options = {line["name"]: line for line in page.read_data(written)["options"]}
    assert options["agent"] == {"name": "agent", "values": ["mi", "base"], "differs": True}
    assert options["dqn.discount"] == {"name": "dqn.discount", "values": ["0.97", "0.97"], "differs": False}
    assert not options["versions.python"]["differs"]


def test_nothing_is_loaded(written: pathlib.Path) -> None:
    text = written.read_text()
    assert len(text.encode()) < page.LARGEST
    assert not re.search(r"https?://|@import|<link|\bsrc=\"(?!data:)|url\((?!#)|fetch\(|XMLHttp|WebSocket", text)
    assert "default-src 'none'" in text


def test_a_label_cannot_end_the_data(tmp_path: pathlib.Path) -> None:
    run = make_run(tmp_path / "run", "mi", 2)
    label = "</script><img src=x>"
    page.write_page(results.load([run.path], [label]), tmp_path / "page.html", [None])
    assert label not in (tmp_path / "page.html").read_text()
    assert page.read_data(tmp_path / "page.html")["runs"][0]["label"] == label


def test_a_page_that_would_be_too_large_has_coarser_curves(
    runs: list[ReportedRun], tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, coarse = (len(page.render(page.page_data(runs, [None, None], points=points)).encode()) for points in (10, 4))
    monkeypatch.setattr(page, "POINTS", (10, 4))
    monkeypatch.setattr(page, "LARGEST", whole - 1)
    page.write_page(runs, tmp_path / "page.html", [None, None])
    assert page.read_data(tmp_path / "page.html")["runs"][0]["curves"]["loss/td"]["steps"] == [1000, 4000, 7000, 10_000]
    monkeypatch.setattr(page, "LARGEST", coarse - 1)
    with pytest.raises(RunError, match="accepted: fewer runs"):
        page.write_page(runs, tmp_path / "page.html", [None, None])


def test_an_episode_is_cut_at_its_end(played: episodes.Episodes) -> None:
    (episode,) = played["episodes"]
    assert played["actions"] == ["right", "up", "left", "down"]
    assert episode["grid"]["cells"] == list(CELLS)
    assert episode["grid"]["told"] == [step == TOLD for step in range(LENGTH + 1)]
    assert episode["grid"]["kinds"][0] == "G.....x"
    assert episode["bonus"][TOLD] == 0.9
    assert len(episode["q"]) == len(episode["explained"]) == LENGTH + 1
    assert [len(row) for row in episode["attention"][0]] == list(range(1, LENGTH + 2))
    assert episode["explained_by_agent"] is None


def test_images_become_small_pictures() -> None:
    frames = np.zeros((3, 84, 84, 2), np.float32)
    frames[1, 40:, :, 0] = 0.3
    view = episodes._view(frames, ArraySpec((84, 84, 2), np.float32, blank=1), near_is_bright=True)
    (channel,) = view["images"]  # the blank one is left out
    pictures = [np.asarray(Image.open(io.BytesIO(base64.b64decode(png)))) for png in channel]
    assert pictures[1].shape == (84, 84)
    assert (pictures[1][0, 0], pictures[1][83, 83], pictures[2][83, 83]) == (255, 0, 255)


def test_the_command_tells_why_there_is_no_episode(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = make_run(tmp_path / "run", "mi", 2)
    assert report.main([str(run.path), "--html"]) == 0
    said = capsys.readouterr()
    assert str(run.path / page.FILE) in said.out
    assert "shown without episodes: mi: seed 0 has no checkpoint, only results" in said.err
    assert "seed 0 has no checkpoint, only results" in page.read_data(run.path / page.FILE)["runs"][0]["episodes"]
    for arguments, message in (
        (["--html", "--episode"], "--html: got it with --episode"),
        (["--html", "--seed", "9"], "has no seed 9 (it has 0, 1, 2)"),
    ):
        assert report.main([str(run.path), *arguments]) == 1
        error = capsys.readouterr().err.splitlines()
        assert message in error[-1]
        assert len(error) == 1


# ------------------------------------------------------------------------------------------------------- in a browser


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    if PROGRAM is None:
        pytest.skip("no Chromium is installed: apt-get install chromium")
    chromium = Chromium(tmp_path_factory.mktemp("profile"))
    yield chromium
    chromium.close()


@pytest.fixture
def tab(browser: Chromium, written: pathlib.Path) -> Iterator[Chromium]:
    """The page at the width of a desktop, without complaints at the end."""
    browser.complaints.clear()
    browser.requests.clear()
    browser.resize(1280, 900)
    browser.open(written)
    yield browser
    assert browser.complaints == []
    assert [url for url in browser.requests if not url.startswith(("file:", "data:"))] == []


def step_of(tab: Chromium) -> int:
    slider = int(tab.evaluate("document.getElementById('position').value"))
    assert tab.text("#moment").startswith(f"Step {slider} of {LENGTH}")
    return slider


def test_keys_step_through_the_episode(tab: Chromium) -> None:
    tab.evaluate("document.getElementById('episode').focus()")
    steps = []
    for key in ("ArrowRight", "ArrowRight", "ArrowLeft", "End", "ArrowRight", "Home", "ArrowLeft"):
        tab.press(key)
        steps.append(step_of(tab))
    assert steps == [1, 2, 1, LENGTH, LENGTH, 0, 0]
    tab.press(" ")
    assert tab.evaluate("document.getElementById('play').getAttribute('aria-label')") == "Pause"
    tab.evaluate("new Promise((done) => { const wait = () => document.getElementById('position').value >= 2"
                 " ? done() : setTimeout(wait, 20); wait(); })")
    tab.press(" ")
    assert step_of(tab) >= 2
    tab.evaluate("document.getElementById('position').focus()")  # the slider's own keys do the same
    tab.press("Home")
    tab.press("ArrowRight")
    assert step_of(tab) == 1


def test_a_moment_shows_what_is_seen_true_and_remembered(tab: Chromium) -> None:
    tab.evaluate("document.getElementById('episode').focus()")
    assert "not shown" in tab.text("#panels .panel:nth-child(1)")
    assert "f explains: 0.050" in tab.text("#panels .panel:nth-child(3)")
    for _ in range(TOLD):
        tab.press("ArrowRight")
    assert "the goal is at row 0, column 0" in tab.text("#panels .panel:nth-child(1)")
    assert "side (hidden)" in tab.text("#panels .panel:nth-child(2)")
    assert "f explains: 0.950" in tab.text("#panels .panel:nth-child(3)")
    assert "bonus 0.450; sees what is otherwise hidden" in tab.text("#moment")  # weight 0.5
    tab.press("End")
    assert f"step {TOLD} (0.50), step {LENGTH} (0.50)" in tab.text("#panels .panel:nth-child(3)")
    assert "down \u2013" in tab.text("#series")  # nothing is done at the end
    tab.press("ArrowLeft")
    assert "down 3.000" in tab.text("#series .taken")


def test_the_mouse_steps_and_reads(tab: Chromium) -> None:
    tab.point("#on", 0.5, 0.5, click=True)
    assert step_of(tab) == 1
    tab.point("#series .strip svg", 0.999, 0.5, click=True)
    assert step_of(tab) == LENGTH
    tab.point("#curve", 0.5, 0.06)
    assert re.search(r"success at step 5,000", tab.text("#reading-title"))
    assert tab.text("#curve .tag") == "mi, seed 0: 1.000 at 5,000"
    assert "1.000 ± 0.000" in tab.text("#reading")
    tab.evaluate("document.getElementById('curve').focus()")
    tab.press("Home")
    assert tab.evaluate("document.getElementById('curve').getAttribute('aria-valuetext')") == (
        "step 1,000, success: mi 0.000, base 0.000")


def test_tables_are_sorted_and_runs_chosen(tab: Chromium) -> None:
    def column(number: int) -> list[str]:
        return tab.evaluate(f"[...document.querySelectorAll('#seed-table td:nth-child({number})')]"
                            ".map((cell) => cell.textContent)")

    assert column(2) == ["0", "1", "2"] * 2
    heads = tab.evaluate("[...document.querySelectorAll('#seed-table th')].map((cell) => cell.textContent)")
    place = heads.index("steps to solve") + 1
    for _ in range(2):
        tab.point(f"#seed-table th:nth-child({place}) button", 0.5, 0.5, click=True)
    assert column(place) == ["10,000", "9,000", "8,000", "5,000", "4,000", "3,000"]
    assert tab.evaluate(f"document.querySelector('#seed-table th:nth-child({place})').getAttribute('aria-sort')"
                        ) == "descending"
    tab.evaluate("(() => { const menu = document.getElementById('episode-run'); menu.value = 1;"
                 "menu.dispatchEvent(new Event('change')); })()")
    assert "seed 0 has no checkpoint yet" in tab.text("#episode-missing")


@pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 900)])
@pytest.mark.parametrize("dark", [False, True])
def test_the_page_fits(tab: Chromium, tmp_path: pathlib.Path, width: int, height: int, dark: bool) -> None:
    tab.resize(width, height, dark)
    assert tab.evaluate("document.documentElement.scrollWidth") == width
    assert tab.evaluate("document.getElementById('curve').getBoundingClientRect().width") > 0.85 * width
    unnamed = "[...document.querySelectorAll('input, select, button, [tabindex]')].filter((element) => !(" \
              "element.labels?.length || element.textContent.trim() || element.getAttribute('aria-label') ||" \
              "element.getAttribute('aria-labelledby'))).length"
    assert tab.evaluate(unnamed) == 0
    tab.screenshot(tmp_path / "page.png")
    paper = Image.open(tmp_path / "page.png").convert("L").getpixel((2, 2))
    assert isinstance(paper, int | float)
    assert (paper < 60) is dark

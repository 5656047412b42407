"""Reports of synthetic runs: the numbers by hand, the figures by their pixels."""

import csv

import pytest
from matplotlib.figure import Figure
from PIL import Image

from mijax import report, results
from mijax.run_folder import RunError, RunFolder

OPTIMUM = {"return": 1.0, "discounted_return": 0.8, "success": 1.0}


def make_run(path, *, agent="mi", memory="gpt", domain="heaven_hell", seeds=(0, 1, 2), solved_at=3, finished=True):
    """Success goes from 0 to 1 in evaluation `solved_at` plus the seed, of ten."""
    run = RunFolder.create(path, {"domain": domain, "agent": agent, "memory": memory})
    for seed in seeds:
        for evaluation in range(10):
            success = float(evaluation >= solved_at + seed)
            run.append(seed, {
                "step": 1000 * (evaluation + 1), "evaluation/success": success, "evaluation/return": 2 * success - 1,
                "evaluation/discounted_return": 0.8 * success, "evaluation/length": 50 - 36 * success,
                "wall/evaluation": 0.5, "wall/update": 2.0,
            })
    if finished:
        run.write_summary(results.summarise(run, optimum=OPTIMUM, wall={seed: {"compile": 7.0} for seed in seeds}))
    return run


def read_csv(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_summary(tmp_path):
    summary = results.summarise(make_run(tmp_path / "a", seeds=(0, 7)), optimum=OPTIMUM,
                               final={0: {"success": 0.99, "discounted_return": 0.6}}, wall={7: {"compile": 7.0}})
    assert (summary["domain"], summary["agent"], summary["memory"]) == ("heaven_hell", "mi", "gpt")
    first, second = summary["seeds"]["0"], summary["seeds"]["7"]
    assert first["success"] == 0.99  # the separate evaluation at the end
    assert first["length"] == 14.0  # the last five evaluations
    assert first["fraction_of_optimum"] == pytest.approx(0.75)
    assert first["steps_to_solve"] == 4000
    assert first["wall"] == {"evaluation": 5.0, "update": 20.0}
    assert second["wall"] == {"compile": 7.0, "evaluation": 5.0, "update": 20.0}
    assert second["steps_to_solve"] is None  # seed 7 would be solved in evaluation 10
    assert second["success"] == 0.0
    assert second["steps"] == 10_000


def test_summary_without_optimum(tmp_path):
    seed = results.summarise(make_run(tmp_path / "a", seeds=(0,)))["seeds"]["0"]
    assert seed["fraction_of_optimum"] is None
    assert results.summarise(make_run(tmp_path / "b"))["optimum"] is None


def test_report_of_one_run_goes_into_it(tmp_path, capsys):
    run = make_run(tmp_path / "a")
    assert report.main([str(run.path)]) == 0
    assert {"curve.png", "runs.csv", "seeds.csv", "report.md"} <= {file.name for file in run.path.iterdir()}
    assert (run.path / "report.md").read_text() in capsys.readouterr().out
    assert RunFolder.open(run.path).seeds() == (0, 1, 2)


def test_tables(tmp_path):
    make_run(tmp_path / "a")
    make_run(tmp_path / "b", agent="base", solved_at=9, finished=False)
    runs = results.load([tmp_path / "a", tmp_path / "b"])
    text = report.write_report(runs, tmp_path / "out")
    ours, theirs = read_csv(tmp_path / "out" / "runs.csv")
    assert (ours["run"], theirs["run"]) == ("mi", "base")
    assert (ours["solved"], theirs["solved"]) == ("3", "1")
    assert float(ours["steps_to_solve"]) == 5000
    assert theirs["steps_to_solve"] == ""
    assert float(ours["wall"]) == 32.0
    assert float(theirs["success_mean"]) == pytest.approx(0.2 / 3)
    seeds = read_csv(tmp_path / "out" / "seeds.csv")
    assert [(line["run"], line["seed"]) for line in seeds] == [(r, s) for r in ("mi", "base") for s in "012"]
    assert [line["steps_to_solve"] for line in seeds] == ["4000", "5000", "6000", "10000", "", ""]
    assert "1.000 ± 0.000" in text
    assert "| 3/3    | 5,000" in text
    assert "heaven_hell" not in text  # the only domain is not repeated on every line


def dominant_colours(path):
    image = Image.open(path).convert("RGB")
    counts = image.getcolors(maxcolors=image.width * image.height) or []
    return {"#{:02X}{:02X}{:02X}".format(*colour) for count, colour in counts if count > 200}  # type: ignore


def test_agents_keep_their_colours(tmp_path):
    for agent in ("mi", "base", "zp"):
        make_run(tmp_path / agent, agent=agent, solved_at={"mi": 1, "base": 4, "zp": 6}[agent])
    report.write_report(results.load([tmp_path / "zp", tmp_path / "mi", tmp_path / "base"]), tmp_path / "all", smooth=2)
    report.write_report(results.load([tmp_path / "base"]), tmp_path / "one", note="cut short")
    shown = dominant_colours(tmp_path / "all" / "curve.png")
    assert {results.AGENT_COLOURS[agent] for agent in ("mi", "base", "zp")} <= shown
    assert results.AGENT_COLOURS["base"] in dominant_colours(tmp_path / "one" / "curve.png")
    assert results.AGENT_COLOURS["mi"] not in dominant_colours(tmp_path / "one" / "curve.png")


def test_labels_tell_runs_apart(tmp_path):
    make_run(tmp_path / "gpt")
    make_run(tmp_path / "gru", memory="gru")
    make_run(tmp_path / "again")
    paths = [tmp_path / name for name in ("gpt", "gru", "again")]
    assert [run.label for run in results.load(paths[:2])] == ["mi (gpt)", "mi (gru)"]
    runs = results.load(paths)
    assert [run.label for run in runs] == ["gpt", "gru", "again"]
    assert len({run.colour for run in runs}) == 3
    assert runs[0].colour == results.AGENT_COLOURS["mi"]
    assert [run.label for run in results.load(paths, ["x", "y", "z"])] == ["x", "y", "z"]


def test_runs_of_one_colour_have_other_dashes_and_short_names(tmp_path):
    for number in range(9):
        make_run(tmp_path / f"sweep-{number}" / "run")
    runs = results.load(sorted(tmp_path.glob("*/run")))
    assert [run.label for run in runs] == [f"sweep-{number}/run" for number in range(9)]
    assert len({(run.colour, run.dashes) for run in runs}) == 9


def test_the_legend_of_many_runs_is_whole(tmp_path, monkeypatch):
    long = "network.gru-width=128-information.auxiliary-weight=0.5"
    for number in range(8):
        make_run(tmp_path / f"{long}-{number}")
    figures_made = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *arguments: (figures_made.append(self), save(self, *arguments)))
    report.write_report(results.load(sorted(tmp_path.glob("network*"))), tmp_path / "out")
    figure, = figures_made
    legend, inside = figure.legends[0].get_window_extent(), figure.bbox
    assert len(figure.legends[0].get_texts()) == 9  # with the optimum
    assert inside.x0 <= legend.x0 < legend.x1 <= inside.x1
    assert inside.y0 <= legend.y0 < legend.y1 <= inside.y1 + 1


def test_runs_that_have_no_evaluation_yet_are_left_out(tmp_path, capsys):
    make_run(tmp_path / "a")
    fresh = make_run(tmp_path / "b", agent="base", seeds=(0,), finished=False)
    fresh.truncate_after(-1, (0,))
    assert report.main([str(tmp_path / "a"), str(fresh.path), "--out", str(tmp_path / "out")]) == 0
    assert f"{fresh.path}: left out, no evaluation yet" in capsys.readouterr().err
    assert {line["run"] for line in read_csv(tmp_path / "out" / "runs.csv")} == {"mi"}
    assert report.main([str(fresh.path), "--out", str(tmp_path / "out")]) == 1
    assert "no evaluation yet" in capsys.readouterr().err


def test_a_folder_that_cannot_be_made_is_named(tmp_path, capsys):
    make_run(tmp_path / "a")
    (tmp_path / "file").touch()
    assert report.main([str(tmp_path / "a"), "--out", str(tmp_path / "file" / "out")]) == 1
    assert "--out: got" in capsys.readouterr().err


def test_domains_have_figures_of_their_own(tmp_path):
    make_run(tmp_path / "a")
    make_run(tmp_path / "b", domain="mine.envs:Maze", seeds=(0,))
    runs = results.load([tmp_path / "a", tmp_path / "b"])
    assert [run.label for run in runs] == ["mi, heaven_hell", "mi, mine.envs:Maze"]
    report.write_report(runs, tmp_path / "out")
    figures = {file.name for file in (tmp_path / "out").glob("*.png")}
    assert figures == {"curve_heaven_hell.png", "curve_mine.envs.Maze.png"}


def test_curves_of_different_lengths_are_drawn(tmp_path, monkeypatch):
    """Every seed to its own end; their mean as far as there are all of them."""
    run = make_run(tmp_path / "a", finished=False)
    run.append(2, {"step": 12_345, "evaluation/success": 1.0})
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, path: figures.append(figure))
    report.write_report(results.load([run.path]), tmp_path / "out")
    success = next(axis for axis in figures[0].axes if axis.get_ylabel() == "success")
    ends = sorted(float(line.get_xdata()[-1]) for line in success.lines)
    assert ends == [10_000] * 3 + [12_345]  # two seeds and the mean, and the third
    assert success.get_xlim() == (0, 12_345)


@pytest.mark.parametrize(("arguments", "message"), [
    ([], "runs: got none"),
    (["missing"], "missing: no such run folder"),
    (["a", "--labels", "x", "y"], "--labels: got 2, accepted: one for each of the 1 runs"),
    (["a", "a"], "--labels: got a a, accepted: a different one"),
    (["a", "--smooth", "0"], "--smooth: got 0"),
    (["empty"], "empty: no evaluation yet"),
])
def test_bad_input_is_one_line(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "a")
    RunFolder.create(tmp_path / "empty", {"domain": "sphinx", "agent": "mi", "memory": "gpt"})
    assert report.main(arguments) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    with pytest.raises(RunError):
        results.load([tmp_path / "empty"])

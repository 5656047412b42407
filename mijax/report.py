"""Draw any set of runs on shared axes and write their table.

    python -m mijax.report RUN... [--out DIR] [--labels NAME...] [--smooth N]

Writes into DIR: `curve.png` (`curve_DOMAIN.png` for each, when the runs are of several domains), `runs.csv`,
`seeds.csv` and `report.md` with both tables, which are also printed.
"""

import csv
import dataclasses
import pathlib
import sys
from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, Any

import matplotlib as mpl
import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from mijax import statistics
from mijax.metrics import Row, RunError, RunFolder

SOLVED = 0.95
"""Success from which an evaluation counts as solved."""
AVERAGED_EVALUATIONS = 5
"""The last evaluations that a seed's result is averaged over when it was not evaluated separately at the end."""
QUANTITIES = ("success", "return", "discounted_return", "fraction_of_optimum", "length", "reveals")
"""A seed's results, in the order of the table."""

AGENT_COLOURS = {
    "mi": "#0072B2", "base": "#D55E00", "ua": "#009E73", "ba": "#CC79A7", "zp": "#E69F00", "believer": "#56B4E9",
    "mdp": "#555555",
}
"""The palette of Okabe and Ito, told apart by colour-blind readers; an agent keeps its colour in every figure."""

_STYLE: Any = {
    "font.size": 9, "axes.titlesize": 9, "axes.labelsize": 9, "axes.spines.top": False, "axes.spines.right": False,
    "axes.edgecolor": "#888888", "axes.linewidth": 0.8, "axes.grid": True, "grid.color": "#e6e6e6",
    "grid.linewidth": 0.7, "axes.axisbelow": True, "xtick.color": "#444444", "ytick.color": "#444444",
    "xtick.major.size": 3, "ytick.major.size": 3, "legend.frameon": False, "figure.dpi": 100, "savefig.dpi": 160,
}


# ------------------------------------------------------------------------------------------------------------- summary


def summarise(run: RunFolder, *, optimum: Mapping[str, float] | None = None,
              final: Mapping[int, Mapping[str, float]] | None = None,
              wall: Mapping[int, Mapping[str, float]] | None = None) -> dict[str, Any]:
    """What a run came to; the content of summary.json.

    Args:
        run: the run folder.
        optimum: the belief-optimal values, any of `return`, `discounted_return`, `success` and `length`.
        final: per seed, the quantities of a separate evaluation at the end, without the prefix `evaluation/`; those not
            given are means over the last `AVERAGED_EVALUATIONS` evaluations.
        wall: per seed, seconds by part, added to what the metrics say under `wall/`.
    """
    config = run.config()
    seeds = {}
    for seed in run.seeds():
        rows = run.metrics(seed)
        if not rows:
            raise RunError(f"{run.seed_path(seed)}: no evaluation yet")
        results = {**_last_evaluations(rows), **(final or {}).get(seed, {})}
        best, reached = (optimum or {}).get("discounted_return"), results.get("discounted_return")
        fraction = reached / best if reached is not None and best is not None and best > 0 else None
        steps, success = _series(rows, "evaluation/success")
        seeds[str(seed)] = {
            **results,
            "fraction_of_optimum": fraction,
            "steps": rows[-1]["step"],
            "steps_to_solve": statistics.steps_to_threshold(list(steps), list(success), SOLVED),
            "wall": _wall_seconds(rows, (wall or {}).get(seed, {})),
        }
    if not seeds:
        raise RunError(f"{run.path}: no evaluation yet")
    names = {name: config.get(name) for name in ("domain", "agent", "memory")}
    return {**names, "optimum": None if optimum is None else dict(optimum), "seeds": seeds}


def _last_evaluations(rows: Sequence[Row]) -> dict[str, float]:
    results = {}
    for quantity in QUANTITIES:
        _, values = _series(rows, f"evaluation/{quantity}")
        if len(values):
            results[quantity] = float(np.mean(values[-AVERAGED_EVALUATIONS:]))
    return results


def _wall_seconds(rows: Sequence[Row], extra: Mapping[str, float]) -> dict[str, float]:
    seconds = dict(extra)
    for row in rows:
        for name, value in row.items():
            if name.startswith("wall/"):
                part = name.removeprefix("wall/")
                seconds[part] = seconds.get(part, 0.0) + float(value)
    return seconds


def _series(rows: Sequence[Row], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps and values of the lines that have `name`."""
    points = [(row["step"], row[name]) for row in rows if name in row]
    return np.array([step for step, _ in points], int), np.array([value for _, value in points], float)


# ---------------------------------------------------------------------------------------------------------------- runs


@dataclasses.dataclass(frozen=True)
class ReportedRun:
    """A run as it is shown: under a label, in a colour."""

    label: str
    colour: str
    summary: Mapping[str, Any]
    metrics: Mapping[int, Sequence[Row]]
    """The lines of each seed."""

    @property
    def domain(self) -> str:
        """The environment's name."""
        return self.summary["domain"]

    @property
    def optimum(self) -> Mapping[str, float]:
        """The belief-optimal values, empty when unknown."""
        return self.summary.get("optimum") or {}

    def curves(self, name: str, smooth: int = 1) -> list[tuple[np.ndarray, np.ndarray]]:
        """Steps and values of each seed that has metrics called `name`, as means over the last `smooth` evaluations."""
        series = (_series(rows, name) for rows in self.metrics.values())
        return [(steps, statistics.running_mean(values, smooth)) for steps, values in series if len(steps)]


def load(paths: Sequence[pathlib.Path], labels: Sequence[str] = ()) -> list[ReportedRun]:
    """Read runs, finished or not, to be shown together. Labels default to what tells the runs apart."""
    folders = [RunFolder.open(path) for path in paths]
    summaries = [folder.summary() or summarise(folder) for folder in folders]
    if labels and len(labels) != len(folders):
        raise RunError(f"--labels: got {len(labels)}, accepted: one for each of the {len(folders)} runs")
    labels = labels or _default_labels(folders, summaries)
    if len(set(labels)) != len(labels):
        raise RunError(f"--labels: got {' '.join(labels)}, accepted: a different one for each run")
    colours = _colours([str(summary.get("agent")) for summary in summaries])
    return [ReportedRun(label, colour, summary, {seed: folder.metrics(seed) for seed in folder.seeds()})
            for label, colour, summary, folder in zip(labels, colours, summaries, folders, strict=True)]


def _default_labels(folders: Sequence[RunFolder], summaries: Sequence[Mapping[str, Any]]) -> list[str]:
    """Agent, agent and memory, folder name, whole path: the first that names each run of a domain differently."""
    choices = (
        [f"{summary['agent']}" for summary in summaries],
        [f"{summary['agent']} ({summary['memory']})" for summary in summaries],
        [folder.path.resolve().name for folder in folders],
    )
    domains = [summary["domain"] for summary in summaries]
    several = len(set(domains)) > 1
    for labels in choices:
        if len(set(zip(domains, labels, strict=True))) == len(labels):
            unique = len(set(labels)) == len(labels)
            return labels if unique or not several else [f"{a}, {b}" for a, b in zip(labels, domains, strict=True)]
    return [str(folder.path) for folder in folders]


def _colours(agents: Sequence[str]) -> list[str]:
    """Each agent's own colour for its first run, then those still free, then all over again."""
    own = [AGENT_COLOURS.get(agent) if agent not in agents[:index] else None for index, agent in enumerate(agents)]
    free = [colour for colour in AGENT_COLOURS.values() if colour not in own]
    spare = iter((free + list(AGENT_COLOURS.values())) * (1 + len(agents)))
    return [colour or next(spare) for colour in own]


# ------------------------------------------------------------------------------------------------------------- figures


@dataclasses.dataclass(frozen=True)
class Panel:
    """One quantity over environment steps."""

    metric: str
    label: str
    optimum: str
    """Which of the optimal values is drawn as a dashed line."""
    limits: tuple[float, float] | None = None


RETURN_AND_SUCCESS = (
    Panel("evaluation/return", "return", "return"),
    Panel("evaluation/success", "success", "success", limits=(-0.03, 1.05)),
)


def draw_curves(runs: Sequence[ReportedRun], path: pathlib.Path, *, panels: Sequence[Panel] = RETURN_AND_SUCCESS,
                smooth: int = 1, note: str = "") -> None:
    """Draw one row per panel: each seed thin with mean and standard deviation, and the interquartile mean beside it.

    Args:
        runs: what to draw, of one domain.
        path: of the PNG.
        panels: the quantities.
        smooth: how many evaluations a running mean takes; the figure tells it when above 1.
        note: printed under the figure, e.g. that budgets were cut.
    """
    several_seeds = any(len(run.metrics) > 1 for run in runs)
    drawings = (_draw_mean, _draw_interquartile_mean) if several_seeds else (_draw_mean,)
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(1.2 + 3.9 * len(drawings), 1.4 + 2.2 * len(panels)), layout="constrained")
        axes = figure.subplots(len(panels), len(drawings), sharex=True, sharey="row", squeeze=False)
        for panel, row in zip(panels, axes, strict=True):
            for axis, draw in zip(row, drawings, strict=True):
                for run in runs:
                    curves = run.curves(panel.metric, smooth)
                    if curves:
                        draw(axis, run, curves, faint=0.6 if len(runs) > 3 else 1.0)
                _draw_optimum(axis, runs, panel)
            row[0].set_ylabel(panel.label)
            if panel.limits:
                row[0].set_ylim(*panel.limits)
        if several_seeds:
            axes[0][0].set_title("each seed, mean, one standard deviation", color="#555555")
            axes[0][1].set_title("interquartile mean, 95 % bootstrap interval", color="#555555")
        for axis in axes[-1]:
            _label_steps(axis, runs, panels)
        smoothing = [f"running mean over {smooth} evaluations"] if smooth > 1 else []
        _add_texts(figure, axes, runs, "; ".join([*smoothing, *([note] if note else [])]))
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)


def _draw_mean(axis: Axes, run: ReportedRun, curves: Sequence[tuple[np.ndarray, np.ndarray]], faint: float) -> None:
    steps, values = statistics.onto_shared_steps(curves)
    mean, std = statistics.mean_std(values)
    if len(curves) > 1:
        for seed_steps, seed_values in curves:
            axis.plot(seed_steps, seed_values, color=run.colour, linewidth=0.6, alpha=0.35 * faint)
        axis.fill_between(steps, mean - std, mean + std, color=run.colour, alpha=0.16 * faint, linewidth=0)
    axis.plot(steps, mean, color=run.colour, linewidth=1.8, label=_legend_label(run), solid_capstyle="round")


def _draw_interquartile_mean(axis: Axes, run: ReportedRun, curves: Sequence[tuple[np.ndarray, np.ndarray]],
                             faint: float) -> None:
    steps, values = statistics.onto_shared_steps(curves)
    estimate = statistics.interquartile_mean_curve(values)
    if len(curves) > 1:
        axis.fill_between(steps, estimate.low, estimate.high, color=run.colour, alpha=0.22 * faint, linewidth=0)
    axis.plot(steps, estimate.value, color=run.colour, linewidth=1.8, solid_capstyle="round")


def _draw_optimum(axis: Axes, runs: Sequence[ReportedRun], panel: Panel) -> None:
    best = next((run.optimum[panel.optimum] for run in runs if run.optimum.get(panel.optimum) is not None), None)
    if best is not None:
        axis.axhline(best, color="#333333", linewidth=0.9, linestyle=(0, (4, 3)), zorder=1.5, label="optimum")


def _legend_label(run: ReportedRun) -> str:
    num_seeds = len(run.metrics)
    return f"{run.label}, {num_seeds} seed{'s' if num_seeds > 1 else ''}"


def _label_steps(axis: Axes, runs: Sequence[ReportedRun], panels: Sequence[Panel]) -> None:
    last = max((int(steps[-1]) for run in runs for panel in panels for steps, _ in run.curves(panel.metric)), default=1)
    axis.set_xlim(0, last)
    axis.xaxis.set_major_locator(MaxNLocator(5))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda step, _: _short_number(step)))
    axis.set_xlabel("environment steps")


def _short_number(value: float) -> str:
    for size, letter in ((1_000_000, "M"), (1_000, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{letter}"
    return f"{value:g}"


def _add_texts(figure: Figure, axes: np.ndarray, runs: Sequence[ReportedRun], note: str) -> None:
    entries = {}
    for axis in axes[:, 0]:
        handles, labels = axis.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    if "optimum" in entries:
        entries["optimum"] = entries.pop("optimum")  # last
    columns = min(len(entries), 2 * axes.shape[1])
    legend = figure.legend(list(entries.values()), list(entries), loc="outside upper left", ncols=columns,
                           handlelength=1.6, title=_title(runs[0].domain), alignment="left")
    legend.get_title().set(fontsize=12, fontweight="bold")
    if note:
        figure.supxlabel(note, x=0.01, ha="left", fontsize=7.5, color="#666666")


def _title(domain: str) -> str:
    return domain.rpartition(":")[2] if ":" in domain else domain.replace("_", " ").title()


# -------------------------------------------------------------------------------------------------------------- tables

Table = list[dict[str, Any]]
"""Lines of named cells; None is an empty one."""


def seed_table(runs: Sequence[ReportedRun]) -> Table:
    """A line per run and seed."""
    parts = sorted({part for run in runs for seed in run.summary["seeds"].values() for part in seed["wall"]})
    return [
        {
            "run": run.label, "domain": run.domain, "seed": int(seed),
            **{quantity: results.get(quantity) for quantity in QUANTITIES},
            "steps": results.get("steps"), "steps_to_solve": results.get("steps_to_solve"),
            **{f"wall_{part}": results["wall"].get(part) for part in parts},
        }
        for run in runs for seed, results in run.summary["seeds"].items()
    ]


def run_table(runs: Sequence[ReportedRun]) -> Table:
    """A line per run: mean and standard deviation over seeds, the interquartile mean of success with its interval, how
    many seeds solved the task, and the median of the steps they needed (empty when half of them never did)."""
    table = []
    for run in runs:
        seeds = list(run.summary["seeds"].values())
        line: dict[str, Any] = {"run": run.label, "domain": run.domain, "seeds": len(seeds)}
        for quantity in QUANTITIES:
            scores = [seed[quantity] for seed in seeds if seed.get(quantity) is not None]
            mean, std = statistics.mean_std(np.array(scores)) if scores else (None, None)
            line |= {f"{quantity}_mean": mean, f"{quantity}_std": std}
        success = np.array([[seed["success"]] for seed in seeds if seed.get("success") is not None])
        if success.size:
            estimate = statistics.interquartile_mean_interval(success)
            line |= {"success_iqm": estimate.value, "success_iqm_low": estimate.low, "success_iqm_high": estimate.high}
        to_solve = sorted(np.inf if seed.get("steps_to_solve") is None else seed["steps_to_solve"] for seed in seeds)
        median = float(np.median(to_solve)) if np.isfinite(to_solve[len(to_solve) // 2]) else None
        wall = [sum(seconds for seconds in seed["wall"].values()) for seed in seeds]
        line |= {"solved": int(np.isfinite(to_solve).sum()), "steps_to_solve": median, "wall": float(np.mean(wall))}
        table.append(line)
    return table


def markdown(runs: Sequence[ReportedRun]) -> str:
    """Both tables for reading."""
    hidden = {"domain"} if len({run.domain for run in runs}) == 1 else set()
    return (f"{_markdown_table([_readable_run(line) for line in run_table(runs)], hidden)}\n\n"
            f"{_markdown_table([_readable_seed(line) for line in seed_table(runs)], hidden)}\n\n"
            f"Mean ± standard deviation over seeds; steps to the first evaluation with success >= {SOLVED} "
            "(of a run: the median); seconds of wall time.\n")


def _readable_run(line: Mapping[str, Any]) -> dict[str, str]:
    cells = {"run": line["run"], "domain": line["domain"], "seeds": str(line["seeds"])}
    for quantity in QUANTITIES:
        mean, std = line[f"{quantity}_mean"], line[f"{quantity}_std"]
        spread = f" ± {_readable(std)}" if line["seeds"] > 1 else ""
        cells[_heading(quantity)] = "" if mean is None else f"{_readable(mean)}{spread}"
    if line["seeds"] > 1 and "success_iqm" in line:
        low, high = _readable(line["success_iqm_low"]), _readable(line["success_iqm_high"])
        cells["success, IQM [95 %]"] = f"{_readable(line['success_iqm'])} [{low}, {high}]"
    return cells | {"solved": f"{line['solved']}/{line['seeds']}", "steps to solve": _readable(line["steps_to_solve"]),
                    "wall s": _readable(line["wall"])}


def _readable_seed(line: Mapping[str, Any]) -> dict[str, str]:
    return {_heading(name): _readable(value) for name, value in line.items()}


def _heading(name: str) -> str:
    if name.startswith("wall_"):
        return f"{name.removeprefix('wall_').replace('_', ' ')} s"
    return {"discounted_return": "discounted", "fraction_of_optimum": "of optimum"}.get(name, name.replace("_", " "))


def _readable(value: Any) -> str:
    """Whole numbers with thousands apart, others to three digits or so."""
    if value is None or isinstance(value, str):
        return value or ""
    if isinstance(value, int) or abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.1f}" if abs(value) >= 10 else f"{round(value, 3) + 0.0:.3f}"  # + 0.0: no minus before zero


def _markdown_table(lines: Sequence[Mapping[str, str]], hidden: Collection[str]) -> str:
    """An aligned table with the columns of all lines, without hidden ones and those that are empty everywhere."""
    columns = [name for name in dict.fromkeys(name for line in lines for name in line)
               if name not in hidden and any(line.get(name) for line in lines)]
    widths = {name: max(len(name), *(len(line.get(name, "")) for line in lines)) for name in columns}
    head = " | ".join(name.ljust(widths[name]) for name in columns)
    rule = " | ".join("-" * widths[name] for name in columns)
    body = (" | ".join(line.get(name, "").ljust(widths[name]) for name in columns) for line in lines)
    return "\n".join(f"| {text} |" for text in (head, rule, *body))


def _write_csv(path: pathlib.Path, table: Table) -> None:
    columns = list(dict.fromkeys(name for line in table for name in line))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(table)


# ------------------------------------------------------------------------------------------------------------- command


def write_report(runs: Sequence[ReportedRun], out: pathlib.Path, *, smooth: int = 1, note: str = "") -> str:
    """Write the figures and tables of runs into `out`; returns the tables as markdown."""
    out.mkdir(parents=True, exist_ok=True)
    domains = list(dict.fromkeys(run.domain for run in runs))
    for domain in domains:
        name = "curve.png" if len(domains) == 1 else f"curve_{domain.replace(':', '.')}.png"
        draw_curves([run for run in runs if run.domain == domain], out / name, smooth=smooth,
                    note=note)
    _write_csv(out / "runs.csv", run_table(runs))
    _write_csv(out / "seeds.csv", seed_table(runs))
    text = markdown(runs)
    (out / "report.md").write_text(text, encoding="utf-8")
    return text


@dataclasses.dataclass(frozen=True)
class ReportOptions:
    """Draw runs on shared axes and write their table."""

    runs: Annotated[tuple[pathlib.Path, ...], tyro.conf.Positional]
    """Run folders, finished or not."""
    out: pathlib.Path | None = None
    """Folder for the figures and tables; default: the run itself for a single one, otherwise `runs/report`."""
    labels: tuple[str, ...] = ()
    """A name for each run; default: the agent, and what else tells the runs apart."""
    smooth: int = 1
    """Evaluations in the running mean that is drawn; the tables are not smoothed."""
    note: str = ""
    """A line to print under each figure."""


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    options = tyro.cli(ReportOptions, args=arguments, prog="python -m mijax.report")
    try:
        if not options.runs:
            raise RunError("runs: got none, accepted: one run folder or more")
        if options.smooth < 1:
            raise RunError(f"--smooth: got {options.smooth}, accepted: a number >= 1")
        out = options.out or (options.runs[0] if len(options.runs) == 1 else pathlib.Path("runs/report"))
        print(write_report(load(options.runs, options.labels), out, smooth=options.smooth, note=options.note))
        print(f"Written to {out}")
    except (RunError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

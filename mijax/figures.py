"""Figures in one style: learning curves of runs on shared axes, and the trade-off of a search."""

import dataclasses
import functools
import pathlib
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from mijax import statistics
from mijax.representation.probe import DECODED, LEAK_R2, REWARD_DECODED
from mijax.representation.search import SearchResult
from mijax.results import ReportedRun

STYLE: Any = {
    "font.size": 9, "axes.titlesize": 9, "axes.labelsize": 9, "axes.spines.top": False, "axes.spines.right": False,
    "axes.edgecolor": "#888888", "axes.linewidth": 0.8, "axes.grid": True, "grid.color": "#e6e6e6",
    "grid.linewidth": 0.7, "axes.axisbelow": True, "xtick.color": "#444444", "ytick.color": "#444444",
    "xtick.major.size": 3, "ytick.major.size": 3, "legend.frameon": False, "figure.dpi": 100, "savefig.dpi": 160,
}
RING: Any = {"marker": "o", "markersize": 15, "markerfacecolor": "none", "markeredgecolor": "#d62728",
              "markeredgewidth": 1.8, "linestyle": "none", "zorder": 5}
"""Around the step at which the bonus peaks (paper Fig. 32), and around what is kept."""
_THRESHOLD: Any = {"color": "#333333", "linewidth": 0.9, "linestyle": (0, (4, 3)), "zorder": 1.5}
_PASSED, _FAILED = "#009E73", "#D55E00"


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
    with mpl.rc_context(STYLE):
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


def _draw_mean(axis: Axes, run: ReportedRun, curves: Sequence[tuple[np.ndarray, np.ndarray]], faint: float,
               each: bool = True) -> None:
    steps, values = statistics.onto_shared_steps(curves)
    mean, std = statistics.mean_std(values)
    if len(curves) > 1:
        for seed_steps, seed_values in curves if each else ():
            axis.plot(seed_steps, seed_values, color=run.colour, linewidth=0.6, alpha=0.35 * faint)
        axis.fill_between(steps, mean - std, mean + std, color=run.colour, alpha=0.16 * faint, linewidth=0)
    axis.plot(steps, mean, color=run.colour, linestyle=run.dashes, linewidth=1.8, label=_legend_label(run),
              solid_capstyle="round")


def _draw_interquartile_mean(axis: Axes, run: ReportedRun, curves: Sequence[tuple[np.ndarray, np.ndarray]],
                             faint: float) -> None:
    steps, values = statistics.onto_shared_steps(curves)
    estimate = statistics.interquartile_mean_curve(values)
    if len(curves) > 1:
        axis.fill_between(steps, estimate.low, estimate.high, color=run.colour, alpha=0.22 * faint, linewidth=0)
    axis.plot(steps, estimate.value, color=run.colour, linestyle=run.dashes, linewidth=1.8, solid_capstyle="round")


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
    # A column takes four characters for its line, and a figure of runs that are many or long-named grows by their rows.
    room = int(LEGEND_CHARACTERS_PER_INCH * figure.get_figwidth() / (max(map(len, entries)) + 4))
    columns = max(1, min(len(entries), 2 * axes.shape[1], room))
    extra = max(0, -(-len(entries) // columns) - LEGEND_ROWS)
    figure.set_figheight(figure.get_figheight() + extra * LEGEND_ROW_INCHES)
    legend = figure.legend(list(entries.values()), list(entries), loc="outside upper left", ncols=columns,
                           handlelength=1.6, title=display_name(runs[0].domain), alignment="left")
    legend.get_title().set(fontsize=12, fontweight="bold")
    if note:
        lines = textwrap.fill(note, int(CHARACTERS_PER_INCH * figure.get_figwidth()))
        figure.supxlabel(lines, x=0.01, ha="left", fontsize=7.5, color="#666666")


CHARACTERS_PER_INCH = 17
"""Of a note under a figure."""
LEGEND_CHARACTERS_PER_INCH = 12
LEGEND_ROWS = 2
"""That a figure has room for as it is."""
LEGEND_ROW_INCHES = 0.2
PAPER_NAMES = {
    "heaven_hell": "Heaven-Hell", "sphinx": "Sphinx", "carflag_2d": "CarFlag-2D", "block_pulling": "Block-Pulling",
    "block_pushing": "Block-Pushing", "drawer_opening": "Drawer-Opening"}


def display_name(domain: str) -> str:
    """A domain as titles show it: in the paper's spelling where it has one."""
    name, _, arguments = domain.partition(",")
    if name in PAPER_NAMES:
        shown = PAPER_NAMES[name]
    else:
        shown = name.rpartition(":")[2] if ":" in name else name.replace("_", " ").title()
    return f"{shown} ({arguments.replace(',', ', ')})" if arguments else shown


SMOOTH = 5
"""Evaluations that a point of `draw_groups` is the mean of."""
SEEDS_OF_IQM = 4
"""With fewer nothing is cut off: the interquartile mean is the mean."""
MOST_WITH_SEEDS = 3
"""Runs beside each other of which every seed is drawn."""


def draw_groups(groups: Mapping[str, Sequence[ReportedRun]], path: pathlib.Path, *, title: str, note: str = "",
                panel: Panel = RETURN_AND_SUCCESS[1]) -> None:
    """Draw groups of runs side by side: above mean and standard deviation as in the paper, below interquartile means
    where a run has seeds enough (of less than four it is the mean).

    Args:
        groups: the runs of each column, by its title. A curve begins where the steps before its run end, at dashed
            vertical lines.
        path: of the PNG.
        title: of the figure.
        note: printed under the figure: budgets and seeds.
        panel: the quantity, as means over the last `SMOOTH` evaluations.
    """
    every = [run for runs in groups.values() for run in runs]
    several_seeds = any(len(run.metrics) > 1 for run in every)
    drawings: dict[str, Callable] = {
        "mean, one std" if several_seeds else "one seed": functools.partial(
            _draw_mean, each=len(every) <= MOST_WITH_SEEDS)}
    if any(len(run.metrics) >= SEEDS_OF_IQM for run in every):
        drawings["IQM, 95 % interval"] = _draw_interquartile_mean
    with mpl.rc_context(STYLE):
        width = max(5.6, 0.8 + 3.5 * len(groups))
        figure = Figure(figsize=(width, 1.6 + 2.2 * len(drawings)), layout="constrained")
        axes, entries = figure.subplots(len(drawings), len(groups), sharey=True, sharex="col", squeeze=False), {}
        for (name, runs), column in zip(groups.items(), axes.T, strict=True):
            for axis, draw in zip(column, drawings.values(), strict=True):
                for run in runs:
                    curves = run.curves(panel.metric, SMOOTH)
                    if curves:
                        draw(axis, run, curves, faint=0.6 if len(runs) > 3 else 1.0)
                for begun in {step for run in runs for step in run.begun.values() if step}:
                    axis.axvline(begun, color="#888888", linewidth=0.9, linestyle=(0, (2, 2)), zorder=1.2)
                _draw_optimum(axis, runs, panel)
            column[0].set_title(name)
            _label_steps(column[-1], runs, (panel,))
            entries |= dict(zip(*reversed(column[0].get_legend_handles_labels()), strict=True))
        for axis, name in zip(axes[:, 0], drawings, strict=True):
            axis.set_ylabel(f"{panel.label}\n{name}")
            if panel.limits:
                axis.set_ylim(*panel.limits)
        entries["optimum"] = entries.pop("optimum", None)  # last
        entries = {label: handle for label, handle in entries.items() if handle is not None}
        legend = figure.legend(list(entries.values()), list(entries), loc="outside upper left", handlelength=1.6,
                               ncols=2 if len(groups) == 1 else 2 * len(groups), title=title, alignment="left")
        legend.get_title().set(fontsize=12, fontweight="bold")
        if note:
            smoothing = f"Running mean over {SMOOTH} evaluations. "
            lines = textwrap.fill(smoothing + note, int(CHARACTERS_PER_INCH * width))
            figure.supxlabel(lines, x=0.01, ha="left", fontsize=7.5, color="#666666")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)


def draw_trade_off(result: SearchResult, path: pathlib.Path, title: str) -> None:
    """Draw every weighting of a search: what its z_s holds of the hidden against what it leaks of the visible.

    Left as the probe decodes them; right, where probes of nearly all leak alike, as the leak's share of the variance
    of z_s against how well rewards are predicted. The kept weighting has a red ring.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.6, 4.3), layout="constrained")
        decoded, shares = figure.subplots(1, 2)
        for number, candidate in enumerate(result.candidates, start=1):
            for report in candidate.reports.values():
                if report is None:
                    continue
                trained = bool(candidate.representations)
                passed = report.p1 and report.p2 and trained
                colour = _PASSED if passed else _FAILED if trained else "#999999"
                kind = "passes P1 and P2" if passed else "fails" if trained else "given up after the first round"
                reward = max(report.errors.get("reward_r2", 0.0), -0.05)
                leaked = max(1 - report.geometry["hidden_share"], 1e-9)
                for axis, x, y in ((decoded, report.leak, report.hidden), (shares, leaked, reward)):
                    axis.plot(x, y, marker="o", markersize=6, color=colour, linestyle="none", zorder=3, label=kind)
                    if candidate is result.best:
                        axis.plot(x, y, **RING)
                shares.annotate(f"{number}", (leaked, reward), fontsize=6.5, textcoords="offset points", xytext=(5, 4),
                                color="#666666")
        decoded.axhline(DECODED, **_THRESHOLD)
        decoded.axvline(LEAK_R2, **_THRESHOLD)
        shares.axhline(REWARD_DECODED, **_THRESHOLD)
        decoded.set(xlim=(-0.05, 1.08), ylim=(-0.05, 1.08), xlabel="leak: what can be seen anyway, decoded from $z_s$",
                    ylabel="what is hidden, decoded from $z_s$")
        shares.set(xscale="log", xlabel="share of the variance of $z_s$ that is not the hidden's (from 1e-9)",
                   ylabel="rewards predicted, $R^2$")
        handles, labels = decoded.get_legend_handles_labels()
        unique = dict(zip(labels, handles, strict=True))
        figure.legend(list(unique.values()), list(unique), loc="outside lower center", ncols=3, fontsize=8)
        figure.suptitle(title, fontsize=12, fontweight="bold", ha="left", x=0.01)
        figure.savefig(path)

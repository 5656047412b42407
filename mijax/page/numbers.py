"""Curves and options of runs as the page draws them."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mijax import statistics
from mijax.results import QUANTITIES, ReportedRun, series

_DIGITS = 5
"""Significant digits of a point of a curve: the eye tells three apart."""
_COUNTED = ("step", "update")


def curve_data(run: ReportedRun, smooth: int, points: int) -> dict[str, Any]:
    """By quantity: steps and values of each seed, and mean, standard deviation and interquartile mean where all seeds
    have been.

    Args:
        run: whose metrics are shown; all that are numbers, but not those of the clock.
        smooth: how many evaluations a running mean takes.
        points: how many evaluations are kept at most.
    """
    names = {name for rows in run.metrics.values() for row in rows for name, value in row.items()
             if isinstance(value, int | float) and name not in _COUNTED and not name.startswith("wall/")}
    return {name: _curve(run, name, smooth, points) for name in sorted(names, key=_rank)}


def _rank(name: str) -> tuple[int, str]:
    """The tables' quantities first, in their order."""
    quantity = name.removeprefix("evaluation/")
    return (QUANTITIES.index(quantity) if quantity in QUANTITIES else len(QUANTITIES), name)


def _curve(run: ReportedRun, name: str, smooth: int, points: int) -> dict[str, Any]:
    seeds = {}
    for seed, rows in run.metrics.items():
        steps, values = series(rows, name)
        if len(steps):
            kept = _spread(len(steps), points)
            seeds[seed] = steps[kept], statistics.running_mean(values, smooth)[kept]
    steps, values = statistics.onto_shared_steps(list(seeds.values()))
    kept = _spread(len(steps), points)
    steps, values = steps[kept], values[:, kept]
    shared: dict[str, Any] = {"steps": steps.tolist()}
    if len(steps):
        mean, std = statistics.mean_std(values)
        shared |= {"mean": _short(mean), "std": _short(std), "iqm": _short(statistics.interquartile_mean(values))}
    return shared | {"seeds": [
        {"seed": seed, "values": _short(own), **({} if np.array_equal(at, steps) else {"steps": at.tolist()})}
        for seed, (at, own) in seeds.items()]}


def _spread(count: int, points: int) -> np.ndarray:
    """The places of at most `points` of `count`, evenly spread, first and last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, points)).round().astype(int)) if count else np.arange(0)


def _short(values: np.ndarray) -> list[float]:
    return [float(f"{value:.{_DIGITS}g}") for value in values]


def option_data(runs: Sequence[ReportedRun]) -> list[dict[str, Any]]:
    """A line per option: its dotted name, each run's value (None where a run has no such option), and whether these
    differ; `versions.*` is what a run was started with."""
    known = []
    for run in runs:
        config = {} if run.folder is None else run.folder.config()
        versions = {} if run.folder is None or not run.folder.has_versions() else run.folder.versions()
        known.append(_flat(config) | _flat({"versions": versions}))
    names = dict.fromkeys(name for options in known for name in options)
    lines = [{"name": name, "values": [options.get(name) for options in known]} for name in names]
    return [line | {"differs": any(value != line["values"][0] for value in line["values"])} for line in lines]


def _flat(options: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Nested options by dotted name, as text."""
    flat: dict[str, str] = {}
    for name, value in options.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        elif value is not None:
            flat[f"{prefix}{name}"] = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    return flat


def finite(values: Any, digits: int = 4) -> Any:
    """Numbers of an array as nested lists, rounded; None where there is none."""
    rounded = np.round(np.asarray(values, np.float64), digits) + 0.0  # + 0.0: no minus before zero
    return _without_nan(rounded.tolist())


def _without_nan(value: Any) -> Any:
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return value if math.isfinite(value) else None

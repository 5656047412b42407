"""What runs came to: their summaries, and runs as they are shown together."""

import dataclasses
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mijax import statistics
from mijax.run_folder import Row, RunError, RunFolder

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
DASHES = ("-", "--", ":", "-.")
"""Of the lines of the first, second ... run that has the same colour."""


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
        steps, success = series(rows, "evaluation/success")
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
        _, values = series(rows, f"evaluation/{quantity}")
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


def series(rows: Sequence[Row], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps and values of the lines that have `name`."""
    points = [(row["step"], row[name]) for row in rows if name in row]
    return np.array([step for step, _ in points], int), np.array([value for _, value in points], float)


@dataclasses.dataclass(frozen=True)
class ReportedRun:
    """A run as it is shown: under a label, in a colour."""

    label: str
    colour: str
    summary: Mapping[str, Any]
    metrics: Mapping[int, Sequence[Row]]
    """The lines of each seed."""
    folder: RunFolder | None = None
    """Where it comes from, when it is one folder's."""
    dashes: str = "-"
    """How its lines are drawn, in Matplotlib's terms, where several runs have its colour."""
    begun: Mapping[int, int] = dataclasses.field(default_factory=dict)
    """By seed, the random environment steps of stage 1 that its own come after, where they are to be counted."""

    @property
    def domain(self) -> str:
        """The environment's name."""
        return self.summary["domain"]

    @property
    def optimum(self) -> Mapping[str, float]:
        """The belief-optimal values, empty when unknown."""
        return self.summary.get("optimum") or {}

    def curves(self, name: str, smooth: int = 1) -> list[tuple[np.ndarray, np.ndarray]]:
        """Steps, those before its own counted, and values of each seed that has metrics called `name`, as means over
        the last `smooth` evaluations."""
        found = ((self.begun.get(seed, 0), *series(rows, name)) for seed, rows in self.metrics.items())
        return [(before + steps, statistics.running_mean(values, smooth))
                for before, steps, values in found if len(steps)]

    def steps_to_solve(self) -> np.ndarray:
        """(seeds,) steps before the first solved evaluation, those before its own counted; infinity where none is."""
        return np.array([np.inf if seed.get("steps_to_solve") is None else
                         self.begun.get(int(number), 0) + seed["steps_to_solve"]
                         for number, seed in self.summary["seeds"].items()], float)


def evaluated(path: pathlib.Path) -> bool:
    """Whether every seed that a run has begun has been evaluated; `RunError` where there is no run."""
    run = RunFolder.open(path)
    return bool(run.seeds()) and all(run.metrics(seed) for seed in run.seeds())


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
    return [ReportedRun(label, colour, summary, {seed: folder.metrics(seed) for seed in folder.seeds()}, folder,
                        dashes=DASHES[colours[:number].count(colour) % len(DASHES)])
            for number, (label, colour, summary, folder)
            in enumerate(zip(labels, colours, summaries, folders, strict=True))]


def _default_labels(folders: Sequence[RunFolder], summaries: Sequence[Mapping[str, Any]]) -> list[str]:
    """Agent, agent and memory, folder name, path as far as paths differ: the first that names each run of a domain
    differently."""
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
    places = [str(folder.path.resolve()) for folder in folders]
    shared = os.path.commonpath([os.path.dirname(place) for place in places])
    return [os.path.relpath(place, shared) for place in places]


def _colours(agents: Sequence[str]) -> list[str]:
    """Each agent's own colour for its first run, then those still free, then all over again."""
    own = [AGENT_COLOURS.get(agent) if agent not in agents[:index] else None for index, agent in enumerate(agents)]
    free = [colour for colour in AGENT_COLOURS.values() if colour not in own]
    spare = iter((free + list(AGENT_COLOURS.values())) * (1 + len(agents)))
    return [colour or next(spare) for colour in own]

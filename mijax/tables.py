"""Tables of runs and seeds, for reading (markdown) and for counting (CSV)."""

import csv
import pathlib
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from mijax import statistics
from mijax.results import QUANTITIES, SOLVED, ReportedRun

Table = list[dict[str, Any]]
"""Lines of named cells; None is an empty one."""
NEVER = 1e18
"""Steps to solve, where seeds are compared, of one that never does: two such are equal."""


def _plain(label: str) -> str:
    """A label of a figure without its mathematical markup."""
    return label.replace("$", "")


def seed_table(runs: Sequence[ReportedRun]) -> Table:
    """A line per run and seed."""
    parts = sorted({part for run in runs for seed in run.summary["seeds"].values() for part in seed["wall"]})
    return [
        {
            "run": _plain(run.label), "domain": run.domain, "seed": int(seed),
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
        line: dict[str, Any] = {"run": _plain(run.label), "domain": run.domain, "seeds": len(seeds)}
        for quantity in QUANTITIES:
            scores = [seed[quantity] for seed in seeds if seed.get(quantity) is not None]
            mean, std = statistics.mean_std(np.array(scores)) if scores else (None, None)
            line |= {f"{quantity}_mean": mean, f"{quantity}_std": std}
        success = np.array([[seed["success"]] for seed in seeds if seed.get("success") is not None])
        if success.size:
            estimate = statistics.interquartile_mean_interval(success)
            line |= {"success_iqm": estimate.value, "success_iqm_low": estimate.low, "success_iqm_high": estimate.high}
        to_solve = run.steps_to_solve()
        wall = [sum(seconds for seconds in seed["wall"].values()) for seed in seeds]
        line |= {"solved": int(np.isfinite(to_solve).sum()), "steps_to_solve": _median(to_solve),
                 "wall": float(np.mean(wall))}
        table.append(line)
    return table


def _median(to_solve: np.ndarray) -> float | None:
    """Of steps to solve; None where half of the seeds or more never did."""
    middle = float(np.median(to_solve)) if len(to_solve) else np.inf
    return middle if np.isfinite(middle) else None


def markdown(runs: Sequence[ReportedRun]) -> str:
    """Both tables for reading."""
    hidden = {"domain"} if len({run.domain for run in runs}) == 1 else set()
    return (f"{markdown_table([_readable_run(line) for line in run_table(runs)], hidden)}\n\n"
            f"{markdown_table([_readable_seed(line) for line in seed_table(runs)], hidden)}\n\n"
            f"Mean ± standard deviation over seeds; steps to the first evaluation with success >= {SOLVED} "
            "(of a run: the median), without those of stage 1; seconds of wall time.\n")


def _readable_run(line: Mapping[str, Any]) -> dict[str, str]:
    cells = {"run": line["run"], "domain": line["domain"], "seeds": str(line["seeds"])}
    for quantity in QUANTITIES:
        mean, std = line[f"{quantity}_mean"], line[f"{quantity}_std"]
        spread = f" ± {readable(std)}" if line["seeds"] > 1 else ""
        cells[_heading(quantity)] = "" if mean is None else f"{readable(mean)}{spread}"
    if line["seeds"] > 1 and "success_iqm" in line:
        low, high = readable(line["success_iqm_low"]), readable(line["success_iqm_high"])
        cells["success, IQM [95 %]"] = f"{readable(line['success_iqm'])} [{low}, {high}]"
    return cells | {"solved": f"{line['solved']}/{line['seeds']}", "steps to solve": readable(line["steps_to_solve"]),
                    "wall s": readable(line["wall"])}


def _readable_seed(line: Mapping[str, Any]) -> dict[str, str]:
    return {_heading(name): readable(value) for name, value in line.items()}


def _heading(name: str) -> str:
    if name.startswith("wall_"):
        return f"{name.removeprefix('wall_').replace('_', ' ')} s"
    return {"discounted_return": "discounted", "fraction_of_optimum": "of optimum"}.get(name, name.replace("_", " "))


def readable(value: Any) -> str:
    """Whole numbers with thousands apart, others to three digits or so."""
    if value is None or isinstance(value, str):
        return value or ""
    if isinstance(value, int) or abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.1f}" if abs(value) >= 10 else f"{round(value, 3) + 0.0:.3f}"  # + 0.0: no minus before zero


def markdown_table(lines: Sequence[Mapping[str, str]], hidden: Collection[str] = ()) -> str:
    """An aligned table with the columns of all lines, without hidden ones and those that are empty everywhere."""
    columns = [name for name in dict.fromkeys(name for line in lines for name in line)
               if name not in hidden and any(line.get(name) for line in lines)]
    widths = {name: max(len(name), *(len(line.get(name, "")) for line in lines)) for name in columns}
    head = " | ".join(name.ljust(widths[name]) for name in columns)
    rule = " | ".join("-" * widths[name] for name in columns)
    body = (" | ".join(line.get(name, "").ljust(widths[name]) for name in columns) for line in lines)
    return "\n".join(f"| {text} |" for text in (head, rule, *body))


def comparison_table(runs: Sequence[ReportedRun]) -> Table:
    """How the first of some runs, ours, compares with each: a line per run.

    `area` is the mean of the success curve up to the last step that all seeds reached: it tells how early a task is
    learnt. Steps before the first evaluation, stage 1's and those of random actions, count as steps without success.
    The probability that a seed of ours beats one of theirs, ties counting half, is given by area and by the steps to
    the first evaluation that is solved, where one after that last step counts as never, and never as later than any.
    """
    last = _last_shared(runs)
    areas = [_areas(run, last) for run in runs]
    speeds = [-np.where(run.steps_to_solve() <= last, run.steps_to_solve(), NEVER) for run in runs]
    table = []
    for place, run in enumerate(runs):
        seeds = list(run.summary["seeds"].values())
        line: dict[str, Any] = {"run": _plain(run.label), "seeds": len(seeds)}
        for name, scores in (("success", _column(seeds, "success")), ("return", _column(seeds, "return")),
                             ("reveals", _column(seeds, "reveals")), ("area", areas[place])):
            if len(scores):
                mean, std = statistics.mean_std(scores)
                line |= {f"{name}_mean": float(mean), f"{name}_std": float(std),
                         f"{name}_iqm": float(statistics.interquartile_mean(scores))}
        to_solve = run.steps_to_solve()
        line |= {"solved": int(np.isfinite(to_solve).sum()), "steps_to_solve": _median(to_solve)}
        if place:
            for name, scores in (("area", areas), ("steps", speeds)):
                if len(scores[0]) and len(scores[place]):
                    estimate = statistics.probability_of_improvement(scores[0], scores[place])
                    line |= {f"p_{name}": float(estimate.value), f"p_{name}_low": float(estimate.low),
                             f"p_{name}_high": float(estimate.high)}
        table.append(line)
    return table


def _last_shared(runs: Sequence[ReportedRun]) -> int:
    """The last step that all seeds reached."""
    return min((int(steps[-1]) for run in runs for steps, _ in run.curves("evaluation/success")), default=0)


def _column(seeds: Sequence[Mapping[str, Any]], name: str) -> np.ndarray:
    return np.array([seed[name] for seed in seeds if seed.get(name) is not None], float)


def _areas(run: ReportedRun, last: int) -> np.ndarray:
    """(seeds,) mean success over the steps up to `last`."""
    def area(steps: np.ndarray, values: np.ndarray) -> float:
        apart = (steps[-1] - steps[0]) / max(len(steps) - 1, 1)  # evaluations are evenly spaced
        evaluations = max(last // apart, 1) if apart else 1
        return float(values[steps <= last].sum() / evaluations)

    return np.array([area(steps, values) for steps, values in run.curves("evaluation/success")])


def comparison_markdown(runs: Sequence[ReportedRun]) -> str:
    """`comparison_table` for reading."""
    lines, first = [], _plain(runs[0].label)
    for line in comparison_table(runs):
        cells = {"run": line["run"], "seeds": str(line["seeds"])}
        for name in ("success", "return", "reveals", "area"):
            if f"{name}_mean" in line:
                spread = f" ± {readable(line[f'{name}_std'])}" if line["seeds"] > 1 else ""
                cells[name] = f"{readable(line[f'{name}_mean'])}{spread}"
        if "success_iqm" in line:
            cells |= {"success, IQM": readable(line["success_iqm"]), "area, IQM": readable(line.get("area_iqm"))}
        cells |= {"solved": f"{line['solved']}/{line['seeds']}", "steps to solve": readable(line["steps_to_solve"])}
        for name, title in (("area", f"P({first} better), area"), ("steps", f"P({first} better), steps to solve")):
            if f"p_{name}" in line:
                low, high = readable(line[f"p_{name}_low"]), readable(line[f"p_{name}_high"])
                cells[title] = f"{readable(line[f'p_{name}'])} [{low}, {high}]"
        lines.append(cells)
    last = _last_shared(runs)
    return (f"{markdown_table(lines)}\n\nMean ± standard deviation over seeds, interquartile mean (IQM). Area: mean of "
            f"the success curve up to step {last:,}, the last that all of them reached: other tables end elsewhere. "
            f"Solved: any evaluation with success >= {SOLVED}; steps to solve: those before the first one, the median "
            "over seeds. Stage 1's random steps count, without success, and so do an agent's own before its first "
            "evaluation. P: probability that a seed of the first line beats one of this line, ties half, with its 95 % "
            "bootstrap interval, which says little of three seeds.\n")


def plain_markdown(table: Table) -> str:
    """Any table for reading."""
    return markdown_table([{_heading(name): readable(value) for name, value in line.items()} for line in table])


def write_csv(path: pathlib.Path, table: Table) -> None:
    """Write the columns of all lines."""
    columns = list(dict.fromkeys(name for line in table for name in line))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(table)

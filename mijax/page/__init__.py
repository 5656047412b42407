"""`report.html`: curves, tables, options and episodes of runs as one file that needs no network."""

import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from mijax.figures import display_name
from mijax.page.episodes import Episodes
from mijax.page.numbers import curve_data, option_data
from mijax.results import AGENT_COLOURS, SOLVED, ReportedRun
from mijax.run_folder import RunError
from mijax.tables import run_table, seed_table

FILE = "report.html"
LARGEST = 5_000_000
"""Bytes of a page."""
POINTS = (1000, 300, 100, 30)
"""Evaluations that a curve may show: the first of these numbers with which the page is not too large."""
_BLOB = '<script type="application/json" id="data">/*DATA*/</script>'
_FOLDER = pathlib.Path(__file__).parent
_SCRIPTS = ("elements.js", "plot.js", "curves.js", "tables.js", "world.js", "episode.js")


def write_page(runs: Sequence[ReportedRun], path: pathlib.Path, episodes: Sequence[Episodes | str | None], *,
               smooth: int = 1, note: str = "") -> None:
    """Write the page.

    Args:
        runs: what to show.
        path: of the HTML file.
        episodes: of each run its episodes, or in a sentence why there are none, or None to say nothing.
        smooth: how many evaluations the running mean of a curve takes; the tables are not smoothed.
        note: a line under the title.

    Raises:
        RunError: not even the coarsest curves fit.
    """
    for points in POINTS:
        text = render(page_data(runs, episodes, smooth=smooth, points=points, note=note))
        if len(text.encode()) <= LARGEST:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
            return
    raise RunError(f"--html: {len(runs)} runs make a page of more than {LARGEST:,} bytes, accepted: fewer runs")


def page_data(runs: Sequence[ReportedRun], episodes: Sequence[Episodes | str | None], *, smooth: int = 1,
              points: int = POINTS[0], note: str = "") -> dict[str, Any]:
    """All that the page shows, as JSON has it; the arguments are those of `write_page`.

    Args:
        points: evaluations that a curve shows at most, evenly chosen.
    """
    return {
        "runs": [
            {"label": run.label, "domain": run.domain, "colour": run.colour, "optimum": dict(run.optimum),
             "curves": curve_data(run, smooth, points), "episodes": shown}
            for run, shown in zip(runs, episodes, strict=True)],
        "names": {run.domain: display_name(run.domain) for run in runs}, "run_table": run_table(runs),
        "seed_table": seed_table(runs), "options": option_data(runs),
        "smooth": smooth, "note": note, "solved": SOLVED, "palette": list(AGENT_COLOURS.values()),
    }


def render(data: Mapping[str, Any]) -> str:
    """The HTML text: the template with its style, its scripts and its data inside."""
    blob = json.dumps(data, allow_nan=False, separators=(",", ":"), ensure_ascii=False).replace("<", "\\u003c")
    scripts = "\n".join(_read(name) for name in _SCRIPTS)
    return (_read("page.html").replace("/*STYLE*/", _read("page.css")).replace("/*SCRIPTS*/", scripts)
            .replace("/*DATA*/", blob))


def read_data(path: pathlib.Path) -> dict[str, Any]:
    """What `page_data` gave to a page that has been written."""
    start, end = _BLOB.split("/*DATA*/")
    return json.loads(path.read_text(encoding="utf-8").partition(start)[2].partition(end)[0])


def _read(name: str) -> str:
    return (_FOLDER / name).read_text(encoding="utf-8")

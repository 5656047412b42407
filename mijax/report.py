"""Draw any set of runs on shared axes and write their table.

    python -m mijax.report RUN... [--out DIR] [--labels NAME...] [--smooth N]

Writes into DIR: `curve.png` (`curve_DOMAIN.png` for each, when the runs are of several domains), `runs.csv`,
`seeds.csv` and `report.md` with both tables, which are also printed.

    python -m mijax.report RUN... --html [--seed K] [--out DIR]

Writes `report.html` beside them: one file that opens in any browser, without a network. It has the curves of every
quantity, the tables, what the runs' options differ in, and greedy episodes of each run's newest checkpoint to step
through: what the agent sees, what is true, what it remembers.

    python -m mijax.report RUN --episode [--seed K] [--out DIR]

Plays the newest checkpoint greedily and draws one episode, `episode_seed_K.png`: the path, the intrinsic reward of each
step, what the history explains of z_s, the values, and where the transformer attends.
"""

import dataclasses
import pathlib
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from envs_mjx import registry
from envs_mjx.base import DiscreteActions
from envs_mjx.errors import UserError
from envs_mjx.grid.world import GridWorld
from mijax import episode, page, runtime
from mijax.draw_episode import draw_episode
from mijax.figures import display_name, draw_curves
from mijax.files import make_folder
from mijax.learner import Learner, make_learner
from mijax.page.episodes import Episodes, episode_data
from mijax.results import ReportedRun, evaluated, load
from mijax.run_folder import RunError, RunFolder
from mijax.seeds import evaluation_key
from mijax.tables import markdown, run_table, seed_table, write_csv
from mijax.trained import load_learner_state, seed_of, training_of

EPISODES, EPISODES_OF_IMAGES = 4, 1
"""Episodes of a run on a page; a robot's have three images per step. Grid worlds are drawn by their cells."""


def write_report(runs: Sequence[ReportedRun], out: pathlib.Path, *, smooth: int = 1, note: str = "") -> str:
    """Write the figures and tables of runs into `out`; returns the tables as markdown."""
    make_folder(out)
    domains = list(dict.fromkeys(run.domain for run in runs))
    for domain in domains:
        name = "curve.png" if len(domains) == 1 else f"curve_{registry.file_name(domain)}.png"
        draw_curves([run for run in runs if run.domain == domain], out / name, smooth=smooth,
                    note=note)
    write_csv(out / "runs.csv", run_table(runs))
    write_csv(out / "seeds.csv", seed_table(runs))
    text = markdown(runs)
    (out / "report.md").write_text(text, encoding="utf-8")
    return text


def report_page(runs: Sequence[ReportedRun], path: pathlib.Path, options: "ReportOptions") -> None:
    """Write the page of some runs; a run that cannot be played is shown without episodes, and the page says why."""
    folders = [run.folder for run in runs if run.folder is not None]
    if options.seed is not None:
        for folder in folders:
            seed_of(folder, options.seed)
    shown: list[Episodes | str | None] = []
    for run, folder in zip(runs, folders, strict=True):
        print(f"{run.label}: playing its newest checkpoint", file=sys.stderr)
        try:
            learner, seed, step, seen = _trace(folder, options.seed, _how_many(run.domain))
            shown.append(episode_data(learner, seen, seed=seed, step=step))
        except (UserError, OSError) as error:
            reason = str(error).replace(str(folder.path), run.label)  # a page is sent, a path says nothing there
            shown.append(reason)
            print(f"shown without episodes: {reason}", file=sys.stderr)
    page.write_page(runs, path, shown, smooth=options.smooth, note=options.note)


def _how_many(domain: str) -> int:
    env = registry.make(domain)
    return EPISODES_OF_IMAGES if env.observation_spec.is_image and not isinstance(env, GridWorld) else EPISODES


def _trace(run: RunFolder, asked: int | None, episodes: int) -> tuple[Learner, int, int, episode.Trace]:
    """Greedy episodes of a seed's newest checkpoint: the learner, the seed, the checkpoint's step, the trace."""
    config, seed = training_of(run).config, seed_of(run, asked)
    learner = make_learner(registry.make(config.domain), config)
    step, state = load_learner_state(run, seed, learner)
    return learner, seed, step, episode.trace(learner, state, evaluation_key(seed, step), episodes)


def report_episode(options: "ReportOptions") -> pathlib.Path:
    """Draw a greedy episode of a run's newest checkpoint; returns the figure's path."""
    if len(options.runs) != 1:
        raise RunError(f"--episode: got {len(options.runs)} runs, accepted: one")
    run = RunFolder.open(options.runs[0])
    config = training_of(run).config
    if not isinstance(registry.make(config.domain).action_spec, DiscreteActions):
        raise RunError(f"--episode: {config.domain} has continuous actions, accepted: a run with discrete ones; for a "
                       f"page: --html, for a film: python -m mijax.evaluate {run.path} --gif")
    learner, seed, step, seen = _trace(run, options.seed, 1)
    path = (options.out or run.path) / f"episode_seed_{seed}.png"
    title = f"{display_name(config.domain)}, {config.agent}, seed {seed}, step {step:,}"
    draw_episode(seen, 0, learner.domain, path, title=title, weight=config.information.intrinsic_weight)
    return path


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
    episode: bool = False
    """Draw a greedy episode of one run instead of its curves and tables."""
    html: bool = False
    """Write a page to look at beside the tables: curves of every quantity, options, episodes to step through."""
    seed: int | None = None
    """Whose episode; default: the run's first seed."""


def draw(options: ReportOptions) -> None:
    """Write what was asked for, and say where it is."""
    if not options.runs:
        raise RunError("runs: got none, accepted: one run folder or more")
    if options.smooth < 1:
        raise RunError(f"--smooth: got {options.smooth}, accepted: a number >= 1")
    if options.episode and options.html:
        raise RunError("--html: got it with --episode, accepted: one of them; the page has episodes too")
    if options.episode or options.html:
        runtime.prepare()
    if options.episode:
        print(f"Written to {report_episode(options)}")
        return
    out = options.out or (options.runs[0] if len(options.runs) == 1 else pathlib.Path("runs/report"))
    begun = [path for path in options.runs if evaluated(path)]
    if len(options.runs) > 1 and begun and not options.labels:  # of a sweep that goes on
        for path in (path for path in options.runs if path not in begun):
            print(f"{path}: left out, no evaluation yet", file=sys.stderr)
    else:
        begun = options.runs
    runs = load(begun, options.labels)
    print(write_report(runs, out, smooth=options.smooth, note=options.note))
    if options.html:
        report_page(runs, out / page.FILE, options)
    print(f"Written to {out / page.FILE if options.html else out}")


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    options = tyro.cli(ReportOptions, args=arguments, prog="python -m mijax.report")
    return runtime.exit_code(lambda: draw(options))


if __name__ == "__main__":
    sys.exit(main())

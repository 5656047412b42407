"""Many trainings from one small file, side by side, resumable.

    python -m launch.sweep SPEC [--out FOLDER] [--backend local|ray] [--workers N] [--address RAY]
    python -m launch.sweep SPEC [--out FOLDER] --list | --job NUMBER

SPEC is YAML. Every combination of `grid` is a job, a run of `mijax.train`:

    options: {steps: 50000}                     # given to every job
    grid:
      domain: [heaven_hell, sphinx]
      agent: [mi, base]
      dqn.learning-rate: [1.0e-3, 3.0e-4]
    seeds: 6                                    # or a list
    seeds_per_job: 3                            # trained together; default: all
    resources: {cpus: 1, gpus: 0}               # of each job
    retries: 2                                  # for a job whose process died, from its last checkpoint

Jobs are run folders OUT/NAME, logs are OUT/NAME.log. The same command goes on with a sweep that was stopped, at
every job's last checkpoint; finished jobs are left alone. `python -m mijax.report OUT/*/` draws them, at any time.

`local` gives every job its own cores of this machine. `ray` places jobs by what they ask for on the nodes of a Ray
cluster, which must share OUT; a job whose worker or node died is placed anew.

`--job` runs one of the jobs that `--list` numbers and no other, on whatever cores it is given, for clusters that have a
queue of their own. On SLURM, where OUT is shared, a sweep of twelve is this script. Submitted again once it has ended,
with the same SPEC, it goes on with what is not done:

    #!/bin/bash
    #SBATCH --array=0-11 --cpus-per-task=2 --time=04:00:00 --signal=B:TERM@120
    exec python -m launch.sweep SPEC --job "$SLURM_ARRAY_TASK_ID"
"""

import argparse
import dataclasses
import itertools
import pathlib
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol

import yaml
from rich.console import Console
from rich.live import Live
from rich.table import Table

from envs_mjx.errors import UserError
from launch.job import STOP, Job, State, available_cores, run_job
from mijax import train
from mijax.config import ConfigError, parse_seeds, require
from mijax.run_folder import RunError, RunFolder

KEYS = ("options", "grid", "seeds", "seeds_per_job", "resources", "retries")
RESOURCES = ("cpus", "gpus")
SET_BY_SWEEP = ("seeds", "out", "resume", "hosts")
REFRESH_SECONDS = 2.0


@dataclasses.dataclass(frozen=True)
class Sweep:
    """What a file asks for."""

    jobs: tuple[Job, ...]
    cpus: int
    gpus: float
    retries: int


# ----------------------------------------------------------------------------------------------------------------- file


def read(path: pathlib.Path, out: pathlib.Path) -> Sweep:
    """Read a sweep and check every option of every job.

    Raises:
        ConfigError: the file, a key, an option or a value that is not accepted, by its name.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError) as error:
        raise ConfigError(f"{path}: cannot be read ({' '.join(str(error).split())})") from None
    require(isinstance(content, dict) and isinstance(content.get("grid"), dict), "spec", str(path),
            f"YAML with a mapping `grid`, and optionally {', '.join(key for key in KEYS if key != 'grid')}")
    unknown = sorted(set(content) - set(KEYS))
    require(not unknown, "spec", unknown[0] if unknown else "", f"the keys {', '.join(KEYS)}")
    for key in ("options", "resources"):
        value = content.get(key) or {}
        require(isinstance(value, dict), f"spec {key}", value, "a mapping of names to values")
    resources = {"cpus": 1, "gpus": 0} | (content.get("resources") or {})
    unknown = sorted(set(resources) - set(RESOURCES))
    require(not unknown, "spec resources", unknown[0] if unknown else "", f"the keys {', '.join(RESOURCES)}")
    for key, value, least in (("resources.cpus", resources["cpus"], 1), ("resources.gpus", resources["gpus"], 0),
                              ("retries", content.get("retries", 2), 0)):
        require(isinstance(value, int | float) and value >= least, f"spec {key}", value, f"a number >= {least}")
    jobs = tuple(_jobs(content, out))
    for number, job in enumerate(jobs):
        require(job.name not in {other.name for other in jobs[:number]}, "spec", job.name, "every job once")
        check(job)
    return Sweep(jobs, int(resources["cpus"]), float(resources["gpus"]), int(content.get("retries", 2)))


def _jobs(content: Mapping[str, Any], out: pathlib.Path) -> Iterator[Job]:
    options, grid = dict(content.get("options") or {}), dict(content["grid"])
    for name in (*options, *grid):
        require(name.replace("_", "-") not in SET_BY_SWEEP, f"spec {name}", name, "nothing here, the sweep sets it")
    for name, values in grid.items():
        require(isinstance(values, list) and len(values) > 0, f"spec grid.{name}", values, "a list of values")
    seeds = _seeds(content.get("seeds", 1))
    per_job = content.get("seeds_per_job", len(seeds))
    require(isinstance(per_job, int) and per_job >= 1, "spec seeds_per_job", per_job, "a number >= 1")
    parts = [seeds[i: i + per_job] for i in range(0, len(seeds), per_job)]
    for values, part in itertools.product(itertools.product(*grid.values()), parts):
        chosen = dict(zip(grid, values, strict=True))
        arguments = [word for name, value in (options | chosen).items() for word in _flag(name, value)]
        words = [_readable(value) if name in ("domain", "agent", "memory") else f"{name}={_readable(value)}"
                 for name, value in chosen.items()]
        words += [f"seeds={'_'.join(map(str, part))}"] if len(parts) > 1 else []
        yield Job("-".join(words).replace("/", "_").replace(":", "."),
                  (*arguments, "--seeds", ",".join(map(str, part)) + ","), out)


def _seeds(value: Any) -> tuple[int, ...]:
    return parse_seeds(",".join(map(str, value)) + "," if isinstance(value, list) else str(value))


def _flag(name: str, value: Any) -> list[str]:
    """As `mijax.train` takes it: --name value, --name / --no-name for booleans, several values one after the other."""
    dashed = name.replace("_", "-")
    if isinstance(value, bool):
        group, _, last = dashed.rpartition(".")
        return [f"--{dashed}" if value else f"--{group}.no-{last}" if group else f"--no-{last}"]
    return [f"--{dashed}", *(map(str, value) if isinstance(value, list) else [str(value)])]


def _readable(value: Any) -> str:
    return "_".join(map(str, value)) if isinstance(value, list) else str(value)


def check(job: Job) -> None:
    """Parse a job's options as `mijax.train` would, before anything runs; `ConfigError` names the job."""
    try:
        train.parse(job.arguments)
    except SystemExit:
        raise ConfigError(f"spec: {job.name}: options {' '.join(job.arguments)} are not accepted, see above") from None


# -------------------------------------------------------------------------------------------------------------- jobs


def progress(job: Job) -> tuple[int, dict[str, float]]:
    """Environment steps so far, of the seed that is furthest behind, and means of what its seeds last measured."""
    try:
        run = RunFolder.open(job.path)
        rows = [lines[-1] for lines in map(run.metrics, run.seeds()) if lines]
    except RunError:
        return 0, {}
    names = ("evaluation/success", "evaluation/return")
    measured = {name.split("/")[1]: [row[name] for row in rows if name in row] for name in names}
    return (min((row["step"] for row in rows), default=0),
            {name: sum(values) / len(values) for name, values in measured.items() if values})


def last_words(job: Job) -> str:
    """The last line of a job's log: why it failed."""
    lines = job.log.read_text(encoding="utf-8").splitlines() if job.log.exists() else []
    return next((line for line in reversed(lines) if line.strip()), "")


# ------------------------------------------------------------------------------------------------------------ backends


class Backend(Protocol):
    """Where jobs run. `states` is up to date whenever it is read."""

    @property
    def states(self) -> Mapping[str, State]:
        """By job."""
        ...

    def stop(self) -> None:
        """Ask every running job to save and end, and wait for them."""


class Local:
    """Jobs on the cores of this machine, each on cores of its own, or on any where a queue has dealt them out."""

    def __init__(self, sweep: Sweep, workers: int | None = None, dealt_out: bool = False) -> None:
        cores = available_cores()
        fitting = max(1, len(cores) // sweep.cpus)
        self.states: dict[str, State] = {job.name: "done" if job.done else "waiting" for job in sweep.jobs}
        self._todo = deque(job for job in sweep.jobs if not job.done)
        self._retries = sweep.retries
        self._processes: list[subprocess.Popen] = []
        shares = [cores[i % fitting * sweep.cpus:][: sweep.cpus] for i in range(workers or fitting)]
        if dealt_out:
            shares = [[] for _ in shares]
        self._threads = [threading.Thread(target=self._work, args=(share,), daemon=True) for share in shares]
        for thread in self._threads:
            thread.start()

    def _work(self, cores: Sequence[int]) -> None:
        while self._todo:
            try:
                job = self._todo.popleft()
            except IndexError:
                return
            self.states[job.name] = "running"
            self.states[job.name] = run_job(job, self._retries, cores, self._processes.append)

    def stop(self) -> None:
        """As `Backend` says."""
        self._todo.clear()
        for process in self._processes:
            if process.poll() is None:
                process.send_signal(STOP)
        for thread in self._threads:
            thread.join()


class OnRay:
    """Jobs on a Ray cluster, which places them by the CPUs and GPUs they ask for."""

    def __init__(self, sweep: Sweep, address: str | None = None) -> None:
        try:
            import ray  # pyright: ignore[reportMissingImports]
            import ray.exceptions  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise ConfigError("--backend: got 'ray', which is not installed (pip install -e '.[sweep]'), accepted: "
                              "local") from None
        self._ray = ray
        if not ray.is_initialized():
            ray.init(address=address, log_to_driver=False)
        # A lost worker or node is a system failure, which Ray answers by placing the task anew. A worker is not used
        # twice, so that every job starts from a clean process.
        place = ray.remote(num_cpus=sweep.cpus, num_gpus=sweep.gpus, max_retries=sweep.retries, max_calls=1)(run_job)
        self._states: dict[str, State] = {job.name: "done" if job.done else "submitted" for job in sweep.jobs}
        # Ray tells no job which cores are its own: jobs keep to a number of threads, and the system places these.
        self._pending = {place.remote(job, sweep.retries, threads=sweep.cpus): job
                         for job in sweep.jobs if not job.done}

    @property
    def states(self) -> Mapping[str, State]:
        """As `Backend` says."""
        references = list(self._pending)
        ended = self._ray.wait(references, num_returns=len(references), timeout=0)[0] if references else []
        for reference in ended:
            job = self._pending.pop(reference)
            try:
                self._states[job.name] = self._ray.get(reference)
            except self._ray.exceptions.TaskCancelledError:
                self._states[job.name] = "stopped"
            except self._ray.exceptions.RayError:
                self._states[job.name] = "failed"
        return self._states

    def stop(self) -> None:
        """As `Backend` says."""
        references = list(self._pending)
        for reference in references:
            self._ray.cancel(reference)
        if references:
            self._ray.wait(references, num_returns=len(references))


# ------------------------------------------------------------------------------------------------------------- command


def overview(jobs: Sequence[Job], states: Mapping[str, State]) -> Table:
    """All jobs, in one table."""
    table = Table(box=None, pad_edge=False)
    for name in ("job", "state", "step", "success", "return", ""):
        table.add_column(name, justify="left" if name in ("job", "state", "") else "right")
    for job in jobs:
        step, measured = progress(job)
        numbers = (f"{measured[name]:.3f}" if name in measured else "" for name in ("success", "return"))
        words = last_words(job) if states[job.name] == "failed" else ""
        table.add_row(job.name, states[job.name], f"{step:,}", *numbers, words)
    return table


def watch(sweep: Sweep, backend: Backend, console: Console) -> Mapping[str, State]:
    """Show the sweep until every job has ended, or until Ctrl-C; returns how each ended."""
    live = Live(console=console, auto_refresh=False) if console.is_terminal else None
    shown: dict[str, State] = {}
    try:
        if live is not None:
            live.start()
        while True:
            states = dict(backend.states)
            if live is not None:
                live.update(overview(sweep.jobs, states), refresh=True)
            else:
                for name in (name for name, state in states.items() if shown.get(name) != state):
                    console.print(f"{name}: {states[name]}", highlight=False, soft_wrap=True)
            shown = states
            if not {"waiting", "submitted", "running"} & set(states.values()):
                return states
            time.sleep(REFRESH_SECONDS)
    except KeyboardInterrupt:
        console.print("stopping: the running jobs save; the same command goes on from there", highlight=False)
        backend.stop()
        return backend.states
    finally:
        if live is not None:
            live.stop()


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m launch.sweep", description=__doc__, allow_abbrev=False,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("spec", type=pathlib.Path, metavar="SPEC", help="a YAML file")
    parser.add_argument("--out", type=pathlib.Path, help="folder of all jobs; default: runs/ and the name of SPEC")
    parser.add_argument("--backend", choices=("local", "ray"), default="local")
    parser.add_argument("--workers", type=int, help="jobs side by side (local); default: as many as their cores fit")
    parser.add_argument("--address", help="of the Ray cluster; default: one on this machine")
    alone = parser.add_mutually_exclusive_group()
    alone.add_argument("--list", action="store_true", help="number and name of every job, and which are done; run none")
    alone.add_argument("--job", type=int, metavar="NUMBER", help="run this job alone, on any cores (local)")
    options = parser.parse_args(arguments)
    require(options.workers is None or options.workers >= 1, "workers", options.workers, "a number >= 1")
    for name, other in (("workers", "local"), ("job", "local"), ("address", "ray")):
        given = getattr(options, name)
        require(given is None or options.backend == other, name, given, f"nothing, it belongs to --backend {other}")
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """The command: 0 when every job is done, 1 when one failed, 130 when it was stopped."""
    console = Console()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        options = parse(sys.argv[1:] if arguments is None else arguments)
        out = (options.out or pathlib.Path("runs") / options.spec.stem).resolve()
        sweep = read(options.spec, out)
        if options.list:
            for number, job in enumerate(sweep.jobs):
                console.print(f"{number} {job.name}{': done' if job.done else ''}", highlight=False, soft_wrap=True)
            return 0
        if options.job is not None:
            last = len(sweep.jobs) - 1
            require(0 <= options.job <= last, "job", options.job, f"0 to {last}, which --list shows")
            sweep = dataclasses.replace(sweep, jobs=(sweep.jobs[options.job],))
        local = options.backend == "local"
        backend = (Local(sweep, options.workers, dealt_out=options.job is not None) if local
                   else OnRay(sweep, options.address))
    except (UserError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    states = watch(sweep, backend, console)
    console.print(overview(sweep.jobs, states))
    if "failed" in states.values():
        return 1
    return 0 if set(states.values()) == {"done"} else 130


if __name__ == "__main__":
    sys.exit(main())

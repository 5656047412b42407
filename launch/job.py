"""A job of a sweep: `mijax.train` on given cores, started again after its death, and never outliving its starter.

    python -m launch.job CORES PARENT OPTION...

CORES are numbers with commas between them, or nothing for all; PARENT is the starter's process id.

What starts a job imports no JAX: on Ray, where every job has a starter of its own, that took 8 % of a short sweep.
"""

import ctypes
import dataclasses
import os
import pathlib
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Literal, NoReturn

State = Literal["waiting", "submitted", "running", "done", "failed", "stopped"]
STOP = signal.SIGTERM
"""Asks a run to save and end. Ctrl-C's signal would be ignored by what a shell has started in the background."""

_DIES_WITH_PARENT = 1
"""PR_SET_PDEATHSIG of Linux."""


@dataclasses.dataclass(frozen=True)
class Job:
    """One run of `mijax.train`."""

    name: str
    """Of its folder: what tells it from the sweep's other jobs."""
    arguments: tuple[str, ...]
    """Of a new run, without its folder."""
    out: pathlib.Path
    """Of the sweep."""

    @property
    def path(self) -> pathlib.Path:
        """The run folder."""
        return self.out / self.name

    @property
    def log(self) -> pathlib.Path:
        """What the run prints."""
        return self.out / f"{self.name}.log"

    @property
    def done(self) -> bool:
        """Whether the run has ended well."""
        return (self.path / "summary.json").exists()

    def command(self, cores: Sequence[int]) -> list[str]:
        """Starts the run, or goes on with it."""
        begun = (self.path / "config.json").exists()
        arguments = ("--resume", str(self.path)) if begun else (*self.arguments, "--out", str(self.path))
        return [sys.executable, "-m", "launch.job", ",".join(map(str, cores)), str(os.getpid()), *arguments]


def run_job(
    job: Job, retries: int, cores: Sequence[int] = (), started: Callable[[subprocess.Popen], None] | None = None,
    threads: int | None = None,
) -> State:
    """Run a job to its end, again after each death of its process, in a process that cannot outlive this one.

    A process that ends by itself with an error is not started again: it would end so again. Ctrl-C asks it to save.

    Args:
        job: what to run.
        retries: how often a job that was killed goes on from its last checkpoint.
        cores: to run on; none: any.
        started: called with every process that was started.
        threads: of the CPU that XLA may use; default: as many as cores.
    """
    environment = os.environ | ({} if threads is None else {"NPROC": str(threads)})
    job.log.parent.mkdir(parents=True, exist_ok=True)
    for _ in range(retries + 1):
        if job.done:
            return "done"
        with job.log.open("a", encoding="utf-8") as log:
            process = subprocess.Popen(job.command(cores), stdout=log, stderr=subprocess.STDOUT,
                                       stdin=subprocess.DEVNULL, start_new_session=True, env=environment)
        if started is not None:
            started(process)
        try:
            code = process.wait()
        except KeyboardInterrupt:
            process.send_signal(STOP)
            code = process.wait()
        if job.done:
            return "done"
        if code in (0, -STOP):
            return "stopped"
        if code > 0:
            return "failed"
    return "failed"


def available_cores() -> list[int]:
    """Numbers of the cores that this process may use."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))


def prepare(cores: Sequence[int], parent: int) -> None:
    """Before JAX is loaded: take the cores, and die when the parent does (both on Linux)."""
    if not sys.platform.startswith("linux"):
        return
    if cores:
        os.sched_setaffinity(0, cores)
    ctypes.CDLL(None).prctl(_DIES_WITH_PARENT, signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit(f"error: the process {parent} that started this job is gone")


def main(arguments: Sequence[str]) -> NoReturn:
    """The command."""
    cores, parent, *options = arguments
    prepare([int(core) for core in cores.split(",") if core], int(parent))
    from mijax import runtime, train

    runtime.leave(train.main(options))


if __name__ == "__main__":
    main(sys.argv[1:])

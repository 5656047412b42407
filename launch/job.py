"""`mijax.train` as a sweep's job: on given cores, and never outliving the process that started it.

    python -m launch.job CORES PARENT OPTION...

CORES are numbers with commas between them, or nothing for all; PARENT is the starter's process id.
"""

import ctypes
import os
import signal
import sys
from collections.abc import Sequence

_DIES_WITH_PARENT = 1
"""PR_SET_PDEATHSIG of Linux."""


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


def main(arguments: Sequence[str]) -> int:
    """The command."""
    cores, parent, *options = arguments
    prepare([int(core) for core in cores.split(",") if core], int(parent))
    from mijax import train

    return train.main(options)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

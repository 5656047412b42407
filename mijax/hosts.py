"""Several hosts that share the seeds of one run out among themselves.

Seeds have nothing to tell each other, so hosts meet once, by `jax.distributed`, to learn how many they are; each then
trains its seeds by itself and writes their files into a run folder that all of them see. A host that dies takes no
other with it: the meeting is held in a process of its own, since one that stays in `jax.distributed` ends with the
first that is lost, and Orbax would write arrays on host 0 alone.
"""

import dataclasses
import json
import os
import re
import subprocess
import sys
from collections.abc import Sequence

import jax

from mijax.config import ConfigError

ACCEPTED = ("auto (where JAX finds the hosts itself: SLURM, Open MPI, Kubernetes) or ADDRESS:PORT,INDEX,COUNT, with an "
            "address of host 0 and an index below the count")
EXPLICIT = re.compile(r"(?P<address>\S+:\d+),(?P<index>\d+),(?P<count>\d+)")


@dataclasses.dataclass(frozen=True)
class Host:
    """Which host this is, of how many."""

    index: int = 0
    count: int = 1

    def share(self, seeds: Sequence[int]) -> tuple[int, ...]:
        """The seeds of this host."""
        return tuple(seeds[self.index::self.count])


def check(hosts: str, seeds: int) -> None:
    """Raise `ConfigError` unless `hosts` is what --hosts accepts for so many seeds, or empty."""
    found = EXPLICIT.fullmatch(hosts)
    if hosts not in ("", "auto") and not (found and int(found["index"]) < int(found["count"])):
        raise ConfigError(f"--hosts: got {hosts!r}, accepted: {ACCEPTED}")
    require_seeds(hosts, int(found["count"]) if found else 1, seeds)


def require_seeds(hosts: str, count: int, seeds: int) -> None:
    """Raise `ConfigError` for more hosts than there are seeds."""
    if count > seeds:
        raise ConfigError(f"--hosts: got {hosts!r}, accepted: at most {seeds} hosts, one for each seed, not {count}")


def meet(hosts: str) -> Host:
    """Wait until all hosts are there, five minutes at most; all leave together.

    Args:
        hosts: as --hosts has it; empty: this host alone.

    Raises:
        ConfigError: they cannot meet.
    """
    if not hosts:
        return Host()
    # On a CPU: an accelerator's memory is left to the process that trains.
    done = subprocess.run([sys.executable, "-m", "mijax.hosts", hosts], capture_output=True, text=True, check=False,
                          env=os.environ | {"JAX_PLATFORMS": "cpu"})
    if done.returncode != 0:
        said = done.stderr.strip().splitlines() or ["no reason given"]
        raise ConfigError(f"--hosts {hosts}: the hosts did not meet: {said[-1]}")
    return Host(*json.loads(done.stdout.splitlines()[-1]))


def _meet(hosts: str) -> None:
    """Say index and count on standard output."""
    found = EXPLICIT.fullmatch(hosts)
    try:
        if found is None:
            jax.distributed.initialize()
        else:
            jax.distributed.initialize(found["address"], int(found["count"]), int(found["index"]))
    except Exception as error:  # JAX's kinds differ by cause; the first of their lines says it
        sys.exit(str(error).splitlines()[0])
    print(json.dumps([jax.process_index(), jax.process_count()]))
    jax.distributed.shutdown()


if __name__ == "__main__":
    _meet(sys.argv[1])

"""The run folder, and what is in it.

    RUN/config.json             the run's options; the last file of a new folder, so that it marks a whole one
    RUN/versions.json           python, packages, platform, commit
    RUN/seed_K/representation/  stage 1's encoders and what its probe found
    RUN/seed_K/checkpoints/     the newest ones
    RUN/seed_K/metrics.jsonl    one JSON object per evaluation
    RUN/seed_K/end.json         at the seed's end: its last evaluation, and seconds that its metrics do not have
    RUN/seed_K/lock             empty: locked while a process works on the seed
    RUN/lock                    empty: locked while one writes what is about all seeds
    RUN/summary.json            at the end: see `mijax.results.summarise`
    RUN/curve.png

A published result has its metrics as RUN/metrics_seed_K.jsonl, without the seeds' folders.

A line of metrics has `step` (environment steps of this seed) and numbers by name. A number under `wall/` is the seconds
since the previous line, so that lines dropped on resuming take their seconds with them.
"""

import contextlib
import dataclasses
import errno
import json
import math
import os
import pathlib
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from envs_mjx.errors import UserError
from mijax.files import ASIDE, write_atomically
from mijax.versions import current_versions

if sys.platform != "win32":
    import fcntl

LOCK = "lock"
Row = dict[str, Any]
"""A line of metrics."""


class RunError(UserError):
    """A run folder cannot be used; the message is one line that names the folder and what is wrong with it."""


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """A folder that holds everything about one run. Made by `create` or `open`."""

    path: pathlib.Path

    @classmethod
    def create(
        cls, path: str | os.PathLike[str], config: Mapping[str, Any], fill: Callable[["RunFolder"], None] | None = None
    ) -> "RunFolder":
        """Start a new run in `path`, which must be empty or not exist.

        Args:
            path: its folder.
            config: the run's options by name.
            fill: puts representations there, before the run counts as started.
        """
        run = cls(pathlib.Path(path))
        run.refuse_taken()
        with _named_errors(run.path):
            run.path.mkdir(parents=True, exist_ok=True)
            started = {"versions.json", f"versions.json{ASIDE}", f"config.json{ASIDE}"}  # a killed start leaves these
            taken_over = list(run.path.glob("seed_*/representation"))
            started |= {path.parent.name for path in taken_over}
            foreign = sorted({entry.name for entry in run.path.iterdir()} - started)
        if foreign:
            raise RunError(f"{path}: not empty and not a run (it holds {foreign[0]}); choose another --out")
        with _named_errors(run.path):
            for path in taken_over:  # by a start that was killed, perhaps of other options
                shutil.rmtree(path)
                with contextlib.suppress(OSError):  # it holds something else
                    path.parent.rmdir()
        if fill is not None:
            fill(run)
        _write_json(run._file("versions.json"), current_versions())
        _write_json(run._file("config.json"), config)
        return run

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> "RunFolder":
        """An existing run; `RunError` when `path` holds none or only half of one."""
        run = cls(pathlib.Path(path))
        if not run.path.is_dir():
            raise RunError(f"{path}: no such run folder")
        if not run._file("config.json").exists():
            raise RunError(f"{path}: not a run folder, or one that was never finished starting (no config.json)")
        if not isinstance(run.config().get("domain"), str):
            raise RunError(f"{path}: not a run folder of mijax (config.json names no domain)")
        return run

    def refuse_taken(self) -> None:
        """Raise `RunError` where a new run would find another one."""
        if self._file("config.json").exists():
            raise RunError(f"{self.path}: already holds a run; `python -m mijax.train --resume {self.path}` goes on "
                           "with it; choose another --out")

    def discard(self, seeds: Sequence[int]) -> None:
        """Remove a run of these seeds that could not begin; one that has anything of a seed, or others, stays."""
        for seed in seeds:
            path = self.seed_path(seed)
            if {entry.name for entry in path.glob("*")} <= {LOCK}:
                (path / LOCK).unlink(missing_ok=True)
                with contextlib.suppress(OSError):
                    path.rmdir()
        if self.seeds() or set(seeds) != set(self.config().get("seed_list", seeds)):
            return
        for name in ("config.json", "versions.json"):
            self._file(name).unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # it holds something else, or is where the program works
            self.path.rmdir()

    @contextlib.contextmanager
    def held(self, seeds: Sequence[int]) -> Iterator[None]:
        """Keep other processes from working on these seeds meanwhile; `RunError` where one does.

        The locks end with the process, however that ends. A file system without locks, or whose locks other hosts do
        not see, is worked on without.
        """
        with contextlib.ExitStack() as stack:
            for seed in seeds:
                path = self.seed_path(seed)
                with _named_errors(path):
                    path.mkdir(exist_ok=True)
                if not stack.enter_context(_locked(path / LOCK, wait=False)):
                    raise RunError(f"{path}: another process is at work in it; wait for its end, or stop it")
            yield

    @contextlib.contextmanager
    def concluding(self) -> Iterator[None]:
        """One process after the other: for what is about all seeds."""
        with _locked(self._file(LOCK), wait=True):
            yield

    def config(self) -> dict[str, Any]:
        """The run's options, as written by `create`."""
        return _read_json(self._file("config.json"))

    def amend(self, *, steps: int, track: str) -> None:
        """Go on under another budget of environment steps, so that the run has not ended, or with another tracker."""
        config = self.config()
        if config.get("steps") != steps:
            self._file("summary.json").unlink(missing_ok=True)
        changed = config | {"steps": steps, "track": track}
        if changed != config:
            _write_json(self._file("config.json"), changed)

    def add_seeds(self, seeds: Sequence[int]) -> None:
        """Count more seeds to the run's."""
        config = self.config()
        every = sorted({*config.get("seed_list", ()), *seeds})
        if every != config.get("seed_list"):
            _write_json(self._file("config.json"), config | {
                "seed_list": every, "seeds": ",".join(map(str, every)) + ","})

    def versions(self) -> dict[str, Any]:
        """What the run was started with: python, packages, platform, commit."""
        return _read_json(self._file("versions.json"))

    def has_versions(self) -> bool:
        """Whether it is known what the run was started with."""
        return self._file("versions.json").exists()

    def seeds(self) -> tuple[int, ...]:
        """The seeds that have a folder, or published metrics, in order."""
        names = [entry.name.removeprefix("seed_") for entry in self.path.glob("seed_*") if entry.is_dir()]
        names += [entry.stem.removeprefix("metrics_seed_") for entry in self.path.glob("metrics_seed_*.jsonl")]
        return tuple(sorted({int(name) for name in names if name.isdigit()}))

    def seed_path(self, seed: int) -> pathlib.Path:
        """The folder of one seed."""
        return self.path / f"seed_{seed}"

    def append(self, seed: int, row: Mapping[str, Any]) -> None:
        """Add a line to a seed's metrics; it is in the file when this returns."""
        line = json.dumps({name: plain(value) for name, value in row.items()}, allow_nan=False)
        path = self._metrics_file(seed)
        with _named_errors(path):
            path.parent.mkdir(exist_ok=True)
            with path.open("a", encoding="utf-8") as file:
                file.write(line + "\n")

    def metrics(self, seed: int) -> list[Row]:
        """All lines of a seed; a last line torn by a kill is dropped, and so are numbers that were not finite."""
        return [{name: value for name, value in row.items() if value is not None} for _, row in self._lines(seed)]

    def truncate_after(self, step: int, seeds: Sequence[int]) -> None:
        """Drop these seeds' lines after `step`, and what they came to, so that a resumed run writes them again."""
        for seed in seeds:
            (self.seed_path(seed) / "end.json").unlink(missing_ok=True)
            kept = [line for line, row in self._lines(seed) if row["step"] <= step]
            if self._metrics_file(seed).exists():
                _write(self._metrics_file(seed), "".join(f"{line}\n" for line in kept))

    def has_results(self, seed: int) -> bool:
        """Whether it was trained to its end, or its metrics are published."""
        ended = (self._file("summary.json"), self.seed_path(seed) / "end.json")
        return any(path.exists() for path in (*ended, self._published(seed)))

    def write_end(self, seed: int, step: int, end: Mapping[str, Any]) -> None:
        """Write what a seed came to at its last step, for the summary of all."""
        _write_json(self.seed_path(seed) / "end.json", {"step": step, **end})

    def end(self, seed: int, step: int) -> dict[str, Any] | None:
        """What a seed came to, or None while it has not ended at this step."""
        path = self.seed_path(seed) / "end.json"
        end = _read_json(path) if path.exists() else {}
        return end if end.get("step") == step else None

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write summary.json."""
        _write_json(self._file("summary.json"), summary)

    def summary(self) -> dict[str, Any] | None:
        """summary.json, or None while the run has not ended."""
        path = self._file("summary.json")
        return _read_json(path) if path.exists() else None

    def _lines(self, seed: int) -> list[tuple[str, Row]]:
        path = self._metrics_file(seed)
        if not path.exists():
            return []
        with _named_errors(path):
            lines = path.read_text(encoding="utf-8").split("\n")[:-1]  # a whole line ends in a newline
        rows = []
        for number, line in enumerate(lines, start=1):
            try:
                row = json.loads(line)
                row["step"] = int(row["step"])
            except (ValueError, TypeError, KeyError):
                raise RunError(f"{path}:{number}: not a line of metrics") from None
            rows.append((line, row))
        return rows

    def _file(self, name: str) -> pathlib.Path:
        return self.path / name

    def _published(self, seed: int) -> pathlib.Path:
        return self._file(f"metrics_seed_{seed}.jsonl")

    def _metrics_file(self, seed: int) -> pathlib.Path:
        published = self._published(seed)
        return published if published.exists() else self.seed_path(seed) / "metrics.jsonl"


def plain(value: Any) -> Any:
    """NumPy and JAX numbers as Python's; None where JSON has no number for it."""
    if isinstance(value, Mapping):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, str | bool | int) or value is None:
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    number = np.asarray(value).item()
    return None if isinstance(number, float) and not math.isfinite(number) else number


@contextlib.contextmanager
def _locked(path: pathlib.Path, *, wait: bool) -> Iterator[bool]:
    """Whether a file could be locked; where they cannot be, as on Windows, always. A file, and open for writing, as
    NFS shows no other lock to other hosts."""
    if sys.platform == "win32":
        yield True
        return
    with _named_errors(path):
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            locked = True
        except OSError as error:
            locked = error.errno in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS)
            if not locked and error.errno not in (errno.EAGAIN, errno.EACCES):
                os.close(file)
                raise
    try:
        yield locked
    finally:
        os.close(file)


@contextlib.contextmanager
def _named_errors(path: pathlib.Path) -> Iterator[None]:
    """Turn an error of the file system (a full disk, no permission) into one line that names the file."""
    try:
        yield
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise RunError(f"{path}: {reason}") from error


def _write(path: pathlib.Path, text: str) -> None:
    with _named_errors(path):
        write_atomically(path, text.encode())


def _write_json(path: pathlib.Path, value: Any) -> None:
    _write(path, json.dumps(plain(value), indent=2, allow_nan=False) + "\n")


def _read_json(path: pathlib.Path) -> dict[str, Any]:
    with _named_errors(path):
        text = path.read_text(encoding="utf-8")
    try:
        value = json.loads(text)
    except ValueError:
        raise RunError(f"{path}: corrupt or half-written (not JSON)") from None
    if not isinstance(value, dict):
        raise RunError(f"{path}: corrupt (not a JSON object)")
    return value

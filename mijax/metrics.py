"""The run folder, its metrics, and what is shown and logged while a run works.

    RUN/config.json             the run's options; the last file of a new folder, so that it marks a whole one
    RUN/versions.json           python, packages, platform, commit
    RUN/seed_K/metrics.jsonl    one JSON object per evaluation
    RUN/summary.json            at the end: see `mijax.results.summarise`
    RUN/curve.png

A published result has its metrics as RUN/metrics_seed_K.jsonl, without the seeds' folders.

A line of metrics has `step` (environment steps of this seed) and numbers by name. A number under `wall/` is the seconds
since the previous line, so that lines dropped on resuming take their seconds with them.
"""

import contextlib
import dataclasses
import importlib.metadata
import json
import math
import os
import pathlib
import platform
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal, Protocol

import numpy as np
from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, TextColumn
from rich.text import Text

Row = dict[str, Any]
"""A line of metrics."""
TrackerName = Literal["none", "tensorboard", "wandb"]

_PACKAGES = ("mijax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy")
_RATE_WINDOW = 20
"""Reports over which the speed shown is averaged."""


class RunError(ValueError):
    """A run folder cannot be used; the message is one line that names the folder and what is wrong with it."""


# ---------------------------------------------------------------------------------------------------------- run folder


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
        if run._file("config.json").exists():
            raise RunError(f"{path}: already holds a run; continue it with --resume {path}, or choose another --out")
        with _named_errors(run.path):
            run.path.mkdir(parents=True, exist_ok=True)
            started = {"versions.json", "versions.json.tmp", "config.json.tmp"}  # a start that was killed leaves these
            started |= {path.parent.name for path in run.path.glob("seed_*/representation")}
            foreign = sorted({entry.name for entry in run.path.iterdir()} - started)
        if foreign:
            raise RunError(f"{path}: not empty and not a run (it holds {foreign[0]}); choose another --out")
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

    def config(self) -> dict[str, Any]:
        """The run's options, as written by `create`."""
        return _read_json(self._file("config.json"))

    def extend(self, steps: int) -> None:
        """Give the run another budget of environment steps, so that it has not ended."""
        self._file("summary.json").unlink(missing_ok=True)
        _write_json(self._file("config.json"), self.config() | {"steps": steps})

    def versions(self) -> dict[str, Any]:
        """What the run was started with: python, packages, platform, commit."""
        return _read_json(self._file("versions.json"))

    def has_versions(self) -> bool:
        """Whether it is known what the run was started with."""
        return self._file("versions.json").exists()

    def require(self, **options: Any) -> None:
        """Raise `RunError` unless the run has these options, e.g. `run.require(domain="sphinx")`."""
        config = self.config()
        for name, expected in options.items():
            if config.get(name) != expected:
                raise RunError(f"{self.path}: is a run with {name} {config.get(name)!r}, wanted {expected!r}")

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
        line = json.dumps({name: _plain(value) for name, value in row.items()}, allow_nan=False)
        path = self._metrics_file(seed)
        with _named_errors(path):
            path.parent.mkdir(exist_ok=True)
            with path.open("a", encoding="utf-8") as file:
                file.write(line + "\n")

    def metrics(self, seed: int) -> list[Row]:
        """All lines of a seed; a last line torn by a kill is dropped, and so are numbers that were not finite."""
        return [{name: value for name, value in row.items() if value is not None} for _, row in self._lines(seed)]

    def truncate_after(self, step: int) -> None:
        """Drop every seed's lines after `step`, so that a resumed run writes them again."""
        for seed in self.seeds():
            kept = [line for line, row in self._lines(seed) if row["step"] <= step]
            if self._metrics_file(seed).exists():
                _write_atomically(self._metrics_file(seed), "".join(f"{line}\n" for line in kept))

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

    def _metrics_file(self, seed: int) -> pathlib.Path:
        published = self._file(f"metrics_seed_{seed}.jsonl")
        return published if published.exists() else self.seed_path(seed) / "metrics.jsonl"


def _plain(value: Any) -> Any:
    """NumPy and JAX numbers as Python's; None where JSON has no number for it."""
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, str | bool | int) or value is None:
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    number = np.asarray(value).item()
    return None if isinstance(number, float) and not math.isfinite(number) else number


@contextlib.contextmanager
def _named_errors(path: pathlib.Path) -> Iterator[None]:
    """Turn an error of the file system (a full disk, no permission) into one line that names the file."""
    try:
        yield
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise RunError(f"{path}: {reason}") from error


def _write_atomically(path: pathlib.Path, text: str) -> None:
    temporary = path.with_name(f"{path.name}.tmp")
    with _named_errors(path):
        with temporary.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)


def _write_json(path: pathlib.Path, value: Any) -> None:
    _write_atomically(path, json.dumps(_plain(value), indent=2, allow_nan=False) + "\n")


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


def current_versions() -> dict[str, Any]:
    """What works here: python, packages, platform, commit."""
    def version(package: str) -> str | None:
        try:
            return importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            return None

    packages = {package: version(package) for package in _PACKAGES}
    return {"python": platform.python_version(), **packages, "platform": platform.platform(), "commit": _commit()}


def _commit() -> str | None:
    """The commit of the source tree, with `+changes` when it differs from it; None outside a repository."""
    tree = pathlib.Path(__file__).resolve().parents[1]
    if not (tree / ".git").exists():
        return None

    def git(*arguments: str) -> str:
        command = ("git", "-C", str(tree), *arguments)
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+changes" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None


# ------------------------------------------------------------------------------------------------------------ trackers


class Tracker(Protocol):
    """Where metrics go besides the run folder."""

    def log(self, seed: int, row: Mapping[str, Any]) -> None:
        """Log a line of metrics."""
        ...

    def close(self) -> None:
        """Finish writing."""
        ...


def make_tracker(name: TrackerName, run: RunFolder) -> Tracker:
    """The tracker called `name`, writing inside the run folder. A resumed run logs once more what it does again."""
    kinds = {"none": _NoTracker, "tensorboard": _TensorBoardTracker, "wandb": _WandbTracker}
    if name not in kinds:
        raise RunError(f"--track: got {name!r}, accepted: {', '.join(kinds)}")
    try:
        return kinds[name](run)
    except ImportError:
        raise RunError(f"--track {name}: its package is missing; install it with: pip install 'mijax[track]'") from None


def _numbers(row: Mapping[str, Any]) -> dict[str, float]:
    plain = {name: _plain(value) for name, value in row.items()}
    return {name: value for name, value in plain.items() if isinstance(value, int | float) and name != "step"}


class _NoTracker:
    def __init__(self, run: RunFolder) -> None:
        del run

    def log(self, seed: int, row: Mapping[str, Any]) -> None:
        pass

    def close(self) -> None:
        pass


class _TensorBoardTracker:
    def __init__(self, run: RunFolder) -> None:
        from tensorboardX import SummaryWriter  # pyright: ignore[reportMissingImports]

        self._make_writer = lambda seed: SummaryWriter(logdir=str(run.seed_path(seed) / "tensorboard"))
        self._writers: dict[int, Any] = {}

    def log(self, seed: int, row: Mapping[str, Any]) -> None:
        if seed not in self._writers:
            self._writers[seed] = self._make_writer(seed)
        for name, value in _numbers(row).items():
            self._writers[seed].add_scalar(name, value, global_step=int(row["step"]))

    def close(self) -> None:
        for writer in self._writers.values():
            writer.close()


class _WandbTracker:
    """Weights & Biases without a connection: `wandb sync RUN/wandb/offline-run-*` sends it later."""

    def __init__(self, run: RunFolder) -> None:
        import wandb  # pyright: ignore[reportMissingImports]

        config = run.config()
        self._start = lambda seed: wandb.init(
            project="mijax", group=run.path.name, name=f"{run.path.name}/seed_{seed}", dir=str(run.path),
            config={**config, "seed": seed}, mode="offline", reinit="create_new",
            settings=wandb.Settings(silent=True, console="off"),
        )
        self._runs: dict[int, Any] = {}

    def log(self, seed: int, row: Mapping[str, Any]) -> None:
        if seed not in self._runs:
            self._runs[seed] = self._start(seed)
        self._runs[seed].log(_numbers(row), step=int(row["step"]))

    def close(self) -> None:
        for run in self._runs.values():
            run.finish()


# ------------------------------------------------------------------------------------------------------------ progress


class ProgressDisplay:
    """A progress bar on a terminal; elsewhere plain lines, one every `interval` seconds.

        with ProgressDisplay("stage 2", total=100_000) as progress:
            progress.update(step, {"return": 0.4, "success": 0.5, "loss/td": 0.01})
    """

    def __init__(self, label: str, total: int, *, start: int = 0, unit: str = "steps", interval: float = 10.0,
                 console: Console | None = None) -> None:
        """Args:
            label: what is being done.
            total: where `update` will end.
            start: where it begins, when a run is resumed.
            unit: what is counted.
            interval: seconds between plain lines.
            console: where to show it; standard output by default.
        """
        self._label, self._total, self._unit, self._interval = label, total, unit, interval
        self._console = console or Console(file=sys.stdout, highlight=False)
        self._reports: deque[tuple[float, int]] = deque([(time.monotonic(), start)], maxlen=_RATE_WINDOW)
        self._last_line = -math.inf
        self._bar: Progress | None = None
        if self._console.is_terminal:
            self._bar = _TwoLines(console=self._console)
            self._task = self._bar.add_task(label, total=total, completed=start, speed=self._speed(start), numbers="")

    def __enter__(self) -> "ProgressDisplay":
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def update(self, done: int, values: Mapping[str, float] | None = None) -> None:
        """Report that `done` units are done in all, with the latest numbers by name."""
        now = time.monotonic()
        self._reports.append((now, done))
        speed = self._speed(done)
        numbers = "  ".join(f"{name} {value:.3g}" for name, value in (values or {}).items() if value is not None)
        if self._bar is not None:
            self._bar.update(self._task, completed=done, speed=speed, numbers=numbers)
        elif now - self._last_line >= self._interval or done >= self._total:
            self._last_line = now
            self._console.print(f"{self._label}  {speed}  {numbers}".rstrip(), soft_wrap=True, markup=False)

    def print(self, line: str) -> None:
        """Show a line of its own, above the bar."""
        self._console.print(line, soft_wrap=True, markup=False)

    def _speed(self, done: int) -> str:
        (first_time, first_done), (last_time, last_done) = self._reports[0], self._reports[-1]
        rate = (last_done - first_done) / (last_time - first_time) if last_time > first_time else 0.0
        parts = [f"{done:,}/{self._total:,} {self._unit}", f"{100 * done / max(self._total, 1):.0f}%"]
        if rate > 0:
            shown = f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"
            parts += [f"{shown} {self._unit}/s", f"{_clock((self._total - done) / rate)} left"]
        return "  ".join(parts)


class _TwoLines(Progress):
    """The bar with its speed, and under it the numbers: both fit a terminal of 80 columns, a longer line is cut."""

    def __init__(self, console: Console) -> None:
        super().__init__(TextColumn("{task.description}"), BarColumn(bar_width=12), TextColumn("{task.fields[speed]}"),
                         console=console)

    def get_renderables(self) -> Iterator[RenderableType]:
        yield self.make_tasks_table(self.tasks)
        for task in self.tasks:
            yield Text(task.fields["numbers"], style="cyan", no_wrap=True, overflow="ellipsis")


def _clock(seconds: float) -> str:
    minutes, second = divmod(max(round(seconds), 0), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02d}:{second:02d}" if hours else f"{minute:02d}:{second:02d}"

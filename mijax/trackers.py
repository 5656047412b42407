"""Services that metrics go to besides the run folder."""

import importlib.util
from collections.abc import Mapping
from typing import Any, Literal, Protocol

from mijax.config import require
from mijax.run_folder import RunFolder, plain

TrackerName = Literal["none", "tensorboard", "wandb"]


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
    require_tracker(name)
    return _KINDS[name](run)


def require_tracker(name: str) -> None:
    """Raise `ConfigError` unless there is such a tracker, and its package."""
    require(name in _KINDS, "track", name, ", ".join(_KINDS))
    package = _KINDS[name].package
    require(package is None or importlib.util.find_spec(package) is not None, "track", name,
            f"with the package {package} alone, which is missing: pip install -e '.[track]'")


def _numbers(row: Mapping[str, Any]) -> dict[str, float]:
    values = {name: plain(value) for name, value in row.items()}
    return {name: value for name, value in values.items() if isinstance(value, int | float) and name != "step"}


class _NoTracker:
    package = None

    def __init__(self, run: RunFolder) -> None:
        del run

    def log(self, seed: int, row: Mapping[str, Any]) -> None:
        pass

    def close(self) -> None:
        pass


class _TensorBoardTracker:
    package = "tensorboardX"

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

    package = "wandb"

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


_KINDS: dict[str, Any] = {"none": _NoTracker, "tensorboard": _TensorBoardTracker, "wandb": _WandbTracker}

"""Runs that take seconds, and what two of them have in common."""

import pathlib

from mijax.run_folder import RunFolder

OPTIONS = {
    "network.action-embedding": 4, "network.observation-embedding": 4, "network.critic-hidden": 8,
    "network.auxiliary-hidden": 8, "stage1.episodes": 12, "stage1.heldout-episodes": 8, "stage1.epochs": 2,
    "stage1.batch-size": 100, "dqn.batch-episodes": 4, "dqn.replay-steps": 2000, "dqn.warmup-episodes": 4,
    "dqn.pretrain-updates": 0, "evaluation.every": 200, "evaluation.episodes": 4, "checkpoint.every": 1,
}
TINY = [word for name, value in OPTIONS.items() for word in (f"--{name}", str(value))]
"""As arguments of `mijax.train`."""


def comparable(run: pathlib.Path, seed: int) -> list[dict]:
    """A seed's metrics without the seconds."""
    rows = RunFolder.open(run).metrics(seed)
    return [{name: value for name, value in row.items() if not name.startswith("wall/")} for row in rows]

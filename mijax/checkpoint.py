"""Checkpoints: everything a seed needs to go on bit for bit, written atomically by Orbax.

    RUN/seed_K/checkpoints/STEP/     the newest few, one folder per environment step

A state is stored as a flat dictionary of arrays under the names of its fields, so that a checkpoint can be read, and
its mismatch with another configuration be named, without the classes that wrote it. Arrays without entries, as a
simulator's state may have, are left out: Orbax does not store them.
"""

import logging
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from mijax.learner import LearnerState
from mijax.run_folder import RunError, RunFolder

FOLDER = "checkpoints"


class Checkpoints:
    """The checkpoints of one seed of a run."""

    def __init__(self, run: RunFolder, seed: int, keep: int = 2) -> None:
        """Open or make the folder; the newest `keep` checkpoints stay."""
        logging.getLogger("absl").setLevel(logging.ERROR)  # Orbax reports every step of its work
        self.path = (run.seed_path(seed) / FOLDER).resolve()
        options = ocp.CheckpointManagerOptions(max_to_keep=keep, enable_async_checkpointing=False)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            handler = ocp.StandardCheckpointHandler()  # told in advance: a new process has nothing else to read with
            self._manager = ocp.CheckpointManager(self.path, options=options, item_handlers=handler)
        except (OSError, ValueError) as error:
            raise RunError(f"{self.path}: {_one_line(error)}") from error

    def steps(self) -> tuple[int, ...]:
        """Environment steps of the whole checkpoints, oldest first."""
        return tuple(sorted(self._manager.all_steps()))

    def save(self, step: int, state: LearnerState) -> None:
        """Write a checkpoint; the older ones stay whole whatever happens meanwhile."""
        if step in self.steps():
            return
        try:
            self._manager.save(step, args=ocp.args.StandardSave(_flatten(state)), force=True)
            self._manager.wait_until_finished()
        except Exception as error:  # Orbax and TensorStore raise many kinds: a full disk is one of them
            where = self.path / str(step)
            raise RunError(f"{where}: the checkpoint could not be written: {_one_line(error)}") from error

    def load(self, step: int, template: LearnerState) -> LearnerState:
        """The state saved at `step`, shaped like `template` (of `jax.eval_shape`)."""
        wanted = {name: jax.ShapeDtypeStruct(x.shape, x.dtype) for name, x in _flatten(template).items()}
        where = self.path / str(step)
        try:
            stored = self._manager.item_metadata(step)
            shapes = {name: tuple(meta.shape) for name, meta in dict(stored).items()}
        except Exception as error:
            raise RunError(f"{where}: corrupt or half-written checkpoint: {_one_line(error)}") from error
        different = sorted(set(wanted) ^ set(shapes)) or [n for n, x in wanted.items() if shapes[n] != x.shape]
        if different:
            raise RunError(f"{where}: checkpoint of another configuration: {different[0]} differs")
        try:
            values = self._manager.restore(step, args=ocp.args.StandardRestore(wanted))
        except Exception as error:
            raise RunError(f"{where}: corrupt or half-written checkpoint: {_one_line(error)}") from error
        return _unflatten(dict(values), template)

    def drop_after(self, step: int) -> None:
        """Delete what is newer than `step`: it was of no use, and will be written again."""
        for newer in self.steps():
            if newer > step:
                self._manager.delete(newer)

    def close(self) -> None:
        """Release the folder."""
        self._manager.close()


def load_latest(
    checkpoints: dict[int, Checkpoints], template: LearnerState, report: Callable[[str], None]
) -> tuple[int, dict[int, LearnerState]]:
    """The newest step that every seed has whole, and the states there; falls back when the newest is corrupt."""
    common = set.intersection(*(set(c.steps()) for c in checkpoints.values()))
    failure = "there is none that all seeds have"
    for step in sorted(common, reverse=True):
        try:
            return step, {seed: c.load(step, template) for seed, c in checkpoints.items()}
        except RunError as error:
            failure = str(error)
            report(f"{failure}; trying an older one")
    folder = next(iter(checkpoints.values())).path
    raise RunError(f"{folder}: no checkpoint to go on from: {failure}")


def open_all(run: RunFolder, seeds: Sequence[int], keep: int = 2) -> dict[int, Checkpoints]:
    """The checkpoints of several seeds."""
    return {seed: Checkpoints(run, seed, keep) for seed in seeds}


def abreast(checkpoints: dict[int, Checkpoints]) -> list[dict[int, Checkpoints]]:
    """Seeds in groups that can go on together, as all of a group have a checkpoint of the same step, or none has any:
    one group, unless a run that several hosts shared is gone on with by fewer, or was killed at its first checkpoint.
    """
    groups: list[tuple[set[int], dict[int, Checkpoints]]] = []
    for seed, each in checkpoints.items():
        steps = set(each.steps())
        for index, (common, members) in enumerate(groups):
            if common & steps or not (common or steps):
                groups[index] = (common & steps, members | {seed: each})
                break
        else:
            groups.append((steps, {seed: each}))
    return [members for _, members in groups]


def exists(run: RunFolder, seeds: Sequence[int]) -> bool:
    """Whether every seed has at least one checkpoint folder with something in it."""
    folders = (pathlib.Path(run.seed_path(seed)) / FOLDER for seed in seeds)
    return all(any(f.glob("[0-9]*")) if f.is_dir() else False for f in folders)


def _flatten(state: Any) -> dict[str, Any]:
    leaves = jax.tree_util.tree_flatten_with_path(state)[0]
    return {jax.tree_util.keystr(path, simple=True, separator="."): _plain(x) for path, x in leaves if x.size}


def _plain(leaf: Any) -> Any:
    """Typed keys as the numbers they hold; arrays as they are."""
    if not jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return leaf if isinstance(leaf, jax.ShapeDtypeStruct) else np.asarray(leaf)
    if isinstance(leaf, jax.ShapeDtypeStruct):
        return jax.eval_shape(jax.random.key_data, leaf)
    return np.asarray(jax.random.key_data(leaf))


def _unflatten(values: dict[str, Any], template: LearnerState) -> LearnerState:
    paths, structure = jax.tree_util.tree_flatten_with_path(template)
    leaves = []
    for path, wanted in paths:
        if not wanted.size:
            leaves.append(jnp.zeros(wanted.shape, wanted.dtype))
            continue
        value = values[jax.tree_util.keystr(path, simple=True, separator=".")]
        is_key = jnp.issubdtype(wanted.dtype, jax.dtypes.prng_key)
        leaves.append(jax.random.wrap_key_data(value) if is_key else value)
    return jax.tree_util.tree_unflatten(structure, leaves)


def _one_line(error: BaseException) -> str:
    text = str(error).strip()
    return text.splitlines()[0][:200] if text else type(error).__name__

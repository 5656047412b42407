"""What `mijax.train` leaves on disk, for every command that reads it: options, seeds, agents."""

import dataclasses
import functools
import sys
from collections.abc import Mapping
from typing import Any, cast

import jax

from mijax import checkpoint, stage1
from mijax.agents.variants import VARIANTS, memory_of, needs_representation
from mijax.config import Config, ConfigError, Stage1Config, config_from_dict, parse_seeds
from mijax.learner import Learner, LearnerState
from mijax.representation.storage import load_representation
from mijax.run_folder import RunError, RunFolder
from mijax.seeds import training_key
from mijax.trackers import TrackerName


@dataclasses.dataclass(frozen=True)
class Training:
    """What a run of `mijax.train` was asked for; config.json holds it."""

    config: Config
    seeds: tuple[int, ...]
    track: TrackerName = "none"

    def as_dict(self) -> dict[str, Any]:
        """The content of config.json: the configuration, its memory named, with the seeds and the tracker."""
        return dataclasses.asdict(self.config) | {
            "memory": memory_of(self.config), "seed_list": list(self.seeds), "track": self.track}


BEFORE_THERE_WAS = (("information", "intrinsic_telescopes", False), ("dqn", "trace_tolerance", 0.0))
"""Options that older runs do not name, and what these runs did, which is not what the option's default does now."""


def training_of(run: RunFolder) -> Training:
    """What a run was asked for.

    Raises:
        RunError: it holds no agent, or one that another program trained.
        ConfigError: its options are not those of this version.
    """
    stored = run.config()
    if "agent" not in stored:
        raise RunError(f"{run.path}: holds representations but no agent")
    if stored["agent"] not in VARIANTS:
        raise RunError(f"{run.path}: its agent {stored['agent']!r} is another program's, accepted: mijax.train's runs")
    seeds, track = stored.pop("seed_list", ()), stored.pop("track", "none")
    for section, option, before in BEFORE_THERE_WAS:
        stored.setdefault(section, {}).setdefault(option, before)
    try:
        return Training(config_from_dict(stored), tuple(seeds), cast(TrackerName, track))
    except ConfigError as error:
        raise ConfigError(f"{run.path / 'config.json'}: {error}") from None


def stage1_in(stored: Mapping[str, Any]) -> Stage1Config:
    """How a run of `mijax.represent` learns features, of its config.json; `ConfigError` as above."""
    return config_from_dict({"stage1": stored.get("stage1", {})}).stage1


def seeds_of(run: RunFolder, text: str | None) -> tuple[int, ...]:
    """Those of a run's seeds that --seeds asks for, all of them by default; `RunError` where one is not there."""
    present = run.seeds()
    seeds = present if text is None else parse_seeds(text)
    missing = [seed for seed in seeds if seed not in present]
    if missing or not seeds:
        named = f"no seed {missing[0]}" if missing else "no seed"
        raise RunError(f"{run.path}: has {named} (it has {', '.join(map(str, present)) or 'none'})")
    return seeds


def seed_of(run: RunFolder, asked: int | None) -> int:
    """The seed of a run that --seed asks for, its first by default; `RunError` where it is not there."""
    return seeds_of(run, None if asked is None else f"{asked},")[0]


def load_learner_state(run: RunFolder, seed: int, learner: Learner) -> tuple[int, LearnerState]:
    """The environment step of a seed's newest whole checkpoint, and the state there."""
    if not checkpoint.exists(run, [seed]):
        raise RunError(f"{run.path}: seed {seed} has no checkpoint" + (
            ", only results" if run.has_results(seed) else " yet"))
    representation = None
    if needs_representation(learner.config):
        representation = load_representation(stage1.folder_of(run, seed), learner.domain)
    template = jax.eval_shape(learner.init, training_key(seed), representation)
    checkpoints = checkpoint.Checkpoints(run, seed)
    step, states = checkpoint.load_latest({seed: checkpoints}, template, functools.partial(print, file=sys.stderr))
    checkpoints.close()
    return step, states[seed]

"""Many seeds at once. A seed follows the same random numbers alone and beside others, bit for bit but under `vmap`.

Every strategy runs the same two functions, `Learner.init` and `Learner.run_chunk`:

* `map`: one compiled program, one seed after the other.
* `shard`: the same, with the seeds dealt out to the devices, which work side by side.
* `vmap`: the seeds of a device in one batched program, all devices side by side; packing is off, since a batched branch
  would run every branch. Dropout and the noise of actions, which are drawn in the shape of the rows, are others then.
  Two branches stay and both run: a robot's episodes are begun at every step, and CarFlag-2D's few frames are encoded
  beside all of them.
"""

import collections
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mijax.config import SeedStrategy
from mijax.learner import Learner, LearnerState
from mijax.types import Metrics, Representation


def resolve(strategy: SeedStrategy, num_seeds: int) -> SeedStrategy:
    """What `auto` means for this machine and this many seeds."""
    if strategy != "auto":
        return strategy
    if num_seeds == 1:
        return "map"
    return "shard" if jax.default_backend() == "cpu" else "vmap"


def training_key(seed: int) -> jax.Array:
    """The key that all of a seed's learning follows from."""
    return jax.random.fold_in(jax.random.key(seed), 2)


def evaluation_key(seed: int, step: int) -> jax.Array:
    """The key of a seed's evaluation at an environment step; it does not touch the learning."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), 3), step)


class SeedRunner:
    """Advances the learners of several seeds in lockstep."""

    def __init__(self, make_learner: Callable[[bool], Learner], seeds: Sequence[int], strategy: SeedStrategy) -> None:
        """Args:
            make_learner: from whether packed rows may be chosen at run time to the learner.
            seeds: which seeds.
            strategy: how; `auto` is resolved here.
        """
        self.seeds = tuple(seeds)
        self.strategy = resolve(strategy, len(self.seeds))
        self._batched = self.strategy == "vmap"
        self.learner = make_learner(not self._batched)
        devices = jax.local_devices()[: 1 if self.strategy == "map" else len(self.seeds)]
        groups = [self.seeds[i :: len(devices)] for i in range(len(devices))] if self._batched else [
            (seed,) for seed in self.seeds]
        self._groups = {group[0]: group for group in groups}  # seeds that are run as one, named by the first of them
        self._device = {first: devices[i % len(devices)] for i, first in enumerate(self._groups)}
        self._pool = ThreadPoolExecutor(len(devices))
        mapped = jax.vmap if self._batched else lambda f: f
        self._mapped = mapped
        self._evaluations: dict[int, Callable] = {}  # by number of episodes
        self._init = jax.jit(mapped(self.learner.init))
        chunk = self.learner.run_chunk
        self._chunk = jax.jit(jax.vmap(chunk, (0, None, None)) if self._batched else chunk, donate_argnums=0)
        self._states: dict[int, LearnerState] = {}  # by group

    def compile(self, template: LearnerState) -> list[jax.stages.Compiled]:
        """Compile the learning program for the devices in use. Without it the first chunk does so, when compiling and a
        full-sized replay need memory at once.

        Args:
            template: shapes of one seed's state.

        Returns:
            What each device runs.
        """
        def work(first: int) -> jax.stages.Compiled:
            several = (len(self._groups[first]),) if self._batched else ()
            sharding = jax.sharding.SingleDeviceSharding(self._device[first])
            state = jax.tree.map(lambda x: x.update(shape=several + x.shape, sharding=sharding), template)
            with jax.default_device(self._device[first]):
                return self._chunk.lower(state, jnp.int32(1), jnp.bool_(True)).compile()

        one_of_each = {device: first for first, device in reversed(self._device.items())}
        return list(self._pool.map(work, sorted(one_of_each.values(), key=self.seeds.index)))

    def init(self, representations: dict[int, Representation] | None) -> None:
        """Start every seed from scratch, each with its own representation."""
        rep = {seed: None if representations is None else representations[seed] for seed in self.seeds}
        keys = {seed: training_key(seed) for seed in self.seeds}
        self._states = self._each(self._init, self._by_group(keys), self._by_group(rep))

    def pretrain(self, report: Callable[[int], None]) -> None:
        """The updates before the first step, on the demonstrations or on the episodes of stage 1. A chunk at a time,
        after which `report` is told how many updates every seed has made."""
        while (left := -self._iteration) > 0:
            self._run(min(left, self.learner.iterations_per_chunk), acts=False)
            report((self.learner.pretrain_iterations + self._iteration) * self.learner.updates_per_iteration)

    def states(self) -> dict[int, LearnerState]:
        """The state of every seed, for a checkpoint."""
        return self._of_each_seed(self._states)

    def restore(self, states: dict[int, LearnerState]) -> None:
        """Go on from the states of a checkpoint, whatever strategy wrote it."""
        grouped = self._by_group(states)
        self._states = {first: jax.device_put(state, self._device[first]) for first, state in grouped.items()}

    @property
    def step(self) -> int:
        """Environment steps that every seed has made."""
        return self.learner.warmup_steps + max(self._iteration, 0) * self.learner.config.iteration_steps

    @property
    def _iteration(self) -> int:
        return int(np.ravel(self._states[self.seeds[0]].iteration)[0])

    @property
    def last_step(self) -> int:
        """Environment steps that every seed will have made at the end of the run: whole chunks after the warm-up."""
        config, warmup = self.learner.config, self.learner.warmup_steps
        chunk = self.learner.iterations_per_chunk * config.iteration_steps
        return warmup + -(-(config.steps - warmup) // chunk) * chunk

    def advance(self) -> dict[int, dict[str, float]]:
        """Run one chunk of every seed; metrics by seed."""
        return self._as_numbers(self._run(self.learner.iterations_per_chunk, acts=True))

    def _run(self, iterations: int, acts: bool) -> dict[int, Metrics]:
        results = self._each(lambda state: self._chunk(state, jnp.int32(iterations), jnp.bool_(acts)), self._states)
        self._states = {first: state for first, (state, _) in results.items()}
        return {first: metrics for first, (_, metrics) in results.items()}

    def evaluate(self, num_episodes: int) -> dict[int, dict[str, float]]:
        """Greedy evaluation of every seed: means over the episodes."""

        def one(state: LearnerState, key: jax.Array) -> Metrics:
            return jax.tree.map(jnp.mean, self.learner.evaluate(state, key, num_episodes))

        program = self._evaluations.setdefault(num_episodes, jax.jit(self._mapped(one)))
        keys = self._by_group({seed: evaluation_key(seed, self.step) for seed in self.seeds})
        return self._as_numbers(self._each(program, self._states, keys))

    def environment_seconds(self) -> float:
        """Seconds in which the whole run, all seeds, acted, stepped and stored: timed on one chunk of the first,
        for as many of its kind as the busiest device runs one after the other."""
        def stored(state: LearnerState) -> Any:
            # All of the replay is looked at, or XLA would leave its writing out.
            return jax.tree.map(total, self.learner.collect_chunk(state))

        def total(x: jax.Array) -> jax.Array:
            return jnp.sum(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)

        seed = self.seeds[0]
        program = jax.jit(self._mapped(stored))
        seconds = []
        for _ in range(2):  # the first time compiles
            started = time.perf_counter()
            jax.block_until_ready(program(self._states[seed]))
            seconds.append(time.perf_counter() - started)
        chunks = self.step / self.learner.config.evaluation.every
        return seconds[-1] * chunks * max(collections.Counter(self._device.values()).values())

    def _by_group(self, by_seed: dict[int, Any]) -> dict[int, Any]:
        """Of each seed, or of each group of batched seeds with a leading axis for them."""
        if not self._batched:
            return dict(by_seed)
        return {first: jax.tree.map(lambda *x: jnp.stack(x), *(by_seed[seed] for seed in group))
                for first, group in self._groups.items()}

    def _of_each_seed(self, by_group: dict[int, Any]) -> dict[int, Any]:
        """`_by_group` undone."""
        if not self._batched:
            return dict(by_group)
        found = {seed: jax.tree.map(lambda x, i=i: x[i], by_group[first])
                 for first, group in self._groups.items() for i, seed in enumerate(group)}
        return {seed: found[seed] for seed in self.seeds}

    def _each(self, function: Callable, *by_group: dict[int, Any]) -> dict[int, Any]:
        """Apply to every group on its device; devices work side by side, the groups of one device in order."""

        def work(device: Any) -> dict[int, Any]:
            results = {}
            with jax.default_device(device):
                for first in (name for name in by_group[0] if self._device[name] == device):
                    arguments = (jax.device_put(values[first], device) for values in by_group)
                    results[first] = jax.block_until_ready(function(*arguments))
            return results

        done = self._pool.map(work, dict.fromkeys(self._device[first] for first in by_group[0]))
        merged = {first: result for part in done for first, result in part.items()}
        return {first: merged[first] for first in by_group[0]}

    def _as_numbers(self, metrics: dict[int, Metrics]) -> dict[int, dict[str, float]]:
        """By seed."""
        return {seed: {name: float(value) for name, value in own.items()}
                for seed, own in self._of_each_seed(jax.device_get(metrics)).items()}

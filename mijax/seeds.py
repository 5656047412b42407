"""Many seeds at once. A seed follows the same random numbers alone and beside others, bit for bit but under `vmap`.

Every strategy runs the same two functions, `Learner.init` and `Learner.run_chunk`:

* `map`: one compiled program, one seed after the other.
* `shard`: the same, with the seeds dealt out to the devices, which work side by side.
* `vmap`: one program batched over the seeds; packing is off, since a batched branch would run every branch. Dropout
  and the noise of actions, which are drawn in the shape of the rows, are others then. Two branches stay and both run:
  a robot's episodes are begun at every step, and CarFlag-2D's few frames are encoded beside all of them.
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
        self.learner = make_learner(self.strategy != "vmap")
        devices = jax.local_devices() if self.strategy == "shard" else jax.local_devices()[:1]
        self._device = {seed: devices[i % len(devices)] for i, seed in enumerate(self.seeds)}
        self._pool = ThreadPoolExecutor(len(set(self._device.values())))
        mapped = jax.vmap if self.strategy == "vmap" else lambda f: f
        self._mapped = mapped
        self._evaluations: dict[int, Callable] = {}  # by number of episodes
        self._init = jax.jit(mapped(self.learner.init))
        chunk = self.learner.run_chunk
        self._chunk = jax.jit(jax.vmap(chunk, (0, None, None)) if self.strategy == "vmap" else chunk, donate_argnums=0)
        self._states: dict[int, LearnerState] = {}  # by seed; under vmap one state of all, stored by the first seed

    def compile(self, template: LearnerState) -> None:
        """Compile the learning program for the devices in use. Without it the first chunk does so, when compiling and a
        full-sized replay need memory at once.

        Args:
            template: shapes of one seed's state.
        """
        several = (len(self.seeds),) if self.strategy == "vmap" else ()

        def work(device: Any) -> None:
            sharding = jax.sharding.SingleDeviceSharding(device)
            state = jax.tree.map(lambda x: x.update(shape=several + x.shape, sharding=sharding), template)
            with jax.default_device(device):
                self._chunk.lower(state, jnp.int32(1), jnp.bool_(True)).compile()

        list(self._pool.map(work, dict.fromkeys(self._device.values())))

    def init(self, representations: dict[int, Representation] | None) -> None:
        """Start every seed from scratch, each with its own representation."""
        rep = {seed: None if representations is None else representations[seed] for seed in self.seeds}
        keys = {seed: training_key(seed) for seed in self.seeds}
        if self.strategy == "vmap":
            keys, rep = self._stack(keys), self._stack(rep)
        self._states = self._each(lambda key, rep: self._init(key, rep), keys, rep)

    def pretrain(self, report: Callable[[int], None]) -> None:
        """Updates on the demonstrations, where there are any: up to the first step. A chunk at a time, after which
        `report` is told how many updates every seed has made."""
        while (left := -self._iteration) > 0:
            self._run(min(left, self.learner.iterations_per_chunk), acts=False)
            report((self.learner.pretrain_iterations + self._iteration) * self.learner.updates_per_iteration)

    def states(self) -> dict[int, LearnerState]:
        """The state of every seed, for a checkpoint."""
        if self.strategy != "vmap":
            return dict(self._states)
        stacked = self._states[self.seeds[0]]
        return {seed: jax.tree.map(lambda x, i=i: x[i], stacked) for i, seed in enumerate(self.seeds)}

    def restore(self, states: dict[int, LearnerState]) -> None:
        """Go on from the states of a checkpoint, whatever strategy wrote it."""
        states = self._stack(states) if self.strategy == "vmap" else states
        self._states = {seed: jax.device_put(state, self._device[seed]) for seed, state in states.items()}

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
        return self._by_seed(self._run(self.learner.iterations_per_chunk, acts=True))

    def _run(self, iterations: int, acts: bool) -> dict[int, Metrics]:
        results = self._each(lambda state: self._chunk(state, jnp.int32(iterations), jnp.bool_(acts)), self._states)
        self._states = {seed: state for seed, (state, _) in results.items()}
        return {seed: metrics for seed, (_, metrics) in results.items()}

    def evaluate(self, num_episodes: int) -> dict[int, dict[str, float]]:
        """Greedy evaluation of every seed: means over the episodes."""

        def one(state: LearnerState, key: jax.Array) -> Metrics:
            return jax.tree.map(jnp.mean, self.learner.evaluate(state, key, num_episodes))

        program = self._evaluations.setdefault(num_episodes, jax.jit(self._mapped(one)))
        keys = {seed: evaluation_key(seed, self.step) for seed in self.seeds}
        keys = self._stack(keys) if self.strategy == "vmap" else keys
        return self._by_seed(self._each(program, self._states, keys))

    def environment_seconds(self) -> float:
        """Seconds in which the whole run, all seeds, acted, stepped and stored: timed on one chunk of the first seed,
        for as many as the busiest device has."""
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
        on_one_device = max(collections.Counter(self._device.values()).values())
        return seconds[-1] * chunks * (1 if self.strategy == "vmap" else on_one_device)

    def _stack(self, by_seed: dict[int, Any]) -> dict[int, Any]:
        return {self.seeds[0]: jax.tree.map(lambda *x: jnp.stack(x), *(by_seed[seed] for seed in self.seeds))}

    def _each(self, function: Callable, *by_seed: dict[int, Any]) -> dict[int, Any]:
        """Apply to every seed on its device; devices work side by side, the seeds of one device in order."""

        def work(device: Any) -> dict[int, Any]:
            results = {}
            with jax.default_device(device):
                for seed in (s for s in by_seed[0] if self._device[s] == device):
                    arguments = (jax.device_put(values[seed], device) for values in by_seed)
                    results[seed] = jax.block_until_ready(function(*arguments))
            return results

        done = self._pool.map(work, dict.fromkeys(self._device[seed] for seed in by_seed[0]))
        merged = {seed: result for part in done for seed, result in part.items()}
        return {seed: merged[seed] for seed in by_seed[0]}

    def _by_seed(self, metrics: dict[int, Metrics]) -> dict[int, dict[str, float]]:
        if self.strategy == "vmap":
            stacked = jax.device_get(metrics[self.seeds[0]])
            return {seed: {k: float(v[i]) for k, v in stacked.items()} for i, seed in enumerate(self.seeds)}
        return {seed: {k: float(v) for k, v in jax.device_get(m).items()} for seed, m in metrics.items()}

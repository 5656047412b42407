"""Choosing the loss weights of stage 1 by measurement: many at once, each judged by the probe.

The paper iterates by hand between tuning and its overlap test (Section 7, Limitations); this does it without knowing
its Table 3. Letters: C candidates, S seeds, M = C S members.
"""

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, PartitionSpec

from envs_mjx.base import Environment
from mijax.config import Stage1Config
from mijax.representation.dataset import Transitions, collect
from mijax.representation.probe import ProbeReport, probe, probe_on
from mijax.representation.problem import Problem
from mijax.representation.train import (
    CONSTANT,
    DivergenceError,
    History,
    LossWeights,
    TrainState,
    initial_state,
    learn_representation,
    make_epoch,
    representation_of,
)
from mijax.types import Metrics, Representation

RANGES = {
    "lambda_r": (1.0, 30.0), "lambda_s": (1.0, 1.0), "lambda_o": (0.03, 3.0), "lambda_club": (0.1, 10.0),
    "lambda_dim_s": (0.01, 0.3), "lambda_dim_o": (0.1, 3.0), "phi_shrinkage": (0.03, 0.15),
}
"""Where candidates are drawn, evenly on a logarithmic scale. Adam makes losses alike up to a factor: lambda_s is the
unit."""
FIRST_ROUND, KEPT = 1 / 3, 1 / 4
"""On Heaven-Hell (16 candidates, one seed) 4 pass if all are trained to the end; 2 of these are among the 4 that are
kept after a third of the epochs."""
CLEAN = 1e-14
"""A fraction of the variance of z_s that is as good as none. Far below what the probe sees, since a margin is what
makes weights hold for other seeds: on Heaven-Hell those that left 5e-15 passed with 5 of 5 seeds afterwards, those that
left 2e-9, as good by the probe, with 3 of 5."""
CONFIRMATIONS = 3
"""Further seeds that weights have to pass with: on Heaven-Hell the best of 16, which had passed with the search's one
seed, passed with 3 of 5 afterwards."""
Weights = dict[str, float]
"""Values of `Stage1Config` fields, by name."""
ProgressCallback = Callable[[int, dict[str, float]], None]
VerdictCallback = Callable[[Weights, int, bool], None]
"""Called with weights, a seed, and whether the weights pass with it."""


@dataclasses.dataclass(frozen=True)
class Candidate:
    """One weighting and what the probe found, by seed; None where training diverged."""

    weights: Weights
    reports: dict[int, ProbeReport | None]
    epochs: int
    """How long it was trained: a candidate that was given up has fewer epochs, and linear probes alone."""
    representations: dict[int, Representation]
    """Empty when it was given up."""
    confirmed: tuple[bool, ...] = ()
    """Whether it passes with further seeds, one after the other up to the first failure; empty when it was not tried.
    """

    @property
    def passed(self) -> int:
        """Seeds that pass P1 and P2."""
        return sum(report is not None and report.p1 and report.p2 for report in self.reports.values())

    @property
    def quality(self) -> float:
        """In [0, 1], of the worst seed: tells apart candidates that pass, and candidates that do not, alike."""
        return min((quality(report) for report in self.reports.values()), default=0.0)


@dataclasses.dataclass(frozen=True)
class SearchResult:
    """All candidates, the best first, and the seconds they took together."""

    candidates: tuple[Candidate, ...]
    seconds: float

    @property
    def best(self) -> Candidate:
        """The one to keep."""
        return self.candidates[0]

    def as_dict(self) -> dict[str, Any]:
        """For search.json."""
        return {"seconds": self.seconds, "candidates": [
            {"weights": candidate.weights, "epochs": candidate.epochs, "passed": candidate.passed,
             "quality": candidate.quality, "confirmed": list(candidate.confirmed),
             "probes": {str(seed): None if report is None else report.as_dict()
                        for seed, report in candidate.reports.items()}}
            for candidate in self.candidates]}


def quality(report: ProbeReport | None) -> float:
    """In [0, 1]: z_s holds what is hidden, rewards are predicted, and z_s holds nothing else.

    The last is counted in decades of the variance of z_s, down to `CLEAN`: a leak shrinks by decades long before it
    passes the probe, which sees leaks of any size.
    """
    if report is None:
        return 0.0
    decades = -np.log10(max(1 - report.geometry["hidden_share"], CLEAN)) / -np.log10(CLEAN)
    return float(report.hidden * max(0.0, report.errors.get("reward_r2", 1.0)) * max(0.0, decades))


def draw_candidates(config: Stage1Config, count: int, seed: int = 0) -> list[Weights]:
    """`count` weightings that fill `RANGES` evenly: each range is cut into `count` parts, and each part taken once.

    A DIM weight that is 0 in `config` stays 0, so that its loss need not be computed.
    """
    generator = np.random.default_rng(seed)
    columns = {}
    for name, (low, high) in RANGES.items():
        part = (generator.permutation(count) + generator.uniform(size=count)) / count
        off = name.startswith("lambda_dim") and getattr(config, name) == 0
        columns[name] = np.zeros(count) if off else low * (high / low) ** part
    return [{name: float(f"{column[i]:.3g}") for name, column in columns.items()} for i in range(count)]


def search(
    env: Environment, config: Stage1Config, candidates: Sequence[Weights], keys: dict[int, jax.Array],
    on_progress: ProgressCallback | None = None
) -> SearchResult:
    """Train every candidate with every seed, in one compiled program and on the same data, and probe them.

    After `FIRST_ROUND` of the epochs only the best `KEPT` of the candidates go on, under the same schedule of step
    sizes: C candidates cost 1/3 + 2/3 * 1/4 = 1/2 of C trainings.

    Args:
        env: the environment.
        config: all but the weights.
        candidates: the weightings.
        keys: by seed, the key that its stage 1 follows from. Seeds differ in their first parameters; data and the order
            of batches are the first one's, so that a candidate with the first seed is that seed's ordinary stage 1.
        on_progress: called after each epoch with its number and the means of the losses.
    """
    started = time.perf_counter()
    configs = [dataclasses.replace(config, **weights) for weights in candidates]
    largest = {name: max(getattr(c, name) for c in configs) for name in ("lambda_dim_s", "lambda_dim_o")}
    first_key = next(iter(keys.values()))
    data_key, _, train_key = jax.random.split(first_key, 3)
    data = collect(env, data_key, config.episodes, config.data)
    problem = Problem.of(env, dataclasses.replace(config, **largest), data)
    heldout_key, probe_key = jax.random.split(jax.random.fold_in(first_key, 3))
    heldout = collect(env, heldout_key, config.heldout_episodes, config.data, moved=config.copies > 0)
    init_keys = jnp.stack([jax.random.split(key, 3)[1] for key in keys.values()])
    group = _Group(
        list(range(len(configs))), _stack([LossWeights.of(c) for c in configs for _ in keys]),
        jax.jit(jax.vmap(functools.partial(initial_state, problem)))(jnp.tile(init_keys, len(configs))), {})
    results: dict[int, Candidate] = {}
    halfway = max(1, round(config.epochs * FIRST_ROUND))
    for start, end in ((0, halfway), (halfway, config.epochs)):
        program = map_members(make_epoch(problem), len(group.numbers) * len(keys))
        for epoch in range(start + 1, end + 1):
            group.states, group.metrics = program(group.weights, group.states, jax.random.fold_in(train_key, epoch))
            if on_progress is not None:
                on_progress(epoch, _means(group.metrics))
        final = end == config.epochs
        found = _probe_all(env, problem, group, heldout, probe_key if final else None)
        for place, number in enumerate(group.numbers):
            own = dict(zip(keys, found[place * len(keys) : (place + 1) * len(keys)], strict=True))
            results[number] = Candidate(
                dict(candidates[number]), {seed: report for seed, (_, report) in own.items()}, end,
                {seed: representation for seed, (representation, _) in own.items()} if final else {})
        if final:
            break
        best = sorted(group.numbers, key=lambda number: results[number].quality, reverse=True)
        group = group.keep(best[: math.ceil(len(configs) * KEPT)], len(keys))
    ranked = sorted(results.values(), key=lambda c: (c.epochs, c.passed, c.quality), reverse=True)
    return SearchResult(tuple(ranked), time.perf_counter() - started)


def confirm(
    env: Environment, config: Stage1Config, result: SearchResult, keys: dict[int, jax.Array],
    on_verdict: VerdictCallback
) -> SearchResult:
    """Try the candidates that passed with further seeds, the best first, until one passes with all of them.

    What passes with one seed may do so by luck. Each further seed is an ordinary stage 1, data and all, and a candidate
    is left at its first failure.

    Args:
        env: the environment.
        config: all but the weights.
        result: of `search`.
        keys: by further seed, the key that its stage 1 follows from.
        on_verdict: called after each training.

    Returns:
        The candidates, those that pass with more further seeds first, and otherwise as they were.
    """
    started = time.perf_counter()
    candidates = list(result.candidates)
    for place, candidate in enumerate(candidates):
        if candidate.representations and candidate.passed == len(candidate.reports):
            verdicts = []
            for seed, key in keys.items():
                verdicts.append(_passes(env, dataclasses.replace(config, **candidate.weights), key))
                on_verdict(candidate.weights, seed, verdicts[-1])
                if not verdicts[-1]:
                    break
            candidates[place] = dataclasses.replace(candidate, confirmed=tuple(verdicts))
            if all(verdicts):
                break
    ranked = sorted(candidates, key=lambda candidate: sum(candidate.confirmed), reverse=True)
    return SearchResult(tuple(ranked), result.seconds + time.perf_counter() - started)


def _passes(env: Environment, config: Stage1Config, key: jax.Array) -> bool:
    """Whether stage 1 from `key` passes P1 and P2."""
    try:
        representation, history = learn_representation(env, config, key, starts=1)
    except DivergenceError:
        return False
    report = probe(representation, env, config, jax.random.fold_in(key, 3), history)
    jax.clear_caches()  # as in `mijax.stage1.learn`
    return report.p1 and report.p2


@dataclasses.dataclass
class _Group:
    """The candidates that are still trained: their members lie side by side, the seeds of a candidate together."""

    numbers: list[int]
    weights: LossWeights  # leaves (M,)
    states: TrainState  # leaves (M, ...)
    metrics: Metrics  # (M,) each

    def keep(self, numbers: list[int], seeds: int) -> "_Group":
        """The members of some candidates."""
        rows = np.concatenate([self.numbers.index(n) * seeds + np.arange(seeds) for n in numbers])
        pick = functools.partial(jax.tree.map, lambda x: x[rows])
        return _Group(numbers, pick(self.weights), pick(self.states), pick(self.metrics))


def map_members(
    epoch: Callable, count: int
) -> Callable[[LossWeights, TrainState, jax.Array], tuple[TrainState, Metrics]]:
    """One compiled program for (M,) members: batched on an accelerator; on a CPU, one after the other on each device.

    A matrix product batched over weights is slow on a CPU: on Heaven-Hell 16 members took 18.2 times as long as one
    when batched and 14.0 times in turn (one core).
    """
    if jax.default_backend() != "cpu":
        return jax.jit(jax.vmap(epoch, in_axes=(0, 0, None)), donate_argnums=1)

    def in_turn(weights: LossWeights, states: TrainState, key: jax.Array) -> tuple[TrainState, Metrics]:
        return jax.lax.map(lambda member: epoch(*member, key), (weights, states))

    devices = max(d for d in range(1, len(jax.local_devices()) + 1) if count % d == 0)
    if devices == 1:
        return jax.jit(in_turn, donate_argnums=1)
    mesh = jax.make_mesh((devices,), ("members",), axis_types=(AxisType.Auto,))
    over, same = PartitionSpec("members"), PartitionSpec()
    return jax.jit(jax.shard_map(in_turn, mesh=mesh, in_specs=(over, over, same), out_specs=over, check_vma=False),
                   donate_argnums=1)


def _stack(weights: Sequence[LossWeights]) -> LossWeights:
    return jax.tree.map(lambda *values: jnp.asarray(values, jnp.float32), *weights)


def _means(metrics: Metrics) -> dict[str, float]:
    """Over the members that have not diverged; the total is left out, since its weights differ."""
    return {name: float(jnp.nanmean(value)) for name, value in metrics.items() if name != "loss"}


def _probe_all(
    env: Environment, problem: Problem, group: _Group, heldout: Transitions, key: jax.Array | None
) -> list[tuple[Representation, ProbeReport | None]]:
    """Every member's representation and what the probe says of it; without a key, linear probes alone."""
    metrics, states = jax.device_get((group.metrics, group.states))
    found = []
    for member in range(len(metrics["loss"])):
        state = jax.tree.map(lambda value, member=member: jnp.asarray(value[member]), states)
        representation, report = representation_of(problem, state), None
        if np.isfinite(metrics["loss"][member]) and representation.z_s_variance >= CONSTANT:
            history = History(
                metrics={}, dynamics=state.parameters["dynamics"], estimator=state.estimator.parameters,
                estimator_view=problem.config.estimator_view, updates=0,
                compile_seconds=0.0, seconds=0.0)
            report = probe_on(heldout, representation, env, jax.random.key(0) if key is None else key, history,
                              networks=key is not None)
        found.append((representation, report))
    return found

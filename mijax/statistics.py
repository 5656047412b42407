"""Statistics over seeds: what a few runs tell about an algorithm (Agarwal et al., 2021). Plain NumPy."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

Array = np.ndarray

ROUND_OFF = 1e-6
"""Of numbers that were float32: 19 successes of 20 are recorded as 0.94999999."""
_BLOCK_ELEMENTS = 4_000_000
"""Numbers resampled at once, to bound the memory of long curves (32 MB)."""


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A number and its interval, or arrays of them."""

    value: Array
    low: Array
    high: Array

    def __post_init__(self) -> None:
        if not np.shape(self.value) == np.shape(self.low) == np.shape(self.high):
            raise ValueError("an estimate and its interval differ in shape")


def mean_std(scores: Array, axis: int = 0) -> tuple[Array, Array]:
    """Mean and standard deviation over runs, the latter of the sample (n - 1), 0 for a single run."""
    scores = _floats(scores)
    ddof = 1 if scores.shape[axis] > 1 else 0
    return scores.mean(axis), scores.std(axis, ddof=ddof)


def interquartile_mean(scores: Array, axis: int = 0) -> Array:
    """Mean of the middle half: floor(n / 4) scores are cut from each end, none of fewer than four."""
    scores = np.sort(_floats(scores), axis=axis)
    num = scores.shape[axis]
    cut = num // 4
    return np.take(scores, np.arange(cut, num - cut), axis=axis).mean(axis)


def bootstrap(scores: Array, statistic: Callable[[Array], Array], *, resamples: int = 2000, confidence: float = 0.95,
              seed: int = 0) -> Estimate:
    """Percentile interval of a statistic of the scores of several tasks, each task's runs resampled on their own.

    Args:
        scores: (num_runs, num_tasks).
        statistic: (resamples, num_runs, num_tasks) -> (resamples,).
        resamples: how many times the runs are drawn anew, with replacement.
        confidence: the share of resamples inside the interval.
        seed: of the draws.
    """
    scores = _floats(scores)
    if scores.ndim != 2:
        raise ValueError(f"scores: got shape {scores.shape}, accepted: (num_runs, num_tasks)")
    num_runs, num_tasks = scores.shape
    draws = np.random.default_rng(seed).integers(num_runs, size=(resamples, num_runs, num_tasks))
    samples = statistic(scores[draws, np.arange(num_tasks)])
    return Estimate(statistic(scores[None])[0], *_percentiles(samples, confidence))


def interquartile_mean_interval(scores: Array, **options: float) -> Estimate:
    """Interquartile mean over all runs and tasks, with its stratified bootstrap interval; see `bootstrap`."""
    return bootstrap(scores, lambda drawn: interquartile_mean(drawn.reshape(len(drawn), -1), axis=1),
                     **options)  # pyright: ignore[reportArgumentType]


def interquartile_mean_curve(values: Array, *, resamples: int = 2000, confidence: float = 0.95,
                             seed: int = 0) -> Estimate:
    """The interquartile mean over runs at each point of their curves, with a bootstrap interval at each.

    Args:
        values: (num_runs, num_points).
        resamples: how many times whole curves are drawn anew, with replacement.
        confidence: the share of resamples inside the interval.
        seed: of the draws.
    """
    values = _floats(values)
    num_runs, num_points = values.shape
    draws = np.random.default_rng(seed).integers(num_runs, size=(resamples, num_runs))
    block = max(1, _BLOCK_ELEMENTS // draws.size)
    intervals = [_percentiles(interquartile_mean(values[:, start:start + block][draws], axis=1), confidence)
                 for start in range(0, num_points, block)]
    low, high = (np.concatenate(parts) for parts in zip(*intervals, strict=True))
    return Estimate(interquartile_mean(values), low, high)


def probability_of_improvement(ours: Array, theirs: Array, *, resamples: int = 2000, confidence: float = 0.95,
                               seed: int = 0) -> Estimate:
    """How likely a run of ours scores above one of theirs, ties counting half (Mann-Whitney), with its interval.

    Args:
        ours: (num_runs,) scores.
        theirs: (num_other_runs,) scores.
        resamples: how many times the runs of both are drawn anew, with replacement.
        confidence: the share of resamples inside the interval.
        seed: of the draws.
    """
    ours, theirs = _floats(ours), _floats(theirs)
    above = (np.sign(ours[:, None] - theirs[None, :]) + 1) / 2
    generator = np.random.default_rng(seed)
    rows = generator.integers(len(ours), size=(resamples, len(ours), 1))
    columns = generator.integers(len(theirs), size=(resamples, 1, len(theirs)))
    return Estimate(above.mean(), *_percentiles(above[rows, columns].mean((1, 2)), confidence))


def steps_to_threshold(steps: Sequence[int], values: Sequence[float], threshold: float) -> int | None:
    """The first of `steps` whose value reaches `threshold`, up to float32's round-off; None when none does."""
    return next((int(step) for step, value in zip(steps, values, strict=True) if value >= threshold - ROUND_OFF), None)


def running_mean(values: Array, window: int) -> Array:
    """At each point, the mean of the last `window` values up to it, of fewer at the start."""
    if window == 1:
        return _floats(values)
    sums = np.concatenate([[0.0], np.cumsum(_floats(values))])
    ends = np.arange(1, len(sums))
    starts = np.maximum(ends - window, 0)
    return (sums[ends] - sums[starts]) / (ends - starts)


def onto_shared_steps(curves: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Put curves that were measured at different steps on one axis, by linear interpolation, without extrapolation.

    Args:
        curves: the (steps, values) of each run, steps rising.

    Returns:
        (num_points,) all steps that lie within every curve, and (num_runs, num_points) the values there.
    """
    first = max(steps[0] for steps, _ in curves)
    last = min(steps[-1] for steps, _ in curves)
    shared = np.unique(np.concatenate([steps for steps, _ in curves]))
    shared = shared[(shared >= first) & (shared <= last)]
    return shared, np.stack([np.interp(shared, steps, values) for steps, values in curves])


def _floats(scores: Array) -> Array:
    scores = np.asarray(scores, np.float64)
    if scores.size == 0:
        raise ValueError("no scores to summarise")
    return scores


def _percentiles(samples: Array, confidence: float) -> tuple[Array, Array]:
    """Over the first axis."""
    low, high = np.percentile(samples, [50 * (1 - confidence), 50 * (1 + confidence)], axis=0)
    return low, high

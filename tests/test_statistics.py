"""Statistics against SciPy, closed forms and counting by hand."""

import hypothesis
import hypothesis.extra.numpy as arrays
import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.stats

from mijax import statistics

SCORES = arrays.arrays(np.float64, arrays.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=12),
                       elements=st.floats(-100, 100))


@hypothesis.settings(deadline=None)
@hypothesis.given(SCORES)
def test_interquartile_mean_is_scipys_trimmed_mean(scores):
    np.testing.assert_allclose(statistics.interquartile_mean(scores), scipy.stats.trim_mean(scores, 0.25), atol=1e-9)
    np.testing.assert_allclose(statistics.interquartile_mean(scores, axis=1),
                               scipy.stats.trim_mean(scores, 0.25, axis=1), atol=1e-9)


def test_interquartile_mean_ignores_the_outer_quarters():
    assert statistics.interquartile_mean(np.array([1e9, 2.0, 4.0, -1e9])) == 3.0
    assert statistics.interquartile_mean(np.array([0.0, 1.0, 5.0])) == 2.0


def test_mean_std():
    mean, std = statistics.mean_std(np.array([[1.0, 0.0], [3.0, 0.0]]))
    np.testing.assert_allclose(mean, [2.0, 0.0])
    np.testing.assert_allclose(std, [np.sqrt(2), 0.0])
    mean, std = statistics.mean_std(np.array([0.7]))
    assert (mean, std) == (0.7, 0.0)


def test_bootstrap_interval_of_a_mean_is_the_normal_one():
    scores = np.random.default_rng(1).normal(5.0, 2.0, size=(400, 1))
    estimate = statistics.bootstrap(scores, lambda drawn: drawn.mean((1, 2)), resamples=4000)
    half = 1.96 * scores.std() / np.sqrt(400)
    np.testing.assert_allclose([estimate.low, estimate.high], scores.mean() + np.array([-half, half]), atol=0.02)
    assert estimate.value == scores.mean()


def test_bootstrap_is_stratified():
    scores = np.array([[0.0, 10.0]] * 6)  # tasks differ, runs do not: resampling within a task changes nothing
    estimate = statistics.interquartile_mean_interval(scores)
    assert estimate.low == estimate.value == estimate.high == 5.0


def test_curve_interval_is_the_interval_at_each_point(monkeypatch):
    values = np.random.default_rng(2).normal(size=(5, 7))
    whole = statistics.interquartile_mean_curve(values)
    monkeypatch.setattr(statistics, "_BLOCK_ELEMENTS", 20_000)  # two points at a time
    in_blocks = statistics.interquartile_mean_curve(values)
    np.testing.assert_array_equal(whole.low, in_blocks.low)
    for point in range(7):
        one = statistics.interquartile_mean_interval(values[:, point, None])
        np.testing.assert_allclose([whole.value[point], whole.low[point], whole.high[point]],
                                   [one.value, one.low, one.high])


def test_one_run_has_an_interval_of_no_width():
    estimate = statistics.interquartile_mean_curve(np.array([[0.1, 0.9]]))
    np.testing.assert_array_equal(estimate.low, [0.1, 0.9])
    np.testing.assert_array_equal(estimate.high, [0.1, 0.9])


@hypothesis.given(arrays.arrays(np.float64, st.integers(1, 8), elements=st.integers(0, 5)),
                  arrays.arrays(np.float64, st.integers(1, 8), elements=st.integers(0, 5)))
@hypothesis.settings(deadline=None)
def test_probability_of_improvement_is_mann_whitneys_u(ours, theirs):
    estimate = statistics.probability_of_improvement(ours, theirs, resamples=50)
    u = scipy.stats.mannwhitneyu(ours, theirs, method="asymptotic" if len({*ours, *theirs}) > 1 else "exact").statistic
    assert estimate.value == pytest.approx(u / (len(ours) * len(theirs)))
    assert 0 <= estimate.low <= estimate.high <= 1


def test_steps_to_threshold():
    assert statistics.steps_to_threshold([10, 20, 30], [0.1, 0.95, 0.2], 0.95) == 20
    assert statistics.steps_to_threshold([10, 20, 30], [0.1, 0.9, 0.2], 0.95) is None
    assert statistics.steps_to_threshold([10, 20], [0.9, float(np.float32(19) / np.float32(20))], 0.95) == 20
    with pytest.raises(ValueError, match="shorter"):
        statistics.steps_to_threshold([10, 20], [0.1], 0.95)


def test_running_mean():
    np.testing.assert_allclose(statistics.running_mean(np.array([1.0, 3.0, 5.0, 10.0]), 3), [1, 2, 3, 6])
    np.testing.assert_array_equal(statistics.running_mean(np.array([0.1, 0.2]), 1), [0.1, 0.2])


def test_onto_shared_steps():
    first = (np.array([10, 20, 30, 40]), np.array([1.0, 2.0, 3.0, 4.0]))
    second = (np.array([15, 35]), np.array([0.0, 20.0]))
    steps, values = statistics.onto_shared_steps([first, second])
    np.testing.assert_array_equal(steps, [15, 20, 30, 35])
    np.testing.assert_allclose(values, [[1.5, 2.0, 3.0, 3.5], [0.0, 5.0, 15.0, 20.0]])


def test_onto_shared_steps_leaves_matching_curves_alone():
    steps = np.arange(5) * 1000
    curves = [(steps, np.random.default_rng(seed).normal(size=5)) for seed in range(3)]
    shared, values = statistics.onto_shared_steps(curves)
    np.testing.assert_array_equal(shared, steps)
    np.testing.assert_array_equal(values, [curve for _, curve in curves])


def test_empty_scores_are_named():
    with pytest.raises(ValueError, match="no scores"):
        statistics.interquartile_mean(np.zeros(0))
    with pytest.raises(ValueError, match="num_runs, num_tasks"):
        statistics.bootstrap(np.zeros(3), lambda drawn: drawn[:, 0, 0])

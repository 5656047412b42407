"""The losses of stage 1 against loops written independently and against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mijax.losses.club import club_all_pairs, club_sampled, gaussian_fit, gaussian_log_density
from mijax.losses.dim import dim_jensen_shannon
from mijax.losses.dynamics import next_feature_loss, reward_loss
from mijax.losses.variables import variables_loss


def _random(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def _log_density(x: np.ndarray, mean: np.ndarray, log_variance: np.ndarray) -> float:
    variance = np.exp(log_variance)
    return float(np.sum(-0.5 * (x - mean) ** 2 / variance - 0.5 * np.log(2 * np.pi * variance)))


@pytest.fixture
def gaussians() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return _random(7, 3), _random(7, 3, seed=1), 0.5 * _random(7, 3, seed=2)


def test_club_over_all_pairs_is_the_double_loop_of_eq_7(gaussians):
    z, mean, log_variance = gaussians
    expected = np.mean([[_log_density(z[i], mean[i], log_variance[i]) - _log_density(z[j], mean[i], log_variance[i])
                         for j in range(7)] for i in range(7)])
    np.testing.assert_allclose(club_all_pairs(*map(jnp.asarray, gaussians))[0], expected, rtol=1e-5)


def test_weighted_rows_are_repeated_rows(gaussians):
    repeats = np.array([1, 3, 0, 2, 1, 1, 2])
    weight = jnp.asarray(repeats / repeats.sum(), jnp.float32)
    rows = tuple(jnp.asarray(a) for a in gaussians)
    repeated = tuple(jnp.asarray(np.repeat(a, repeats, axis=0)) for a in gaussians)
    for loss in (club_all_pairs, gaussian_fit):
        np.testing.assert_allclose(loss(rows[0], rows[1], rows[2], weight)[0],
                                   loss(repeated[0], repeated[1], repeated[2])[0], rtol=1e-5)
    r, terminal = jnp.asarray(gaussians[0][:, 0]), jnp.arange(7) % 3 == 0
    ends = jnp.asarray(np.repeat(np.asarray(terminal), repeats))
    np.testing.assert_allclose(reward_loss(rows[1][:, 0], r, weight)[0],
                               reward_loss(repeated[1][:, 0], repeated[0][:, 0])[0], rtol=1e-5)
    np.testing.assert_allclose(next_feature_loss(rows[0], rows[1], terminal, weight)[0],
                               next_feature_loss(repeated[0], repeated[1], ends)[0], rtol=1e-5)


def test_gaussian_fit_is_the_negative_log_likelihood(gaussians):
    expected = -np.mean([_log_density(*row) for row in zip(*gaussians, strict=True)])
    np.testing.assert_allclose(gaussian_fit(*map(jnp.asarray, gaussians))[0], expected, rtol=1e-5)


def test_sampled_club_is_the_loop_and_averages_to_all_pairs(gaussians):
    z, mean, log_variance = gaussians
    arrays = jnp.asarray(z), jnp.asarray(mean), jnp.asarray(log_variance)
    shifts = [club_sampled(*arrays, jnp.roll(jnp.arange(7), k))[0] for k in range(7)]
    expected = np.mean([_log_density(z[i], mean[i], log_variance[i])
                        - _log_density(z[(i - 2) % 7], mean[i], log_variance[i]) for i in range(7)])
    np.testing.assert_allclose(shifts[2], expected, rtol=1e-5)
    np.testing.assert_allclose(np.mean(shifts), club_all_pairs(*arrays)[0], rtol=1e-4)


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
def test_club_of_jointly_gaussian_variables_bounds_their_information(correlation):
    x, noise = np.random.default_rng(0).normal(size=(2, 200_000, 1))
    y = correlation * x + np.sqrt(1 - correlation**2) * noise
    log_variance = np.full_like(x, np.log(1 - correlation**2))
    bound = float(club_all_pairs(*(jnp.asarray(a, jnp.float32) for a in (y, correlation * x, log_variance)))[0])
    information = -0.5 * np.log(1 - correlation**2)
    np.testing.assert_allclose(bound, correlation**2 / (1 - correlation**2), rtol=0.03, atol=1e-3)
    assert bound >= information - 1e-3


def test_dim_to_the_letter_is_the_double_loop_of_eq_8():
    scores = _random(6, 6)
    softplus = lambda x: np.log1p(np.exp(x))  # noqa: E731
    expected = np.mean([[softplus(-scores[i, i]) + softplus(scores[i, j]) for j in range(6)] for i in range(6)])
    np.testing.assert_allclose(dim_jensen_shannon(jnp.asarray(scores))[0], expected, rtol=1e-5)


def test_dim_with_identical_inputs_averages_each_row_over_its_own_pairs():
    scores, kind = _random(6, 6), np.array([0, 1, 0, 2, 2, 0])
    softplus = lambda x: np.log1p(np.exp(x))  # noqa: E731
    rows = [np.mean(softplus(-scores[i, kind == kind[i]])) + np.mean(softplus(scores[i, kind != kind[i]]))
            for i in range(6)]
    identical = jnp.asarray(kind[:, None] == kind[None, :])
    np.testing.assert_allclose(dim_jensen_shannon(jnp.asarray(scores), identical)[0], np.mean(rows), rtol=1e-5)


def test_dim_with_chosen_negatives_averages_each_row_over_those():
    scores, state, shown = _random(6, 6), np.array([0, 1, 0, 2, 2, 3]), np.array([0, 0, 0, 1, 1, 2])
    softplus = lambda x: np.log1p(np.exp(x))  # noqa: E731
    rows = []
    for i in range(6):
        others = scores[i, (state != state[i]) & (shown == shown[i])]
        pushed = np.mean(softplus(others)) if others.size else 0.0
        rows.append(np.mean(softplus(-scores[i, state == state[i]])) + pushed)
    same = jnp.asarray(state[:, None] == state[None, :])
    alike = jnp.asarray(shown[:, None] == shown[None, :])
    loss = dim_jensen_shannon(jnp.asarray(scores), same, different=~same & alike)[0]
    np.testing.assert_allclose(loss, np.mean(rows), rtol=1e-5)
    with pytest.raises(ValueError, match="different pairs need identical ones"):
        dim_jensen_shannon(jnp.asarray(scores), different=~same & alike)


def test_dim_reaches_its_known_optimum_and_not_more():
    """K equally likely inputs, told apart: the best score is log K for equal inputs, minus infinity elsewhere."""
    k = 4
    joint, product = np.eye(k) / k, np.full((k, k), 1 / k**2)
    middle = (joint + product) / 2
    divergence = 0.5 * (np.sum(joint[joint > 0] * np.log(joint[joint > 0] / middle[joint > 0]))
                        + np.sum(product * np.log(product / middle)))
    scores = jnp.where(jnp.eye(k, dtype=bool), jnp.log(float(k)), -50.0)
    best = float(dim_jensen_shannon(scores)[0])
    np.testing.assert_allclose(best, 2 * np.log(2) - 2 * divergence, rtol=1e-5)
    for seed in range(5):
        assert float(dim_jensen_shannon(scores + 0.3 * jnp.asarray(_random(k, k, seed=seed)))[0]) > best


def test_dim_bound_of_gaussians_at_the_best_score_is_below_their_information():
    """For correlation 0.9 the density ratio is known; 2 JSD - 2 log 2 <= 0 <= I = 0.83 nats."""
    correlation, n = 0.9, 1500
    x, noise = np.random.default_rng(0).normal(size=(2, n))
    y = correlation * x + np.sqrt(1 - correlation**2) * noise
    variance = 1 - correlation**2
    ratio = -0.5 * (y[:, None] - correlation * x[None]) ** 2 / variance - 0.5 * np.log(variance) + 0.5 * y[:, None] ** 2
    loss = float(dim_jensen_shannon(jnp.asarray(ratio, jnp.float32))[0])
    assert loss < float(dim_jensen_shannon(jnp.asarray(0.5 * ratio, jnp.float32))[0])
    assert 0 < loss < 2 * np.log(2)


def test_terminal_targets_are_left_out():
    predicted, target = _random(4, 2), _random(4, 2, seed=1)
    terminal = np.array([False, True, False, True])
    expected = np.mean(np.sum((predicted - target) ** 2, axis=1)[~terminal])
    arrays = jnp.asarray(predicted), jnp.asarray(target), jnp.asarray(terminal)
    np.testing.assert_allclose(next_feature_loss(*arrays)[0], expected, rtol=1e-5)
    assert float(next_feature_loss(*arrays[:2], jnp.ones(4, bool))[0]) == 0.0
    gradient = jax.grad(lambda t: next_feature_loss(arrays[0], t, arrays[2])[0])(arrays[1])
    assert not np.any(np.asarray(gradient))


def test_reward_loss_is_the_mean_square():
    np.testing.assert_allclose(reward_loss(jnp.array([1.0, 2.0]), jnp.array([0.0, -1.0]))[0], 5.0)


@pytest.mark.parametrize("call", [
    lambda: club_all_pairs(jnp.ones((3, 2)), jnp.ones((3, 1)), jnp.ones((3, 2))),
    lambda: gaussian_log_density(jnp.ones(3), jnp.ones(3), jnp.ones(3)),
    lambda: dim_jensen_shannon(jnp.ones((3, 2))),
    lambda: reward_loss(jnp.ones((3, 1)), jnp.ones((3, 1))),
    lambda: next_feature_loss(jnp.ones((3, 2)), jnp.ones((3, 1)), jnp.ones(3, bool)),
])
def test_wrong_shapes_are_errors_and_never_broadcast(call):
    with pytest.raises(AssertionError):
        call()


def test_variables_loss_by_hand() -> None:
    """A real variable, one of three classes, rows of different weights; errors below the floor count as the floor."""
    rng = np.random.default_rng(0)
    guess = rng.normal(size=(7, 4)).astype(np.float32)
    truth = np.stack([rng.normal(size=7), rng.integers(0, 3, 7)], axis=1).astype(np.float32)
    weight = rng.dirichlet(np.ones(7)).astype(np.float32)
    error = sum(w * abs(y[0] - g[0]) for w, y, g in zip(weight, truth, guess, strict=True))
    entropy = sum(w * (np.log(np.exp(g[1:]).sum()) - g[1 + int(y[1])])
                  for w, y, g in zip(weight, truth, guess, strict=True))
    kinds = (None, 3)
    np.testing.assert_allclose(
        variables_loss(jnp.asarray(guess), jnp.asarray(truth), kinds, jnp.asarray(weight))[0],
        np.log(error) + entropy, rtol=1e-5)
    real = jnp.asarray(truth[:, :1])
    np.testing.assert_allclose(variables_loss(real, real, (None,))[0], np.log(0.01), rtol=1e-6)
    with pytest.raises(AssertionError):
        variables_loss(jnp.asarray(guess), jnp.asarray(truth), (None, 4))


@pytest.mark.parametrize("scale", [0.05, 0.3, 2.0])
def test_variables_loss_bounds_the_information_of_laplace_noise_tightly(scale: float) -> None:
    """y = z + noise of Laplace: h(y | z) = 1 + log 2b, which the loss gives but for the constant 1 + log 2."""
    z, noise = np.random.default_rng(0).laplace(size=(2, 200_000, 1)).astype(np.float32)
    loss = float(variables_loss(jnp.asarray(z), jnp.asarray(z + scale * noise), (None,))[0])
    np.testing.assert_allclose(1 + np.log(2) + loss, 1 + np.log(2 * scale), atol=0.01)

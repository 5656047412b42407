"""Losses and rewards on the privileged features against plain loops."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mijax.losses import information as info


def random_features(seed: int, *shape: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def cosine(x: np.ndarray, y: np.ndarray) -> float:
    return float(x @ y / (np.linalg.norm(x) * np.linalg.norm(y)))


def test_prediction_mse_by_hand():
    predicted, z_s = random_features(0, 2, 3, 4), random_features(1, 2, 3, 4)
    mask = jnp.array([[True, True, False], [False, True, False]])
    loss, metrics = info.prediction_mse(predicted, z_s, mask, jnp.float32(2.5))
    errors = [sum((float(p) - float(z)) ** 2 for p, z in zip(predicted[i, j], z_s[i, j], strict=True)) / 2.5
              for i, j in ((0, 0), (0, 1), (1, 1))]
    assert float(loss) == pytest.approx(np.mean(errors), rel=1e-5)
    assert float(metrics["explained"]) == pytest.approx(1 - np.mean(errors), rel=1e-4)


def test_predicting_the_mean_costs_one_in_units_of_the_variance():
    z_s = random_features(2, 100, 5)
    mean = jnp.broadcast_to(z_s.mean(0, keepdims=True), z_s.shape)
    variance = jnp.var(z_s, axis=0).sum()
    loss, metrics = info.prediction_mse(mean, z_s, jnp.ones(100, bool), variance)
    assert float(loss) == pytest.approx(1, rel=1e-5)
    assert float(metrics["explained"]) == pytest.approx(0, abs=1e-5)


def test_prediction_cosine_by_hand():
    predicted, z_s = random_features(3, 4, 6), random_features(4, 4, 6)
    loss, metrics = info.prediction_cosine(predicted, z_s, jnp.array([True, False, True, True]))
    expected = np.mean([cosine(np.asarray(predicted[i]), np.asarray(z_s[i])) for i in (0, 2, 3)])
    assert float(loss) == pytest.approx(1 - expected, rel=1e-5)
    assert float(metrics["cosine"]) == pytest.approx(expected, rel=1e-5)


def test_no_gradient_flows_into_z_s():
    predicted, z_s, mask = random_features(5, 3, 4), random_features(6, 3, 4), jnp.array([True, True, False])
    for loss in (info.prediction_mse, info.prediction_cosine):
        of_predicted, of_z_s = jax.grad(lambda p, z, loss=loss: loss(p, z, mask)[0], (0, 1))(predicted, z_s)
        assert of_predicted[:2].any(axis=-1).all()
        assert not of_predicted[2].any()
        assert not of_z_s.any()


def test_cosine_is_signed_and_finite_at_zero():
    z = random_features(7, 5)
    assert float(info.cosine(z, 3 * z)) == pytest.approx(1)
    assert float(info.cosine(z, -z)) == pytest.approx(-1)
    assert float(info.cosine(z, 0 * z)) == 0
    assert jnp.isfinite(jax.grad(lambda f: info.cosine(z, f))(0 * z)).all()


def test_cosine_bonus_by_hand():
    z, f, before = random_features(8, 2, 3), random_features(9, 2, 3), random_features(10, 2, 3)
    expected = [cosine(np.asarray(z[i]), np.asarray(f[i])) - cosine(np.asarray(z[i]), np.asarray(before[i]))
                for i in range(2)]
    np.testing.assert_allclose(info.cosine_bonus(z, f, before), expected, rtol=1e-5)


def test_cosine_bonus_punishes_turning_to_the_opposite():
    """With |cos| the bonus of turning from z to -z would be 0."""
    z = random_features(11, 4)
    assert float(info.cosine_bonus(z, -z, z)) == pytest.approx(-2)
    assert float(info.cosine_bonus(z, z, -z)) == pytest.approx(2)


def test_explained_variance_bonus_by_hand():
    z, f, before = jnp.array([1.0, 0.0]), jnp.array([1.0, 1.0]), jnp.array([0.0, 2.0])
    assert float(info.explained_variance_bonus(z, f, before, 2.0)) == (5 - 1) / 2


def test_bonuses_sum_over_an_episode_to_what_was_learned_when_z_is_constant():
    steps, features = 9, 4
    z = jnp.tile(random_features(12, 1, features), (steps, 1))
    f = random_features(13, steps + 1, features)
    variance = 3.0
    total = info.explained_variance_bonus(z, f[1:], f[:-1], variance).sum()
    before, after = (float(((z[0] - f[t]) ** 2).sum()) for t in (0, -1))
    assert float(total) == pytest.approx((before - after) / variance, rel=1e-4)
    total = info.cosine_bonus(z, f[1:], f[:-1]).sum()
    assert float(total) == pytest.approx(float(info.cosine(z[0], f[-1]) - info.cosine(z[0], f[0])), rel=1e-4)


def test_bonuses_that_telescope_sum_to_what_was_learned_whatever_z_does():
    """To and fro between two values that f always knows: nothing is gained, and the paper's form pays every step."""
    pair = random_features(20, 2, 4)
    z, f = jnp.tile(pair, (4, 1)), jnp.tile(pair, (4, 1))
    sure = jnp.full(7, info.LEAST_LOG_VARIANCE)
    forms = {
        "cosine": lambda before: info.cosine_bonus(z[1:], f[1:], f[:-1], before),
        "explained": lambda before: info.explained_variance_bonus(z[1:], f[1:], f[:-1], 3.0, before),
        "likelihood": lambda before: info.log_likelihood_bonus(z[1:], f[1:], f[:-1], sure, sure, 3.0, before)}
    for name, bonus in forms.items():
        np.testing.assert_allclose(bonus(z[:-1]), 0, atol=1e-6, err_msg=name)
        assert float(bonus(None).min()) > 0.1, name
    z, f = random_features(21, 9, 4), random_features(22, 9, 4)
    total = info.explained_variance_bonus(z[1:], f[1:], f[:-1], 3.0, z[:-1]).sum()
    before, after = (float(((z[t] - f[t]) ** 2).sum()) for t in (0, -1))
    assert float(total) == pytest.approx((before - after) / 3.0, rel=1e-4)
    total = info.cosine_bonus(z[1:], f[1:], f[:-1], z[:-1]).sum()
    assert float(total) == pytest.approx(float(info.cosine(z[-1], f[-1]) - info.cosine(z[0], f[0])), rel=1e-4, abs=1e-5)


def test_finding_out_a_binary_variable_earns_one():
    """z_s takes two values equally often; f starts at the mean and ends at the truth: all of the variance."""
    values = random_features(14, 2, 6)
    mean = values.mean(0)
    variance = jnp.var(values, axis=0).sum()
    earned = [float(info.explained_variance_bonus(z, z, mean, variance)) for z in values]
    assert np.mean(earned) == pytest.approx(1, rel=1e-5)


def test_log_likelihood_bonus_by_hand():
    z, f, before = jnp.array([1.0, 0.0]), jnp.array([1.0, 1.0]), jnp.array([0.0, 2.0])
    nats = -(math.log(0.25) + (1 / 2) / 0.25) / 2 + (math.log(1.0) + (5 / 2) / 1.0) / 2
    bonus = info.log_likelihood_bonus(z, f, before, jnp.log(0.25), jnp.log(1.0), 2.0)
    assert float(bonus) == pytest.approx(nats / (math.log(100) / 2), rel=1e-5)


def test_log_likelihood_bonus_pays_for_a_value_that_was_expected():
    """Three values on a line: the middle one is their mean, which f predicts before it knows."""
    values = jnp.array([[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0]])
    mean, variance = values.mean(0), jnp.var(values, axis=0).sum()
    sure, unsure = jnp.asarray(info.LEAST_LOG_VARIANCE), jnp.zeros(())
    explained = [float(info.explained_variance_bonus(z, z, mean, variance)) for z in values]
    gained = [float(info.log_likelihood_bonus(z, z, mean, sure, unsure, variance)) for z in values]
    np.testing.assert_allclose(explained, [1.5, 0.0, 1.5], atol=1e-6)
    np.testing.assert_allclose(gained, [1 + 0.75 / math.log(10), 1.0, 1 + 0.75 / math.log(10)], rtol=1e-5)


def test_log_likelihood_bonus_of_sure_errors_is_bounded():
    z, sure = jnp.array([3.0, 0.0]), jnp.asarray(info.LEAST_LOG_VARIANCE)
    assert float(info.log_likelihood_bonus(z, -z, z, sure, sure, 1.0)) == pytest.approx(-2)
    assert float(info.log_likelihood_bonus(z, z, -z, sure, sure, 1.0)) == pytest.approx(2)


def test_variance_nll_is_least_at_the_error_and_moves_the_variance_alone():
    z, f, mask = random_features(15, 6, 3), random_features(16, 6, 3), jnp.arange(6) < 4
    variance = 2.0
    error = jnp.sum(jnp.square(z - f), axis=-1) / variance

    def nll(f: jax.Array, log_variance: jax.Array, z: jax.Array) -> jax.Array:
        return info.variance_nll(f, log_variance, z, mask, variance)

    of_f, of_best, of_z = jax.grad(nll, argnums=(0, 1, 2))(f, jnp.log(error), z)
    assert not of_f.any()
    assert not of_z.any()
    np.testing.assert_allclose(of_best, 0, atol=1e-6)
    assert float(nll(f, jnp.log(error), z)) == pytest.approx(float(jnp.mean(jnp.log(error[:4]) + 1) / 2), rel=1e-5)
    assert float(nll(f, jnp.log(error) + 0.3, z)) > float(nll(f, jnp.log(error), z))


def test_shapes_that_would_broadcast_are_errors():
    z, row, mask = jnp.zeros((3, 4)), jnp.zeros((1, 4)), jnp.ones(3, bool)
    for call in (
        lambda: info.prediction_mse(z, row, mask),
        lambda: info.prediction_mse(row, z, mask),
        lambda: info.prediction_mse(z, z, jnp.ones(1, bool)),
        lambda: info.prediction_cosine(z, row, mask),
        lambda: info.prediction_cosine(z, z, jnp.ones(1, bool)),
        lambda: info.cosine_bonus(z, z, row),
        lambda: info.cosine_bonus(row, z, z),
        lambda: info.explained_variance_bonus(z, row, z, 1.0),
        lambda: info.explained_variance_bonus(row, z, z, 1.0),
        lambda: info.log_likelihood_bonus(z, row, z, jnp.zeros(3), jnp.zeros(3), 1.0),
        lambda: info.log_likelihood_bonus(z, z, z, jnp.zeros(1), jnp.zeros(3), 1.0),
        lambda: info.variance_nll(z, jnp.zeros(1), z, mask),
    ):
        with pytest.raises(AssertionError):
            call()

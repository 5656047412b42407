"""Believer's losses against integrals and a linear Gaussian model whose likelihood is known."""

import jax.numpy as jnp
import numpy as np
import pytest

from mijax.losses import kl_standard_normal, negative_elbo


def gaussian(x: np.ndarray, mean: float, variance: float) -> np.ndarray:
    return np.exp(-0.5 * (x - mean) ** 2 / variance) / np.sqrt(2 * np.pi * variance)


def test_kl_is_the_integral_of_the_log_ratio_summed_over_features():
    x = np.linspace(-12, 12, 200_001)
    pairs = [(0.7, 0.4), (-1.5, 1.8)]
    expected = sum(
        np.trapezoid(gaussian(x, m, v) * np.log(gaussian(x, m, v) / gaussian(x, 0, 1)), x) for m, v in pairs)
    mean, variance = np.array(pairs, np.float32).T
    assert float(kl_standard_normal(jnp.asarray(mean), jnp.log(variance))) == pytest.approx(expected, rel=1e-4)
    assert float(kl_standard_normal(jnp.zeros(3), jnp.zeros(3))) == 0


@pytest.mark.parametrize("exact", [True, False])
def test_elbo_bounds_the_likelihood_and_meets_it_at_the_true_posterior(exact: bool):
    """x = a z + sigma e with z, e ~ N(0, 1): x ~ N(0, a^2 + sigma^2), z | x ~ N(a x / (a^2 + sigma^2), ...)."""
    a, sigma, x = 1.3, 0.5, 0.9
    total = a**2 + sigma**2
    mean, variance = (a * x / total, sigma**2 / total) if exact else (0.2, 0.5)
    nodes, weights = np.polynomial.hermite_e.hermegauss(20)  # E over z ~ N(mean, variance), exact for polynomials
    z = mean + np.sqrt(variance) * nodes
    losses = [
        float(negative_elbo(
            jnp.full((2, 1), x), jnp.array([[a * latent], [99.0]], jnp.float32), jnp.log(jnp.float32(sigma)),
            jnp.full((2, 1), mean), jnp.full((2, 1), np.log(variance)), jnp.array([True, False]))[0])
        for latent in z]
    bound = float(weights @ losses / weights.sum())
    truth = -np.log(gaussian(np.array(x), 0, total))
    assert bound == pytest.approx(truth, rel=1e-4) if exact else bound > truth + 0.05

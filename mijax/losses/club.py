"""An upper bound of mutual information: CLUB with a diagonal Gaussian (paper Section 2.2, Appendix C.3.1).

Every expectation over the batch takes an optional `weight` (B,): the probability of each row, summing to one. Rows that
occur many times in a batch can so be computed once. None means that all rows weigh 1 / B.
"""

import chex
import jax
import jax.numpy as jnp

from mijax.types import Metrics

LOG_TWO_PI = 1.8378770664093453


def gaussian_log_density(x: jax.Array, mean: jax.Array, log_variance: jax.Array) -> jax.Array:
    """log N(x; mean, diag exp(log_variance)), in nats.

    Args:
        x: (B, F) points.
        mean: (B, F).
        log_variance: (B, F).

    Returns:
        (B,) log densities.
    """
    chex.assert_rank(x, 2)
    chex.assert_equal_shape([x, mean, log_variance])
    squares = jnp.square(x - mean) * jnp.exp(-log_variance)
    return -0.5 * jnp.sum(squares + log_variance + LOG_TWO_PI, axis=-1)


def gaussian_fit(
    z_o: jax.Array, mean: jax.Array, log_variance: jax.Array, weight: jax.Array | None = None
) -> tuple[jax.Array, Metrics]:
    """The negative log-likelihood by which q(z_o | z_s) follows p(z_o | z_s): -E[log q(z_o | z_s)].

    Minimising it minimises KL[p(z_o | z_s) || q(z_o | z_s)] (Appendix C.3.1).

    Args:
        z_o: (B, F) observation features.
        mean: (B, F) mean of q(. | z_s).
        log_variance: (B, F) log-variance of q(. | z_s).
        weight: (B,) probabilities of the rows, or None.

    Returns:
        The loss, in nats, and metrics.
    """
    loss = -_expectation(gaussian_log_density(z_o, mean, log_variance), weight)
    return loss, {"estimator_nll": loss}


def club_all_pairs(
    z_o: jax.Array, mean: jax.Array, log_variance: jax.Array, weight: jax.Array | None = None
) -> tuple[jax.Array, Metrics]:
    """CLUB over all pairs of the batch (Eq. 7): E_i[log q(z_o_i | z_s_i)] - E_i E_j[log q(z_o_j | z_s_i)].

    For a diagonal Gaussian the mean over j needs only the first two moments of z_o,
    E_j (z_j - mean_i)^2 = (E z - mean_i)^2 + Var z, so that the cost is O(B F) and not O(B^2 F).

    Args:
        z_o: (B, F) observation features.
        mean: (B, F) mean of q(. | z_s).
        log_variance: (B, F) log-variance of q(. | z_s).
        weight: (B,) probabilities of the rows, or None.

    Returns:
        The bound, in nats, and metrics.
    """
    chex.assert_rank(z_o, 2)
    chex.assert_equal_shape([z_o, mean, log_variance])
    center = _expectation(z_o, weight)[None]
    variance = _expectation(jnp.square(z_o - center), weight)[None]
    positive = jnp.square(z_o - mean)
    negative = jnp.square(center - mean) + variance
    bound = 0.5 * _expectation(jnp.sum((negative - positive) * jnp.exp(-log_variance), axis=-1), weight)
    return bound, {"club": bound}


def club_sampled(
    z_o: jax.Array, mean: jax.Array, log_variance: jax.Array, permutation: jax.Array
) -> tuple[jax.Array, Metrics]:
    """CLUB with one negative for each row: E_i[log q(z_o_i | z_s_i) - log q(z_o_permutation(i) | z_s_i)].

    An unbiased, noisier estimate of the bound over all pairs when the permutation is uniform and has no fixed point
    more often than chance; the form of the authors' program.

    Args:
        z_o: (B, F) observation features.
        mean: (B, F) mean of q(. | z_s).
        log_variance: (B, F) log-variance of q(. | z_s).
        permutation: (B,) int, which row serves as the negative of each.

    Returns:
        The bound, in nats, and metrics.
    """
    chex.assert_rank([z_o, permutation], [2, 1])
    positive = gaussian_log_density(z_o, mean, log_variance)
    negative = gaussian_log_density(z_o[permutation], mean, log_variance)
    bound = jnp.mean(positive - negative)
    return bound, {"club": bound}


def _expectation(x: jax.Array, weight: jax.Array | None) -> jax.Array:
    """The mean over the first axis of (B, ...), weighted by (B,) probabilities when they are given."""
    if weight is None:
        return jnp.mean(x, axis=0)
    chex.assert_rank(weight, 1)
    chex.assert_equal_shape_prefix([x, weight], 1)
    return jnp.tensordot(weight, x, axes=1)

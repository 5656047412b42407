"""Losses and rewards that use the privileged features z_s in stage 2 (paper Section 3.2, Eq. 4 and 5)."""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from mijax.losses.masks import masked_mean

_EPS = 1e-8
LEAST_LOG_VARIANCE = float(np.log(0.01))
"""Of what f is believed to leave unexplained of z_s, in fractions of Tr Var(z_s): below it nothing more is earned."""


def prediction_mse(
    predicted: jax.Array, z_s: jax.Array, mask: jax.Array, variance: jax.Array | float = 1.0
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Eq. 5: E[ |z_s - f(h)|^2 ], summed over features; with `variance` in fractions of Tr Var(z_s).

    In those units predicting the mean of z_s costs 1 whatever the encoder's scale, so one weight fits all encoders.

    Args:
        predicted: (..., F) f(h) or the auxiliary head k(h).
        z_s: (..., F) phi(s); no gradient flows into it.
        mask: (...) bool, which entries count.
        variance: () Tr Var(z_s), or 1 for the plain squared norm.

    Returns:
        () loss, and the fraction of the variance that is explained.
    """
    chex.assert_equal_shape([predicted, z_s])
    chex.assert_equal_shape_prefix([predicted, mask], mask.ndim)
    error = jnp.sum(jnp.square(predicted - jax.lax.stop_gradient(z_s)), axis=-1) / variance
    loss = masked_mean(error, mask)
    return loss, {"explained": 1 - loss}


def prediction_cosine(
    predicted: jax.Array, z_s: jax.Array, mask: jax.Array
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """E[ 1 - cos(z_s, f(h)) ]: the auxiliary task in the geometry of the paper's bonus.

    Args:
        predicted: (..., F).
        z_s: (..., F); no gradient flows into it.
        mask: (...) bool, which entries count.

    Returns:
        () loss, and the mean cosine.
    """
    chex.assert_equal_shape([predicted, z_s])
    chex.assert_equal_shape_prefix([predicted, mask], mask.ndim)
    similarity = masked_mean(cosine(predicted, jax.lax.stop_gradient(z_s)), mask)
    return 1 - similarity, {"cosine": similarity}


def cosine(x: jax.Array, y: jax.Array) -> jax.Array:
    """(..., F) twice -> (...) cosine similarity; 0 where either is zero. Signed: z and -z are opposite."""
    norms = jnp.sqrt(jnp.sum(x * x, axis=-1) * jnp.sum(y * y, axis=-1) + _EPS**2)
    return jnp.sum(x * y, axis=-1) / norms


def cosine_bonus(
    z_s_t: jax.Array, f_t: jax.Array, f_tm1: jax.Array, z_s_tm1: jax.Array | None = None
) -> jax.Array:
    """The paper's intrinsic reward: cos(z_t, f(h_t)) - cos(z_t, f(h_{t-1})), both against the same z_t.

    That pays for every change of z_s which the next observation tells: where z_s holds some of what is seen, for going
    to and fro. With z_{t-1} in the second term, here and in the other two forms, the sum over an episode telescopes to
    what is known at its end, and no more can be earned than by knowing all.

    Args:
        z_s_t: (..., F) phi(s_t).
        f_t: (..., F) f(h_t).
        f_tm1: (..., F) f(h_{t-1}).
        z_s_tm1: (..., F) phi(s_{t-1}), to telescope; None: z_t in both terms.

    Returns:
        (...) bonus in [-2, 2]; its sum over an episode depends on the geometry of z_s.
    """
    chex.assert_equal_shape([z_s_t, f_t, f_tm1])
    return cosine(z_s_t, f_t) - cosine(z_s_t if z_s_tm1 is None else z_s_tm1, f_tm1)


def explained_variance_bonus(
    z_s_t: jax.Array, f_t: jax.Array, f_tm1: jax.Array, variance: jax.Array | float, z_s_tm1: jax.Array | None = None
) -> jax.Array:
    """Eq. 4 with a Gaussian, normalised: (|z_t - f(h_{t-1})|^2 - |z_t - f(h_t)|^2) / Tr Var(z_s).

    Args:
        z_s_t: (..., F) phi(s_t).
        f_t: (..., F) f(h_t).
        f_tm1: (..., F) f(h_{t-1}).
        variance: () Tr Var(z_s).
        z_s_tm1: (..., F) phi(s_{t-1}), to telescope; None: z_t in both terms. See `cosine_bonus`.

    Returns:
        (...) bonus; if it telescopes, or z_s is constant in an episode, it sums to the fraction of z_s that the history
        explains in the end and did not in the beginning.
    """
    chex.assert_equal_shape([z_s_t, f_t, f_tm1])
    before = jnp.sum(jnp.square((z_s_t if z_s_tm1 is None else z_s_tm1) - f_tm1), axis=-1)
    after = jnp.sum(jnp.square(z_s_t - f_t), axis=-1)
    return (before - after) / variance


def variance_nll(
    predicted: jax.Array, log_variance: jax.Array, z_s: jax.Array, mask: jax.Array, variance: jax.Array | float = 1.0
) -> jax.Array:
    """-E[ log f(z_s | h) ] of Eq. 5 as a loss of the variance of f alone, whose mean `prediction_mse` fits.

    Args:
        predicted: (..., F) f(h), the mean; no gradient flows into it.
        log_variance: (...) log of E|z_s - f(h)|^2, in fractions of `variance`.
        z_s: (..., F) phi(s); no gradient flows into it.
        mask: (...) bool, which entries count.
        variance: () Tr Var(z_s).

    Returns:
        () loss; least where the variance is that of the error.
    """
    return -masked_mean(_log_likelihood(
        jax.lax.stop_gradient(predicted), log_variance, jax.lax.stop_gradient(z_s), variance), mask)


def log_likelihood_bonus(
    z_s_t: jax.Array, f_t: jax.Array, f_tm1: jax.Array, log_variance_t: jax.Array, log_variance_tm1: jax.Array,
    variance: jax.Array | float, z_s_tm1: jax.Array | None = None,
) -> jax.Array:
    """The third term of Eq. 4, log f(z_t | h_t) - log f(z_t | h_{t-1}), of a Gaussian that knows how sure it is.

    In units of what is earned by becoming sure, log(1 / 0.01) / 2 nats: about 1 for an episode in which z_s is
    revealed, also where it is what f expects of all episodes, for which the other two forms pay nothing. Errors count
    as if z_s had one dimension, and a log-likelihood below -1 in these units counts as -1: f can be surely wrong.

    Args:
        z_s_t: (..., F) phi(s_t).
        f_t: (..., F) mean of f(. | h_t).
        f_tm1: (..., F) mean of f(. | h_{t-1}).
        log_variance_t: (...) log of E|z_t - f_t|^2, in fractions of `variance`, at least `LEAST_LOG_VARIANCE`.
        log_variance_tm1: (...) the same of h_{t-1}.
        variance: () Tr Var(z_s).
        z_s_tm1: (..., F) phi(s_{t-1}), to telescope; None: z_t in both terms. See `cosine_bonus`.

    Returns:
        (...) bonus; if it telescopes, or z_s is constant in an episode, it sums to the information gained between the
        first and last step.
    """
    chex.assert_equal_shape([z_s_t, f_t, f_tm1])
    later = _log_likelihood(f_t, log_variance_t, z_s_t, variance)
    earlier = _log_likelihood(f_tm1, log_variance_tm1, z_s_t if z_s_tm1 is None else z_s_tm1, variance)
    unit = -LEAST_LOG_VARIANCE / 2
    return jnp.maximum(later / unit, -1.0) - jnp.maximum(earlier / unit, -1.0)


def _log_likelihood(
    mean: jax.Array, log_variance: jax.Array, z_s: jax.Array, variance: jax.Array | float
) -> jax.Array:
    """(...) nats, without the constant."""
    chex.assert_equal_shape([mean, z_s])
    chex.assert_equal_shape_prefix([mean, log_variance], log_variance.ndim)
    error = jnp.sum(jnp.square(z_s - mean), axis=-1) / variance
    return -(log_variance + error * jnp.exp(-log_variance)) / 2

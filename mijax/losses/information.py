"""Losses and rewards that use the privileged features z_s in stage 2 (paper Section 3.2, Eq. 4 and 5)."""

import chex
import jax
import jax.numpy as jnp

from mijax.losses.masks import masked_mean

_EPS = 1e-8


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


def cosine_bonus(z_s_t: jax.Array, f_t: jax.Array, f_tm1: jax.Array) -> jax.Array:
    """The paper's intrinsic reward: cos(z_t, f(h_t)) - cos(z_t, f(h_{t-1})), both against the same z_t.

    Args:
        z_s_t: (..., F) phi(s_t).
        f_t: (..., F) f(h_t).
        f_tm1: (..., F) f(h_{t-1}).

    Returns:
        (...) bonus in [-2, 2]; its sum over an episode depends on the geometry of z_s.
    """
    chex.assert_equal_shape([z_s_t, f_t, f_tm1])
    return cosine(z_s_t, f_t) - cosine(z_s_t, f_tm1)


def explained_variance_bonus(
    z_s_t: jax.Array, f_t: jax.Array, f_tm1: jax.Array, variance: jax.Array | float
) -> jax.Array:
    """Eq. 4 with a Gaussian, normalised: (|z_t - f(h_{t-1})|^2 - |z_t - f(h_t)|^2) / Tr Var(z_s).

    Args:
        z_s_t: (..., F) phi(s_t).
        f_t: (..., F) f(h_t).
        f_tm1: (..., F) f(h_{t-1}).
        variance: () Tr Var(z_s).

    Returns:
        (...) bonus; for a z_s constant in an episode it sums to the fraction of z_s that the history explains.
    """
    chex.assert_equal_shape([z_s_t, f_t, f_tm1])
    before = jnp.sum(jnp.square(z_s_t - f_tm1), axis=-1)
    after = jnp.sum(jnp.square(z_s_t - f_t), axis=-1)
    return (before - after) / variance

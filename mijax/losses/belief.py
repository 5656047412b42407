"""Losses of Believer (paper Appendix A.5): the KL penalty of its stage 1, and the history VAE of its stage 2."""

import chex
import jax
import jax.numpy as jnp

from mijax.losses.masks import masked_mean

_LOG_2_PI = 1.8378770664093453


def kl_standard_normal(mean: jax.Array, log_variance: jax.Array) -> jax.Array:
    """KL[ N(mean, diag exp(log_variance)) || N(0, 1) ] in nats, summed over features: (..., F) twice -> (...)."""
    chex.assert_equal_shape([mean, log_variance])
    return 0.5 * jnp.sum(jnp.square(mean) + jnp.exp(log_variance) - log_variance - 1, axis=-1)


def negative_elbo(
    x: jax.Array, decoded: jax.Array, log_scale: jax.Array, mean: jax.Array, log_variance: jax.Array, mask: jax.Array
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Upper bound of -log p(x | h) by a variational autoencoder with a standard normal prior, in nats.

    Args:
        x: (..., F) what is modelled.
        decoded: (..., F) mean of the decoder, for one sample of the latent.
        log_scale: () log standard deviation of the decoder, shared by all features.
        mean: (..., Z) of the approximate posterior.
        log_variance: (..., Z) of the approximate posterior.
        mask: (...) bool, which entries count.

    Returns:
        () loss; the mean squared distance |x - decoded|^2 and the KL divergence from the prior.
    """
    chex.assert_equal_shape([x, decoded])
    chex.assert_equal_shape_prefix([x, mean, mask], mask.ndim)
    squares = jnp.sum(jnp.square(jax.lax.stop_gradient(x) - decoded), axis=-1)
    surprise = 0.5 * squares * jnp.exp(-2 * log_scale) + x.shape[-1] * (log_scale + 0.5 * _LOG_2_PI)
    divergence = kl_standard_normal(mean, log_variance)
    loss = masked_mean(surprise + divergence, mask)
    return loss, {"error": masked_mean(squares, mask), "kl": masked_mean(divergence, mask)}

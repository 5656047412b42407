"""A lower bound of mutual information by drawing the input (Barber and Agakov 2003). Not the paper's."""

import chex
import jax
import jax.numpy as jnp

from mijax.types import Metrics


def reconstruction_loss(
    drawn: jax.Array, target: jax.Array, weight: jax.Array | None = None
) -> tuple[jax.Array, Metrics]:
    """E|x - x_hat(z)|^2 / E|x - E x|^2, the share of the input's variance that its features do not explain.

    I(x; z) >= h(x) + E log q(x | z) for any q. With q a Gaussian about the drawn input, of one variance for all D
    coordinates and that fitted, the bound is D / 2 log(1 / loss) nats above what a constant drawing gives.

    Args:
        drawn: (B, D) x_hat.
        target: (B, D) x.
        weight: (B,) probabilities of the rows, summing to one, or None when all weigh 1 / B.

    Returns:
        The loss, 1 for the best constant drawing and 0 for a perfect one, and metrics.
    """
    chex.assert_rank([drawn, target], 2)
    chex.assert_equal_shape([drawn, target])
    size = target.shape[0]
    if weight is None:
        weight = jnp.full((size,), 1.0 / size, target.dtype)
    chex.assert_shape(weight, (size,))
    error = weight @ jnp.sum(jnp.square(target - drawn), axis=1)
    variance = weight @ jnp.sum(jnp.square(target - (weight @ target)[None]), axis=1)
    loss = error / jnp.maximum(variance, 1e-12)
    return loss, {"reconstruction": loss}

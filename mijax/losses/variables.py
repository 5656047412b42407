"""A lower bound of mutual information by telling variables (Barber and Agakov 2003). Not the paper's."""

from collections.abc import Sequence

import chex
import jax
import jax.numpy as jnp
import optax

from mijax.types import Metrics

FLOOR = 0.01
"""Mean absolute errors below this many units of a variable count as this many: no variable is worth all others."""


def variables_loss(
    guess: jax.Array, truth: jax.Array, num_values: Sequence[int | None], weight: jax.Array | None = None
) -> tuple[jax.Array, Metrics]:
    """- E log q(y | z) summed over variables y, up to a constant: log E|y - y_hat| or a cross-entropy each, in nats.

    I(y; z) >= h(y) + E log q(y | z) for any q. For a real variable q is a Laplace distribution about its guess, whose
    scale is fitted to the batch: E|y - y_hat|. A Gaussian's would heed most what cannot be told, as which of two
    objects is called the nearer one where both are equally near.

    Args:
        guess: (B, W), of each variable in turn one column, or one logit for each of its values.
        truth: (B, V) float32; a category is a number from 0 on.
        num_values: V long, how many values a variable has; None: it is real.
        weight: (B,) probabilities of the rows, summing to one, or None when all weigh 1 / B.

    Returns:
        The loss and metrics.
    """
    chex.assert_rank([guess, truth], 2)
    chex.assert_shape(truth, (guess.shape[0], len(num_values)))
    widths = [count or 1 for count in num_values]
    chex.assert_shape(guess, (None, sum(widths)))
    if weight is None:
        weight = jnp.full(guess.shape[:1], 1.0 / guess.shape[0], guess.dtype)
    chex.assert_shape(weight, guess.shape[:1])
    loss, begin = jnp.zeros((), guess.dtype), 0
    for column, (count, width) in enumerate(zip(num_values, widths, strict=True)):
        y_hat, y = guess[:, begin : begin + width], truth[:, column]
        if count is None:
            loss += jnp.log(jnp.maximum(weight @ jnp.abs(y - y_hat[:, 0]), FLOOR))
        else:
            loss += weight @ optax.softmax_cross_entropy_with_integer_labels(y_hat, y.astype(jnp.int32))
        begin += width
    return loss, {"variables": loss}

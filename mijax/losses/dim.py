"""A lower bound of mutual information: Deep InfoMax with the Jensen-Shannon estimator (paper Eq. 3, Eq. 8)."""

import chex
import jax
import jax.numpy as jnp

from mijax.types import Metrics


def dim_jensen_shannon(
    scores: jax.Array, identical: jax.Array | None = None, weight: jax.Array | None = None,
    different: jax.Array | None = None,
) -> tuple[jax.Array, Metrics]:
    """Minus the Jensen-Shannon bound of I(x; E(x)): E[sp(-score of x with E(x))] + E[sp(score of x' with E(x))].

    sp is softplus. Without `identical` this is Eq. 8 to the letter: the positives are the diagonal, the negatives all
    B^2 pairs, and the loss at the best score function is 2 log 2 - 2 JSD(p(x, z) || p(x) p(z)).

    With `identical`, pairs of the same input are positives and only pairs of different inputs are negatives: frequent
    observations are then not pushed away from themselves. Normalisation: each row averages over its own positives and
    over its own negatives, then the rows are averaged, so that every sample counts once however often its input
    occurs; a row without negatives contributes none. The loss falls to 0 when all different inputs are told apart.

    With `different` as well, only those pairs are negatives. Where these are states that show the same observation o,
    what has to be told apart is what o does not tell: a bound of I(x; E(x) | o).

    Args:
        scores: (B, B) the score of input x_j with feature E(x_i) at [i, j].
        identical: (B, B) bool, whether x_i and x_j are the same input, or None.
        weight: (B,) probabilities of the rows, summing to one, or None when all weigh 1 / B.
        different: (B, B) bool, which pairs are negatives; None: all that are not `identical`.

    Returns:
        The loss, in nats, and metrics.
    """
    chex.assert_rank(scores, 2)
    size = scores.shape[0]
    chex.assert_shape(scores, (size, size))
    if weight is None:
        weight = jnp.full((size,), 1.0 / size, scores.dtype)
    chex.assert_shape(weight, (size,))
    if identical is None and different is not None:
        raise ValueError("different pairs need identical ones")
    if identical is None:
        positive_rows = jax.nn.softplus(-jnp.diagonal(scores))
        negative_rows = jax.nn.softplus(scores) @ weight
    else:
        different = ~identical if different is None else different
        chex.assert_shape([identical, different], (size, size))
        positive_rows = _row_mean(jax.nn.softplus(-scores), jnp.where(identical, weight[None], 0.0))
        negative_rows = _row_mean(jax.nn.softplus(scores), jnp.where(different, weight[None], 0.0))
    positive, negative = weight @ positive_rows, weight @ negative_rows
    return positive + negative, {"dim": -(positive + negative)}


def _row_mean(x: jax.Array, weight: jax.Array) -> jax.Array:
    """(B,) the mean of each row of (B, B) under (B, B) weights; 0 where a row has no weight."""
    total = jnp.sum(weight, axis=1)
    return jnp.sum(x * weight, axis=1) / jnp.where(total > 0, total, 1.0)

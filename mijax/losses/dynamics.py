"""Predicting the reward and the next features (paper Algorithm 1, lines 4 and 5)."""

import chex
import jax
import jax.numpy as jnp

from mijax.types import Metrics


def reward_loss(
    predicted_reward: jax.Array, reward: jax.Array, weight: jax.Array | None = None
) -> tuple[jax.Array, Metrics]:
    """L_r = E[(r - r_hat)^2].

    Args:
        predicted_reward: (B,) r_hat from z_s, z_o and the action.
        reward: (B,) received on arriving at the next state.
        weight: (B,) probabilities of the rows, summing to one, or None when all weigh 1 / B.

    Returns:
        The loss, in squared units of reward, and metrics.
    """
    chex.assert_rank([predicted_reward, reward], 1)
    chex.assert_equal_shape([predicted_reward, reward])
    squares = jnp.square(predicted_reward - reward)
    loss = jnp.mean(squares) if weight is None else weight @ squares
    return loss, {"reward_loss": loss}


def next_feature_loss(
    predicted: jax.Array, target: jax.Array, terminal: jax.Array, weight: jax.Array | None = None
) -> tuple[jax.Array, Metrics]:
    """L_s or L_o = E[|stop_gradient(z') - z_hat'|^2] over transitions with a successor.

    The squared norm is summed over the F features. What follows the end of a task is no target: terminal transitions
    are left out and the expectation is over the others.

    Args:
        predicted: (B, F) z_hat' from z_s, z_o and the action.
        target: (B, F) z' of the next state or observation; no gradient flows into it.
        terminal: (B,) bool, whether the transition ended the task.
        weight: (B,) probabilities of the rows, summing to one, or None when all weigh 1 / B.

    Returns:
        The loss, in squared units of the features, and metrics.
    """
    chex.assert_rank([predicted, target, terminal], [2, 2, 1])
    chex.assert_equal_shape([predicted, target])
    chex.assert_equal_shape_prefix([predicted, terminal], 1)
    squares = jnp.sum(jnp.square(jax.lax.stop_gradient(target) - predicted), axis=-1)
    mask = jnp.where(terminal, 0.0, jnp.ones_like(squares) if weight is None else weight)
    total = jnp.sum(mask)
    loss = jnp.sum(squares * mask) / jnp.where(total > 0, total, 1.0)
    return loss, {"feature_loss": loss}

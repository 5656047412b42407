"""Double Q-learning values and loss (van Hasselt et al. 2016; paper Appendix A.6)."""

import chex
import jax
import jax.numpy as jnp

from mijax.losses.masks import masked_mean


def double_q_value(q_online_t: jax.Array, q_target_t: jax.Array) -> jax.Array:
    """Q_target(s_t, argmax_a Q_online(s_t, a)): (..., A) twice -> (...)."""
    chex.assert_equal_shape([q_online_t, q_target_t])
    return _value_of(q_target_t, jnp.argmax(q_online_t, axis=-1))


def is_greedy(q: jax.Array, action: jax.Array, tolerance: float = 0.0) -> jax.Array:
    """(...) bool: whether an action, (...) int, has a value within `tolerance` of the best of (..., A)."""
    chex.assert_equal_shape_prefix([q, action], action.ndim)
    return _value_of(q, action) >= jnp.max(q, axis=-1) - tolerance


def td_loss(
    q_tm1: jax.Array, a_tm1: jax.Array, target_tm1: jax.Array, mask: jax.Array
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """E[ (target - Q(h, a))^2 ] over valid transitions; no gradient flows into the targets.

    Args:
        q_tm1: (..., A) action values.
        a_tm1: (...) int actions taken.
        target_tm1: (...) regression targets.
        mask: (...) bool, which transitions are real.

    Returns:
        () loss; mean value and mean absolute error.
    """
    chex.assert_equal_shape([a_tm1, target_tm1, mask])
    chex.assert_equal_shape_prefix([q_tm1, mask], mask.ndim)
    chosen = _value_of(q_tm1, a_tm1)
    error = jax.lax.stop_gradient(target_tm1) - chosen
    loss = masked_mean(jnp.square(error), mask)
    return loss, {"q": masked_mean(chosen, mask), "td_error": masked_mean(jnp.abs(error), mask)}


def _value_of(q: jax.Array, action: jax.Array) -> jax.Array:
    """(...) the entries of (..., A) at (...) int actions; those of no action, -1, are of the first."""
    return jnp.take_along_axis(q, jnp.maximum(action, 0)[..., None], axis=-1)[..., 0]

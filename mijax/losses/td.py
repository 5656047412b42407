"""Double Q-learning targets and loss (van Hasselt et al. 2016; paper Appendix A.6)."""

import chex
import jax
import jax.numpy as jnp

from mijax.losses.masks import masked_mean


def double_q_value(q_online_t: jax.Array, q_target_t: jax.Array) -> jax.Array:
    """Q_target(s_t, argmax_a Q_online(s_t, a)): (..., A) twice -> (...)."""
    chex.assert_equal_shape([q_online_t, q_target_t])
    best = jnp.argmax(q_online_t, axis=-1)
    return jnp.take_along_axis(q_target_t, best[..., None], axis=-1)[..., 0]


def watkins_returns(
    r_t: jax.Array, discount_t: jax.Array, v_t: jax.Array, trace_t: jax.Array
) -> jax.Array:
    """Watkins Q(lambda) returns, G_{t-1} = r_t + discount_t ((1 - trace_t) v_t + trace_t G_t), backwards in time.

    With `trace_t` = 0 everywhere this is the one-step target r + gamma (1 - d) v.

    Args:
        r_t: (..., T) reward of each transition.
        discount_t: (..., T) gamma, or 0 where the episode ended.
        v_t: (..., T) bootstrapped value of the state arrived at.
        trace_t: (..., T) lambda where the next action in the data is the greedy one and its transition belongs to the
            same episode, else 0; the last entry must be 0.

    Returns:
        (..., T) targets.
    """
    chex.assert_equal_shape([r_t, discount_t, v_t, trace_t])
    offset = r_t + discount_t * (1 - trace_t) * v_t
    slope = discount_t * trace_t

    def compose(later: tuple[jax.Array, jax.Array], earlier: tuple[jax.Array, jax.Array]):
        return earlier[0] + earlier[1] * later[0], earlier[1] * later[1]

    targets, _ = jax.lax.associative_scan(compose, (offset, slope), reverse=True, axis=r_t.ndim - 1)
    return targets


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
    chosen = jnp.take_along_axis(q_tm1, jnp.maximum(a_tm1, 0)[..., None], axis=-1)[..., 0]
    error = jax.lax.stop_gradient(target_tm1) - chosen
    loss = masked_mean(jnp.square(error), mask)
    return loss, {"q": masked_mean(chosen, mask), "td_error": masked_mean(jnp.abs(error), mask)}

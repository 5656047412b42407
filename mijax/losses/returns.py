"""Targets that look several steps ahead, the same recursion for both algorithms."""

import chex
import jax


def traced_returns(r_t: jax.Array, discount_t: jax.Array, v_t: jax.Array, trace_t: jax.Array) -> jax.Array:
    """G_{t-1} = r_t + discount_t ((1 - trace_t) v_t + trace_t G_t), backwards in time.

    With `trace_t` = 0 everywhere this is the one-step target r + gamma (1 - d) v. What it is otherwise, the trace says:
    Watkins' Q(lambda) where it is cut at actions that are not greedy, Peng's Q(lambda) where it is not.

    Args:
        r_t: (..., T) reward of each transition.
        discount_t: (..., T) gamma, or 0 where the episode ended.
        v_t: (..., T) bootstrapped value of what was arrived at.
        trace_t: (..., T) lambda, or 0 where the return is cut; 0 where the next transition is another episode's, and at
            the last entry.

    Returns:
        (..., T) targets.
    """
    chex.assert_equal_shape([r_t, discount_t, v_t, trace_t])
    offset, slope = r_t + discount_t * (1 - trace_t) * v_t, discount_t * trace_t

    def compose(later: tuple[jax.Array, jax.Array], earlier: tuple[jax.Array, jax.Array]):
        return earlier[0] + earlier[1] * later[0], earlier[1] * later[1]

    targets, _ = jax.lax.associative_scan(compose, (offset, slope), reverse=True, axis=r_t.ndim - 1)
    return targets

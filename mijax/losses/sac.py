"""Soft actor-critic: a Gaussian squashed by tanh, its targets and losses (Haarnoja et al. 2018; paper Appendix A.6)."""

import chex
import jax
import jax.numpy as jnp

from mijax.losses.masks import masked_mean

_LOG_2, _LOG_2_PI = 0.6931471805599453, 1.8378770664093453


def sample_tanh_gaussian(
    mean: jax.Array, log_scale: jax.Array, noise: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """a = tanh(mean + scale noise), and its log density.

    Args:
        mean: (..., A) before squashing.
        log_scale: (..., A) log standard deviation before squashing.
        noise: (..., A) standard normal.

    Returns:
        (..., A) actions in (-1, 1), and (...) log pi(a) in nats.
    """
    chex.assert_equal_shape([mean, log_scale, noise])
    before = mean + jnp.exp(log_scale) * noise
    log_normal = -0.5 * (jnp.square(noise) + _LOG_2_PI) - log_scale
    return jnp.tanh(before), jnp.sum(log_normal - log_slope_of_tanh(before), axis=-1)


def log_slope_of_tanh(x: jax.Array) -> jax.Array:
    """log(1 - tanh(x)^2), exact also where tanh rounds to 1."""
    return 2 * (_LOG_2 - x - jax.nn.softplus(-2 * x))


def critic_loss(q: jax.Array, target: jax.Array, mask: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The sum over the critics of E[ (target - Q_i)^2 ] over valid transitions; no gradient flows into the targets.

    Args:
        q: (K, ...) values of the actions taken, by each critic.
        target: (...)
        mask: (...) bool, which transitions are real.

    Returns:
        () loss; mean value and mean absolute error.
    """
    chex.assert_equal_shape([target, mask])
    chex.assert_equal_shape_suffix([q, target], target.ndim)
    error = jax.lax.stop_gradient(target)[None] - q
    everywhere = jnp.broadcast_to(mask[None], q.shape)
    loss = q.shape[0] * masked_mean(jnp.square(error), everywhere)
    return loss, {"q": masked_mean(q, everywhere), "td_error": masked_mean(jnp.abs(error), everywhere)}


def actor_loss(log_prob: jax.Array, q: jax.Array, temperature: jax.Array, mask: jax.Array) -> jax.Array:
    """E[ alpha log pi(a | h) - min_i Q_i(h, a) ], a drawn from the actor: (...), (K, ...), (), (...) bool -> ()."""
    chex.assert_equal_shape([log_prob, mask])
    return masked_mean(jax.lax.stop_gradient(temperature) * log_prob - jnp.min(q, axis=0), mask)


def imitation_loss(action: jax.Array, demonstrated: jax.Array, mask: jax.Array) -> jax.Array:
    """E[ |a - a*|^2 ]: the actor's mean comes near the demonstrated action. Not the paper's.

    Args:
        action: (..., A) tanh of the mean.
        demonstrated: (..., A) a*.
        mask: (...) bool, the transitions that are imitated.

    Returns:
        () loss.
    """
    chex.assert_equal_shape([action, demonstrated])
    return masked_mean(jnp.sum(jnp.square(action - demonstrated), axis=-1), mask)


def scale_loss(action: jax.Array, log_scale: jax.Array, demonstrated: jax.Array, mask: jax.Array) -> jax.Array:
    """E[ sum_i sg(sigma_i^2) ( sg(a_i - a*_i)^2 / (2 sigma_i^2) + log sigma_i ) ]. Not the paper's.

    The actor's scale is fitted to the distance that imitation leaves: it explores where demonstrations differ, and is
    as precise as they are elsewhere. The beta-NLL of Seitzer et al. (2022) with beta = 1, for the scale alone; sg stops
    gradients. Without sg(sigma^2) the scale's gradient, up to 1 / sigma^2, drowned the mean's: distances of 0.30 in
    place of 0.08 (Drawer-Opening, 2 000 updates).

    Args:
        action: (..., A) tanh of the mean.
        log_scale: (..., A) log sigma, before squashing; where |a| is near 1 the noise of actions is smaller than it.
        demonstrated: (..., A) a*.
        mask: (...) bool, the transitions of demonstrations.

    Returns:
        () loss.
    """
    chex.assert_equal_shape([action, log_scale, demonstrated])
    misfit = jax.lax.stop_gradient(jnp.square(action - demonstrated)) / 2 * jnp.exp(-2 * log_scale) + log_scale
    misfit *= jax.lax.stop_gradient(jnp.exp(2 * log_scale))
    return masked_mean(jnp.sum(misfit, axis=-1), mask)


def temperature_loss(
    log_temperature: jax.Array, log_prob: jax.Array, target_entropy: float, mask: jax.Array
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """log alpha x (entropy - target entropy): alpha rises while the actor's entropy is below its target.

    Args:
        log_temperature: ()
        log_prob: (...) log pi of the actor's own samples; no gradient flows into it.
        target_entropy: in nats.
        mask: (...) bool, which entries count.

    Returns:
        () loss, and the actor's entropy.
    """
    chex.assert_rank(log_temperature, 0)
    entropy = jax.lax.stop_gradient(-masked_mean(log_prob, mask))
    return log_temperature * (entropy - target_entropy), {"entropy": entropy}

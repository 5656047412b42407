"""Pure functions of arrays that return a loss and metrics; they know nothing of agents or environments."""

from mijax.losses.belief import kl_standard_normal, negative_elbo
from mijax.losses.club import club_all_pairs, club_sampled, gaussian_fit, gaussian_log_density
from mijax.losses.dim import dim_jensen_shannon
from mijax.losses.dynamics import next_feature_loss, reward_loss
from mijax.losses.information import (
    cosine,
    cosine_bonus,
    explained_variance_bonus,
    log_likelihood_bonus,
    prediction_cosine,
    prediction_mse,
    variance_nll,
)
from mijax.losses.masks import masked_mean
from mijax.losses.returns import traced_returns
from mijax.losses.sac import (
    actor_loss,
    critic_loss,
    imitation_loss,
    sample_tanh_gaussian,
    scale_loss,
    temperature_loss,
)
from mijax.losses.td import double_q_value, is_greedy, td_loss
from mijax.losses.variables import variables_loss

__all__ = [
    "actor_loss",
    "club_all_pairs",
    "club_sampled",
    "cosine",
    "cosine_bonus",
    "critic_loss",
    "dim_jensen_shannon",
    "double_q_value",
    "explained_variance_bonus",
    "gaussian_fit",
    "gaussian_log_density",
    "imitation_loss",
    "is_greedy",
    "kl_standard_normal",
    "log_likelihood_bonus",
    "masked_mean",
    "negative_elbo",
    "next_feature_loss",
    "prediction_cosine",
    "prediction_mse",
    "reward_loss",
    "sample_tanh_gaussian",
    "scale_loss",
    "td_loss",
    "temperature_loss",
    "traced_returns",
    "variables_loss",
    "variance_nll",
]

"""Pure functions of arrays that return a loss and metrics; they know nothing of agents or environments."""

from mijax.losses.belief import kl_standard_normal, negative_elbo
from mijax.losses.club import club_all_pairs, club_sampled, gaussian_fit, gaussian_log_density
from mijax.losses.dim import dim_jensen_shannon
from mijax.losses.dynamics import next_feature_loss, reward_loss
from mijax.losses.information import (
    cosine,
    cosine_bonus,
    explained_variance_bonus,
    prediction_cosine,
    prediction_mse,
)
from mijax.losses.masks import masked_mean
from mijax.losses.td import double_q_value, td_loss, watkins_returns

__all__ = [
    "club_all_pairs",
    "club_sampled",
    "cosine",
    "cosine_bonus",
    "dim_jensen_shannon",
    "double_q_value",
    "explained_variance_bonus",
    "gaussian_fit",
    "gaussian_log_density",
    "kl_standard_normal",
    "masked_mean",
    "negative_elbo",
    "next_feature_loss",
    "prediction_cosine",
    "prediction_mse",
    "reward_loss",
    "td_loss",
    "watkins_returns",
]

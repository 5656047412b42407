"""Pure functions of arrays that return a loss and metrics; they know nothing of agents or environments."""

from mijax.losses.club import club_all_pairs, club_sampled, gaussian_fit, gaussian_log_density
from mijax.losses.dim import dim_jensen_shannon
from mijax.losses.dynamics import next_feature_loss, reward_loss

__all__ = [
    "club_all_pairs",
    "club_sampled",
    "dim_jensen_shannon",
    "gaussian_fit",
    "gaussian_log_density",
    "next_feature_loss",
    "reward_loss",
]

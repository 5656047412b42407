"""The paper's own stage-2 numbers (Table 2, Appendix A.6 and A.7) in place of ours: `--preset paper`."""

import dataclasses

from configs import ROBOTS
from envs_mjx.registry import plain_name
from mijax.config import Config

CRITIC_LEARNING_RATE = {"sphinx": 3e-5, "carflag_2d": 3e-5}
"""Table 2: 3e-5 on Sphinx and CarFlag-2D, 3e-4 elsewhere."""
INTRINSIC_WEIGHT = {"heaven_hell": 10.0, "sphinx": 10.0, "carflag_2d": 0.0} | dict.fromkeys(ROBOTS, 0.1)
"""Table 2, for the bonus in its cosine form."""
STEPS = {"heaven_hell": 500_000, "sphinx": 500_000, "carflag_2d": 1_000_000} | dict.fromkeys(ROBOTS, 40_000)
"""10 000, 20 000 and 800 episodes of 50 steps."""
EPOCHS = 1000
TABLE_3 = {"heaven_hell": {"episodes": 500},
           "sphinx": {"learning_rate": 1e-3},
           "carflag_2d": {"learning_rate": 1e-3, "lambda_r": 1.0, "lambda_o": 5.0, "lambda_club": 10.0,
                          "lambda_dim_s": 0.0},
           "block_pulling": {"learning_rate": 1e-3, "batch_size": 500, "lambda_r": 10.0, "lambda_s": 0.1,
                             "lambda_club": 10.0, "lambda_dim_s": 0.1},
           "block_pushing": {"learning_rate": 1e-3, "batch_size": 500, "lambda_r": 100.0, "lambda_s": 1.0,
                             "lambda_club": 0.001, "lambda_dim_s": 0.01},
           "drawer_opening": {"learning_rate": 1e-3, "batch_size": 500, "lambda_r": 100.0, "lambda_s": 1.0,
                              "lambda_club": 1.0, "lambda_dim_s": 0.001}}
"""Where a preset's stage 1 is not that of Table 3."""


def paper(config: Config, vector_observation: bool, steps: int | None = None) -> Config:
    """A domain's preset with the paper's networks, losses, schedule, budget and stage 1: 1000 epochs of plain Adam.

    The estimator of CLUB is not the paper's in all: it sees features of variance 1, without which CLUB ran away on
    Heaven-Hell (to -3e18, and to -1e17 with the step size below). Its step size is that of Table 3, of which Appendix
    C.3.1 has a tenth on Heaven-Hell. It is updated five times per update of the encoders, as in the authors' program;
    the paper leaves this open.

    Args:
        config: the preset.
        vector_observation: whether observations are vectors; the embeddings of others are of other widths.
        steps: the budget, of which exploration takes a tenth; None: the paper's.
    """
    domain = plain_name(config.domain)
    steps = STEPS.get(domain, 500_000) if steps is None else steps
    network = dataclasses.replace(
        config.network, layers=1, gru_width=128, critic_hidden=(256, 256), actor_hidden=(256, 256),
        auxiliary_hidden=(128, 128), dropout=0.1, action_embedding=64 if vector_observation else 16,
        observation_embedding=64 if vector_observation or domain in ROBOTS else 100)
    dqn = dataclasses.replace(
        config.dqn, learning_rate=CRITIC_LEARNING_RATE.get(domain, 3e-4), final_learning_rate=1.0, discount=0.99,
        trace_decay=0.0, trace_tolerance=0.0, target_rate=0.005, batch_episodes=64, updates_per_step=0.25,
        warmup_episodes=10, epsilon_steps=max(1, steps // 10), value_bound=0.0, pretrain_updates=0)
    sac = dataclasses.replace(
        config.sac, learning_rate=3e-4, final_learning_rate=1.0, discount=0.99, trace_decay=0.0, target_rate=0.005,
        batch_episodes=64, updates_per_step=1.0, trunk="own", critic_norm=False, demonstration_share=0.0,
        pretrain_updates=0, imitation_weight=0.0, imitate_successes=False, greedy_environments=0, rotated_copies=4,
        replay_steps=100_000)
    information = dataclasses.replace(
        config.information, auxiliary_weight=0.5, auxiliary_in_variances=False,
        intrinsic_weight=INTRINSIC_WEIGHT.get(domain, 10.0), intrinsic_form="cosine", intrinsic_telescopes=False)
    stage1 = dataclasses.replace(
        config.stage1, epochs=EPOCHS, rewarded=0, club_ramp=0.0, warmup=0.0, phi_shrinkage=0.0,
        lower_bound="jensen_shannon", state_bound="jensen_shannon", estimator_view="features",
        final_learning_rate=1.0, **TABLE_3.get(domain, {}))
    return dataclasses.replace(config, steps=steps, network=network, dqn=dqn, sac=sac, information=information,
                               stage1=stage1)

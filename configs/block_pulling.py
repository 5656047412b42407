"""Block-Pulling (paper Appendix B.4, Tables 2 and 3). Trained from 80 demonstrations by `envs_mjx.robot.planner`.

    python -m mijax.train --domain block_pulling

The budget is the paper's: 800 episodes of 50 steps, one update for each, the demonstrations in the replay from the
start, every episode sampled as it was or in one of four turned copies. Dropout is off, so that one pass serves
gradients and targets.
"""

from mijax.config import (
    Config,
    EvaluationConfig,
    InformationConfig,
    NetworkConfig,
    SACConfig,
    SelfPredictionConfig,
    Stage1Config,
)

CONFIG = Config(
    domain="block_pulling",
    steps=40_000,
    num_envs=2,
    stage1=Stage1Config(data="demonstrations", episodes=80, heldout_episodes=80, copies=4, epochs=8, batch_size=100,
                        learning_rate=2e-3, lambda_r=10.0, lambda_s=0.1, lambda_o=1.0, lambda_club=0.01,
                        lambda_dim_s=0.0, lambda_dim_o=1.0),
    network=NetworkConfig(action_embedding=16, observation_embedding=64, dropout=0.0),
    sac=SACConfig(demonstrations=80, rotated_copies=4),
    zp=SelfPredictionConfig(weight=0.1),
    information=InformationConfig(auxiliary_weight=0.5, intrinsic_weight=0.1, intrinsic_form="cosine"),
    evaluation=EvaluationConfig(every=500, episodes=10),
)

"""Block-Pushing (paper Appendix B.4, Tables 2 and 3). Trained from 80 demonstrations by `envs_mjx.robot.planner`.

The grid worlds' learner has discrete actions; SAC, with which the paper trains the robots, is to come.
"""

from mijax.config import Config, EvaluationConfig, InformationConfig, NetworkConfig, Stage1Config

CONFIG = Config(
    domain="block_pushing",
    steps=40_000,
    stage1=Stage1Config(data="demonstrations", episodes=80, heldout_episodes=80, copies=12, epochs=3, batch_size=100,
                        learning_rate=2e-3, lambda_r=10.0, lambda_s=0.1, lambda_o=1.0, lambda_club=0.01,
                        lambda_dim_s=0.0, lambda_dim_o=1.0),
    network=NetworkConfig(action_embedding=16, observation_embedding=64),
    information=InformationConfig(auxiliary_weight=0.5, intrinsic_weight=0.1, intrinsic_form="cosine"),
    evaluation=EvaluationConfig(every=500, episodes=10),
)

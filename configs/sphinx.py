"""Sphinx (paper Appendix B.1, Tables 2 and 3).

    python -m mijax.train --domain sphinx

0.997, 1.000 and 1.001 of the optimum, solved first after 10 000, 11 000 and 7 000 steps (results/sphinx_mi). Ten
minutes a seed on one core, of them four for stage 1.
"""

from mijax.config import Config, DQNConfig, InformationConfig, NetworkConfig, Stage1Config

CONFIG = Config(
    domain="sphinx",
    steps=100_000,
    stage1=Stage1Config(episodes=500, epochs=300, learning_rate=3e-3, lambda_r=10.0, lambda_s=0.5, lambda_o=0.03,
                        lambda_club=0.3, lambda_dim_s=0.0, lambda_dim_o=0.5),
    network=NetworkConfig(action_embedding=16, observation_embedding=48),
    dqn=DQNConfig(warmup_episodes=300, pretrain_updates=500, pretrained_epsilon=0.7, epsilon_steps=60_000),
    information=InformationConfig(intrinsic_weight=1.0),
)

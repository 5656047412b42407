"""Heaven-Hell (paper Appendix B.3, Tables 2 and 3).

    python -m mijax.train --domain heaven_hell

Solved in 5 seeds of 5, first after 1 000 to 3 000 steps, and optimal in every evaluation from 10 000 on
(results/heaven_hell_mi). Five to seven minutes a seed on one core.
"""

from mijax.config import Config, DQNConfig, Stage1Config

CONFIG = Config(
    domain="heaven_hell",
    steps=100_000,
    stage1=Stage1Config(episodes=150, epochs=500, learning_rate=3e-3, lambda_r=10.0, lambda_s=1.0,
                        lambda_o=0.5, lambda_club=1.0, lambda_dim_s=0.0, lambda_dim_o=1.0),
    dqn=DQNConfig(pretrain_updates=800),
)

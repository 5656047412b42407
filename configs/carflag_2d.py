"""CarFlag-2D (paper Appendix B.2, Tables 2 and 3).

    python -m mijax.train --domain carflag_2d
"""

from mijax.config import Config, InformationConfig, NetworkConfig, Stage1Config

CONFIG = Config(
    domain="carflag_2d",
    steps=1_000_000,
    stage1=Stage1Config(episodes=1000, learning_rate=1e-3, lambda_r=1.0, lambda_s=1.0, lambda_o=5.0, lambda_club=10.0,
                        lambda_dim_s=0.0, lambda_dim_o=1.0),
    network=NetworkConfig(action_embedding=16, observation_embedding=48),
    information=InformationConfig(intrinsic_weight=0.0),
)

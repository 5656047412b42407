"""Block-Pushing (paper Appendix B.4): see `configs.robots`.

    python -m mijax.train --domain block_pushing

Success 0.974, 0.964 and 0.964 of 500 episodes in three seeds (results/robots). A quarter of an hour of one core,
and seven minutes for stage 1.
"""

from configs.robots import robot

CONFIG = robot("block_pushing", copies=12, epochs=12, lambda_club=0.1)

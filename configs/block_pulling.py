"""Block-Pulling (paper Appendix B.4): see `configs.robots`.

    python -m mijax.train --domain block_pulling

Success 0.994, 0.996 and 0.982 of 496 episodes, three seeds (results/robots). Half an hour of one core for stage 2,
seven minutes for stage 1.
"""

from configs.robots import robot

CONFIG = robot("block_pulling", copies=4, epochs=20)

"""Block-Pulling (paper Appendix B.4): see `configs.robots`.

    python -m mijax.train --domain block_pulling

Success 0.982, 0.974 and 1.000 of 500 episodes in three seeds, before experts went straight (results/robots). Eleven
minutes of one core, and four for stage 1.
"""

from configs.robots import robot

CONFIG = robot("block_pulling", copies=4, epochs=20)

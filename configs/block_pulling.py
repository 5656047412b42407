"""Block-Pulling (paper Appendix B.4): see `configs.robots`.

    python -m mijax.train --domain block_pulling

Success 0.998, 0.996 and 0.996 of 500 episodes in three seeds (results/robots). Eleven minutes of one core, more where
it is shared, and four to six for stage 1.
"""

from configs.robots import robot

CONFIG = robot("block_pulling", copies=4, epochs=20)

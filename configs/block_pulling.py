"""Block-Pulling (paper Appendix B.4): see `configs.robots`.

    python -m mijax.train --domain block_pulling

Success 0.982 of 500 episodes, one seed (results/robots). A quarter of an hour of one core, and five
minutes for stage 1.
"""

from configs.robots import robot

CONFIG = robot("block_pulling", copies=4, epochs=20)

"""Block-Pulling (paper Appendix B.4): see `configs.robots`.

    python -m mijax.train --domain block_pulling

Measurements: results/robots.
"""

from configs.robots import robot

CONFIG = robot("block_pulling", copies=4, epochs=20)

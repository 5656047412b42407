"""Block-Pushing (paper Appendix B.4): see `configs.robots`.

    python -m mijax.train --domain block_pushing

Not solved: success 0.932 of 500 episodes, one seed (results/robots). Forty minutes of one
core, and six for stage 1.
"""

from configs.robots import robot

CONFIG = robot("block_pushing", copies=12, epochs=12, lambda_club=0.1)

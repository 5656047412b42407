"""Block-Pushing (paper Appendix B.4): see `configs.robots`.

    python -m mijax.train --domain block_pushing

Not solved: 0.47 after 12 600 steps, one seed (results/robots). More than ninety minutes of one core.
"""

from configs.robots import robot

# psi's body does not place cubes and pad well enough: success starts at 0.1 with it, at 0.3 with a trunk that learns.
CONFIG = robot(
    "block_pushing", copies=12, epochs=12, lambda_club=0.1, trunk="shared", updates_per_step=0.3)

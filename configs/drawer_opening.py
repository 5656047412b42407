"""Drawer-Opening (paper Appendix B.4): see `configs.robots`.

    python -m mijax.train --domain drawer_opening

Not solved: success 0.79 of 496 episodes, one seed, encoders of an earlier preset (results/robots). Half an hour of one
core for stage 2, seven minutes for stage 1.
"""

from configs.robots import robot

# Imitation does not fade: as it did, greedy success fell from 0.87 to 0.56 (results/robots).
CONFIG = robot("drawer_opening", copies=6, epochs=14, imitation_final=1.0)

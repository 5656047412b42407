"""Drawer-Opening (paper Appendix B.4): see `configs.robots`.

    python -m mijax.train --domain drawer_opening

Success 0.938 and 0.964 of 496 episodes, two seeds (results/robots). Half an hour of one core, stage 1 included.
"""

from configs.robots import robot

# Imitation does not fade: as it did, greedy success fell from 0.87 to 0.56. Of demonstrations alone it ends at 0.79, of
# the agent's own successes too at 0.94 and 0.96 (results/robots).
CONFIG = robot("drawer_opening", copies=6, epochs=14, imitation_final=1.0, imitate_successes=True)

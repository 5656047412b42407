"""Drawer-Opening (paper Appendix B.4): see `configs.robots`.

    python -m mijax.train --domain drawer_opening

Success 1.000 of 500 episodes in each of three seeds (results/robots). Seven to thirteen minutes of one core, and three
to six for stage 1.
"""

from configs.robots import robot

CONFIG = robot("drawer_opening", copies=6, epochs=14, steps=16_000)

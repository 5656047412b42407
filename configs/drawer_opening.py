"""Drawer-Opening (paper Appendix B.4): see `configs.robots`.

    python -m mijax.train --domain drawer_opening

Success 0.998, 0.986 and 0.996 of 500 episodes in three seeds (results/robots). Seven to thirteen minutes of one core,
and four for stage 1.
"""

from configs.robots import robot

CONFIG = robot("drawer_opening", copies=6, epochs=14, steps=16_000)

"""Drawer-Opening (paper Appendix B.4): see `configs.robots`.

    python -m mijax.train --domain drawer_opening

Measurements: results/robots.
"""

from configs.robots import robot

CONFIG = robot("drawer_opening", copies=6, epochs=14, steps=16_000)

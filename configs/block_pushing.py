"""Block-Pushing (paper Appendix B.4): see `configs.robots`.

    python -m mijax.train --domain block_pushing

Not solved: 0.79 of 500 episodes with other options, one seed (results/robots); this preset was not run to its end.
"""

from configs.robots import robot

CONFIG = robot("block_pushing", copies=12, epochs=12, lambda_club=0.1, lower_bound="variables", imitation_until=1.0,
               imitation_final=0.3, imitate_successes=True)

"""brax's inverted pendulum without its velocities: a policy has to tell them from what it remembers.

    pip install -e '.[robot]'
    python -m mijax.train --domain examples.brax_pendulum:Pendulum --agent base --memory gru --steps 10000

With `--sac.updates-per-step 0.25` that takes five minutes on a busy core, and the pole then stands for 80 of 100 steps,
from 12 at the first evaluation and still rising (one seed).
"""

import jax
from brax import envs

from envs_mjx.adapters.brax import FromBrax
from envs_mjx.base import TimeStep, Variable


class Pendulum(FromBrax):
    """Keep the pole up: +1 a step. Observation (2,): the cart's place and the pole's angle; state (4,): velocities too.

    The episode terminates when the pole leans 0.2 rad; a random policy lasts for a few steps of the 100.
    """

    def __init__(self) -> None:
        super().__init__(
            envs.get_environment("inverted_pendulum", backend="generalized"), horizon=100, name="pendulum",
            observed=(0, 1), variables=(
                Variable("place", hidden=False), Variable("angle", hidden=False),
                Variable("velocity", hidden=True), Variable("angular_velocity", hidden=True)))

    def success(self, timestep: TimeStep) -> jax.Array:
        """() bool: the pole stood to the end; every step is rewarded, so ending early is the failure."""
        return timestep.truncated

"""Three grid worlds in which an agent must gather information before it acts."""

from envs_mjx.grid.carflag_2d import CarFlag2D
from envs_mjx.grid.heaven_hell import HeavenHell
from envs_mjx.grid.sphinx import Sphinx

__all__ = ["CarFlag2D", "HeavenHell", "Sphinx"]

"""What a task tells its scripted expert (paper Appendix C.1); `envs_mjx.robot.planner` is the expert."""

import dataclasses
from typing import NamedTuple

import jax


@dataclasses.dataclass(frozen=True)
class Plan:
    """How one task is worked on. Lengths in metres."""

    hover: float
    """Height from which the gripper goes down."""
    work: float
    """Height at which it pulls or pushes."""
    patience: int
    """Steps of work without motion before it changes over."""
    retreat: tuple[float, float, float, float]
    """The action of the two steps that change over."""
    nearer_first: bool = False
    """Whether it begins with the object that is nearer to the gripper, and not, as the paper's, with either. The hidden
    variable makes nothing of it, and the mean of an actor that imitates both choices goes between the objects."""


class Stroke(NamedTuple):
    """One pull or push, seen from above, in metres."""

    begin: jax.Array  # (2,) x, y where the gripper goes down
    end: jax.Array  # (2,) x, y where it goes from there
    forth: jax.Array  # (2,) of length 1, the way of the object: the fingers are put across it

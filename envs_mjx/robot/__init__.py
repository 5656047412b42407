"""Three robot tasks in MJX, seen from above: two objects that look the same, of which only one can be moved.

The tasks are imported when they are first asked for: a robot's computer without JAX and MuJoCo has the cameras.
"""

import importlib
import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from envs_mjx.robot.block_pulling import BlockPulling
    from envs_mjx.robot.block_pushing import BlockPushing
    from envs_mjx.robot.drawer_opening import DrawerOpening

__all__ = ["BlockPulling", "BlockPushing", "DrawerOpening"]

_MODULES = {"BlockPulling": "block_pulling", "BlockPushing": "block_pushing", "DrawerOpening": "drawer_opening"}


def __getattr__(name: str) -> type:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    except AttributeError as error:  # MuJoCo raises one where it cannot draw: the task would seem not to exist
        raise ImportError(f"{error} (MUJOCO_GL is {os.environ.get('MUJOCO_GL')!r})") from error

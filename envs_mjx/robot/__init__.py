"""Three robot tasks in MJX, seen from above: two objects that look the same, of which only one can be moved."""

from envs_mjx.robot.block_pulling import BlockPulling
from envs_mjx.robot.block_pushing import BlockPushing
from envs_mjx.robot.drawer_opening import DrawerOpening

__all__ = ["BlockPulling", "BlockPushing", "DrawerOpening"]

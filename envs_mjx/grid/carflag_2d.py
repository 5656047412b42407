"""CarFlag-2D (paper Section 4.1 and Fig. 20): look up the flag's cell in the middle, then go there."""

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.base import Variable
from envs_mjx.grid.world import GridState, GridTables, ImageGridWorld, manhattan

_SIZE = 11
_AREA = slice(4, 7)


def _tables() -> GridTables:
    walls = np.zeros((_SIZE, _SIZE), bool)
    area = np.zeros((_SIZE, _SIZE), bool)
    area[_AREA, _AREA] = True
    informs = area.reshape(-1)
    goals = np.flatnonzero(~informs).astype(np.int32)
    at_goal = np.arange(walls.size)[:, None] == goals
    starts = (manhattan(walls.shape)[:, goals] >= 2) & ~informs[:, None]
    return GridTables(walls, goals, at_goal.astype(np.float32), at_goal, informs, starts)


class CarFlag2D(ImageGridWorld):
    """11 x 11, open. The goal is uniform over the 112 cells outside the central 3 x 3 information area.

    The agent starts uniformly on the cells outside the area and at Manhattan distance >= 2 of the goal; +1 on the goal,
    which ends the episode. Observation (11, 11, 2) uint8: the agent's plane, and the goal's plane, empty outside the
    area. State: the same with the goal's plane always filled.
    """

    name = "carflag_2d"
    variables = (Variable("goal_row", hidden=True), Variable("goal_column", hidden=True),
                 Variable("row", hidden=False), Variable("column", hidden=False))
    tables = _tables()

    def ground_truth(self, env_state: GridState) -> jax.Array:
        """(4,) float32: the goal's row and column, the agent's row and column."""
        goal_cell = jnp.asarray(self.tables.goals)[env_state.goal]
        return jnp.stack([*self._row_column(goal_cell), *self._row_column(env_state.cell)])

"""Sphinx (paper Section 4.1 and Fig. 19): pay to learn which corner is the goal, then go there."""

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.base import Variable
from envs_mjx.grid.world import GridState, GridTables, ImageGridWorld, manhattan

_SIZE = 6
_INFORMATION = 0
_CORNERS = np.array([_SIZE - 1, _SIZE * (_SIZE - 1), _SIZE * _SIZE - 1], np.int32)
_COST = 0.2


def _tables() -> GridTables:
    walls = np.zeros((_SIZE, _SIZE), bool)
    rewards = np.zeros((walls.size, 3), np.float32)
    rewards[_CORNERS] = np.eye(3)
    rewards[_INFORMATION] = -_COST
    terminal = np.zeros((walls.size, 3), bool)
    terminal[_CORNERS] = True
    informs = np.arange(walls.size) == _INFORMATION
    starts = (manhattan(walls.shape)[:, _CORNERS] >= 2).all(axis=1, keepdims=True) & ~informs[:, None]
    return GridTables(walls, _CORNERS, rewards, terminal, informs, np.repeat(starts, 3, axis=1))


class Sphinx(ImageGridWorld):
    """6 x 6, open. The goal is one of the corners other than the top-left one, uniformly.

    Reaching any of those three corners ends the episode: +1 if it is the goal, else 0. The top-left cell shows the goal
    and costs 0.2 for every step that ends there, bumping the wall included. The agent starts uniformly on the 26 cells
    that are no corner and at Manhattan distance >= 2 of each of the three. Observation (6, 6, 2) uint8: the agent's
    plane, and the goal's plane, empty unless on the top-left cell. State: the same with the goal's plane always filled.
    """

    name = "sphinx"
    variables = (Variable("goal", hidden=True, num_values=3), Variable("row", hidden=False),
                 Variable("column", hidden=False))
    tables = _tables()

    def ground_truth(self, env_state: GridState) -> jax.Array:
        """(3,) float32: goal (0 top right, 1 bottom left, 2 bottom right), the agent's row and column."""
        return jnp.stack([env_state.goal.astype(jnp.float32), *self._row_column(env_state.cell)])

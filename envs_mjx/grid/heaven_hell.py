"""Heaven-Hell (paper Section 4.1 and Fig. 21): ask the priest which end is heaven, then go there."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.base import ArraySpec, Variable
from envs_mjx.grid.world import GridState, GridTables, GridWorld

_ROWS, _COLUMNS = 5, 7
_PRIEST = 4 * _COLUMNS + 6
_START = 3 * _COLUMNS + 3
_ENDS = np.array([0, 6], np.int32)  # heaven is one of them: 0 left, 1 right


def _tables() -> GridTables:
    walls = np.ones((_ROWS, _COLUMNS), bool)
    walls[0, :] = walls[:, 3] = walls[4, 3:] = False
    rewards = np.zeros((walls.size, 2), np.float32)
    rewards[_ENDS] = [[1, -1], [-1, 1]]
    starts = np.zeros((walls.size, 2), bool)
    starts[_START] = True
    informs = np.arange(walls.size) == _PRIEST
    return GridTables(walls, _ENDS, rewards, rewards != 0, informs, starts)


class HeavenHell(GridWorld):
    """5 rows x 7 columns: the top row, the middle column and the right half of the bottom row are free.

    The agent starts in row 3, column 3. Heaven is the top-left or the top-right corner, with probability 1/2, and hell
    is the other: +1 and -1, both end the episode. The priest stands in row 4, column 6. Observation (3,) float32:
    (column / 6, row / 4, side); side is -1 (heaven left) or +1 (heaven right) on the priest's cell and 0 elsewhere.
    State: the same with the side always shown. The best policy earns 1 in 14 steps.
    """

    name = "heaven_hell"
    observation_spec = ArraySpec((3,))
    state_spec = ArraySpec((3,))
    interface = dataclasses.replace(
        GridWorld.interface, observation="column / 6, row / 4, side of heaven (-1, 1; 0 away from the priest)")
    variables = (Variable("side", hidden=True, num_values=2), Variable("x", hidden=False), Variable("y", hidden=False))
    tables = _tables()

    def __init__(self) -> None:
        super().__init__()
        rows, columns = np.divmod(np.arange(_ROWS * _COLUMNS), _COLUMNS)
        looks = np.empty((rows.size, 3, 3), np.float32)  # (cells, shown, 3)
        looks[..., 0] = columns[:, None] / (_COLUMNS - 1)
        looks[..., 1] = rows[:, None] / (_ROWS - 1)
        looks[..., 2] = 0, -1, 1
        self._looks = looks

    def observe(self, cell: jax.Array, shown: jax.Array) -> jax.Array:
        """(3,) float32."""
        return jnp.asarray(self._looks)[cell, shown]

    def read(self, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Cell and shown, both () int32."""
        x, y, side = jnp.round(observation * jnp.array([_COLUMNS - 1, _ROWS - 1, 1.0])).astype(jnp.int32)
        return y * _COLUMNS + x, jnp.array([1, 0, 2], jnp.int32)[side + 1]

    def ground_truth(self, env_state: GridState) -> jax.Array:
        """(3,) float32: side (0 left, 1 right), column, row."""
        row, column = self._row_column(env_state.cell)
        return jnp.stack([env_state.goal.astype(jnp.float32), column, row])

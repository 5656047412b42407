"""What the grid worlds share: moves on a grid with walls, and dynamics by table look-up.

Cells are numbered row by row from the top left; row 0 is the top and rows increase downwards. Actions are 0 right,
1 up, 2 left, 3 down; a move into a wall or off the grid stays put.
"""

import abc
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs_mjx.base import ArraySpec, DiscreteActions, Environment, Interface, TimeStep

ACTIONS = DiscreteActions(4, ("right", "up", "left", "down"))
_STEPS = ((0, 1), (-1, 0), (0, -1), (1, 0))  # (row, column) of each action


@struct.dataclass
class GridState:
    """Where everything is."""

    cell: jax.Array  # () int32, the agent's cell
    goal: jax.Array  # () int32, the hidden variable: an index into `GridTables.goals`
    time: jax.Array  # () int32, steps since the reset


@dataclasses.dataclass(frozen=True, eq=False)
class GridTables:
    """A grid world, complete: `cells` = rows x columns, `goals` = values of the hidden variable."""

    walls: np.ndarray  # (rows, columns) bool
    goals: np.ndarray  # (goals,) int32, the cell of each goal; all are equally likely
    rewards: np.ndarray  # (cells, goals) float32, for every step that ends on a cell
    terminal: np.ndarray  # (cells, goals) bool, whether arriving there ends the episode
    informs: np.ndarray  # (cells,) bool, the cells that show the goal
    starts: np.ndarray  # (cells, goals) bool, where an episode with that goal may start, uniformly

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        rows, columns = self.walls.shape
        return rows, columns

    @property
    def moves(self) -> np.ndarray:
        """(cells, 4) int32: the cell after each action."""
        rows, columns = self.shape
        table = np.empty((rows, columns, ACTIONS.num), np.int32)
        for row, column, action in np.ndindex(rows, columns, ACTIONS.num):
            to = row + _STEPS[action][0], column + _STEPS[action][1]
            stays = not (0 <= to[0] < rows and 0 <= to[1] < columns) or self.walls[to]
            to = (row, column) if stays else to
            table[row, column, action] = to[0] * columns + to[1]
        return table.reshape(rows * columns, ACTIONS.num)


def manhattan(shape: tuple[int, int]) -> np.ndarray:
    """(cells, cells) int: distances on a grid of (rows, columns) without walls."""
    rows, columns = np.divmod(np.arange(shape[0] * shape[1]), shape[1])
    return np.abs(rows[:, None] - rows) + np.abs(columns[:, None] - columns)


class GridWorld(Environment):
    """A world given by its tables. Subclasses say how a cell and a shown goal look."""

    horizon = 50
    action_spec = ACTIONS
    interface = Interface(action="one cell; a move into a wall stays", frame="rows run down, columns to the right")
    tables: GridTables

    def __init__(self) -> None:
        tables = self.tables
        self._moves = tables.moves
        self._num_starts = tables.starts.sum(0).astype(np.uint32)
        start_lists = np.argsort(~tables.starts.T, axis=1, kind="stable")
        self._starts = start_lists[:, : self._num_starts.max()].astype(np.int32)

    @abc.abstractmethod
    def observe(self, cell: jax.Array, shown: jax.Array) -> jax.Array:
        """(*observation_shape) what is seen on `cell` when goal `shown` - 1 is visible; 0: none is. Both () int32."""

    @abc.abstractmethod
    def read(self, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The inverse of `observe`: cell and shown, both () int32."""

    def reset(self, key: jax.Array) -> tuple[GridState, TimeStep]:
        """Draw a goal uniformly, then a start uniformly among those the goal allows."""
        # One block of threefry gives both draws: generating random bits is the dearest part of these worlds.
        bits = jax.random.bits(key, (2,), jnp.uint32)
        goal = _below(bits[0], jnp.uint32(len(self.tables.goals)))
        start = _below(bits[1], jnp.asarray(self._num_starts)[goal])
        cell = jnp.asarray(self._starts)[goal, start]
        env_state = GridState(cell, goal, jnp.zeros((), jnp.int32))
        return env_state, self._show(env_state, jnp.zeros((), jnp.float32), jnp.zeros((), bool))

    def step(self, key: jax.Array, env_state: GridState, action: jax.Array) -> tuple[GridState, TimeStep]:
        """Move, deterministically: the key is ignored."""
        del key
        cell = jnp.asarray(self._moves)[env_state.cell, action]
        moved = env_state.replace(cell=cell, time=env_state.time + 1)  # pyright: ignore[reportAttributeAccessIssue]
        reward = jnp.asarray(self.tables.rewards)[cell, env_state.goal]
        terminated = jnp.asarray(self.tables.terminal)[cell, env_state.goal]
        return moved, self._show(moved, reward, terminated)

    def reveals(self, env_state: GridState) -> jax.Array:
        """() bool: whether the agent stands on an information cell."""
        return jnp.asarray(self.tables.informs)[env_state.cell]

    def all_observations(self) -> np.ndarray:
        """Every cell but the walls with no goal shown, and every information cell with each goal."""
        tables = self.tables
        open_cells = np.flatnonzero(~tables.walls.reshape(-1))
        goals = np.arange(1, len(tables.goals) + 1)
        pairs = [(cell, shown) for cell in open_cells for shown in (goals if tables.informs[cell] else (0,))]
        cells, shown = np.array(pairs, np.int32).T
        return np.asarray(jax.jit(jax.vmap(self.observe))(cells, shown))

    def _show(self, env_state: GridState, reward: jax.Array, terminated: jax.Array) -> TimeStep:
        goal_shown = env_state.goal + 1
        return TimeStep(
            observation=self.observe(env_state.cell, jnp.where(self.reveals(env_state), goal_shown, 0)),
            state=self.observe(env_state.cell, goal_shown),
            reward=reward,
            terminated=terminated,
            truncated=(env_state.time >= self.horizon) & ~terminated,
        )

    def _row_column(self, cell: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Both () float32, in cells from the top left."""
        columns = self.tables.shape[1]
        return (cell // columns).astype(jnp.float32), (cell % columns).astype(jnp.float32)


class ImageGridWorld(GridWorld):
    """A world seen as (rows, columns, 2) uint8: plane 0 the agent, plane 1 the goal, empty when not shown."""

    interface = dataclasses.replace(
        GridWorld.interface, observation="channel 0: 1 where the agent is; channel 1: 1 where the goal is, if shown")

    def __init__(self) -> None:
        super().__init__()
        assert self.tables.walls.size < 256
        self.observation_spec = self.state_spec = ArraySpec((*self.tables.shape, 2), np.uint8)
        # Cells are uint8 here, of which a CPU compares four times as many at once as of int32.
        no_cell = self.tables.walls.size  # marks no pixel: an empty plane
        self._goal_of_shown = np.append(no_cell, self.tables.goals).astype(np.uint8)
        self._cell_of_pixel = np.repeat(np.arange(self.tables.walls.size, dtype=np.uint8), 2)
        self._is_goal_plane = np.arange(2 * self.tables.walls.size) % 2 == 1
        self._shown_of_goal = np.zeros(self.tables.walls.size, np.int32)
        self._shown_of_goal[self.tables.goals] = np.arange(1, len(self.tables.goals) + 1)

    def observe(self, cell: jax.Array, shown: jax.Array) -> jax.Array:
        """(rows, columns, 2) uint8, ones where agent and goal are."""
        # One comparison for both planes, interleaved: stacking two takes 2.5 times as long (measured, CPU).
        marked = jnp.where(self._is_goal_plane, jnp.asarray(self._goal_of_shown)[shown], cell.astype(jnp.uint8))
        return (marked == self._cell_of_pixel).astype(jnp.uint8).reshape(self.observation_spec.shape)

    def read(self, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Cell and shown, both () int32."""
        agent, goal = jnp.moveaxis(observation.reshape(-1, 2), -1, 0)
        shown = jnp.where(goal.any(), jnp.asarray(self._shown_of_goal)[jnp.argmax(goal)], 0)
        return jnp.argmax(agent).astype(jnp.int32), shown


def _below(bits: jax.Array, bound: jax.Array) -> jax.Array:
    """() int32 in [0, bound) from 24 of 32 random bits; bound <= 256, so the bias is below 2e-5."""
    return (((bits >> 8) * bound) >> 24).astype(jnp.int32)

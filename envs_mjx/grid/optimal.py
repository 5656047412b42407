"""The best that an agent without the state can do in a grid world, by exact planning over beliefs.

Convention: the discounted return of an episode is sum_t discount^t r_{t+1}, so the reward of the first step is not
discounted. Planning uses at most 1 - 1e-6, which breaks ties in favour of short episodes; the plan is then evaluated
exactly, over every start and goal, at the discount that was asked for.

An episode has two phases. Until the goal is shown nothing is learned, except that it is not among the visited cells;
what is seen does not depend on the goal, so this phase is a fixed sequence of actions per start. Afterwards the task is
fully observed.

* Heaven-Hell, Sphinx: cells that are not ends tell nothing, so the belief is the prior until the goal is shown, and
  backward induction over (cell, time) is exact.
* CarFlag-2D: visited cells are ruled out, so the belief is the set of visited cells. A walk that reaches information
  cell c after L steps is worth what it would be if no visited cell could be the goal, plus, per newly visited cell, the
  gain of finding the goal there at once. The gains are summed per cell, so a walk's value is additive apart from
  revisits; counting these again gives an upper bound by dynamic programming over (cell, steps to go, c). If for every
  start the maximising walk visits no cell twice, and exceeds what walks that never reach the area can earn, then the
  bound is reached and the plan is optimal. `plan` returns None when this certificate fails.

For CarFlag-2D the certificate holds at discounts from 0.7 to 1 (at 0.5 it fails), the best walk always being a shortest
path to the area.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs_mjx.base import Environment
from envs_mjx.grid.world import GridTables, GridWorld

_MAX_PLANNING_DISCOUNT = 1 - 1e-6


@dataclasses.dataclass(frozen=True)
class Optimum:
    """Expectations over starts and goals of the belief-optimal policy."""

    discounted_return: float
    undiscounted_return: float
    length: float
    """Steps per episode."""
    success: float
    """Probability that the episode ends rewarded."""


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """A belief-optimal policy."""

    search: np.ndarray  # (cells, horizon) int8, actions of an episode from that start until the goal is shown
    exploit: np.ndarray  # (horizon, cells, goals) int8, action by time once the goal is known


def optimum(env: Environment, discount: float = 0.99) -> Optimum | None:
    """The belief-optimal returns and length in `env`; None when they are not known exactly."""
    best = plan(env, discount)
    return None if best is None or not isinstance(env, GridWorld) else evaluate(env, best, discount)


def plan(env: Environment, discount: float = 0.99) -> Plan | None:
    """The belief-optimal policy of `env`; None when `env` is not a grid world that can be planned exactly."""
    if not isinstance(env, GridWorld):
        return None
    discount = min(discount, _MAX_PLANNING_DISCOUNT)
    values, exploit = _plan_known(env.tables, env.horizon, discount)
    ends = env.tables.terminal
    if (ends == ends[:, :1]).all() and (env.tables.starts == env.tables.starts[:, :1]).all():
        search = _search_with_constant_belief(env.tables, values, discount)
    elif (env.tables.rewards == ends).all() and (ends.sum(0) == 1).all():
        search = _search_ruling_out_cells(env.tables, values, discount)
    else:
        return None
    return None if search is None else Plan(search.astype(np.int8), exploit.astype(np.int8))


def _plan_known(tables: GridTables, horizon: int, discount: float) -> tuple[np.ndarray, np.ndarray]:
    """Values (horizon + 1, cells, goals) and best actions (horizon, cells, goals) by time, when the goal is known."""
    moves = tables.moves
    values = np.zeros((horizon + 1, *tables.rewards.shape))
    actions = np.zeros((horizon, *tables.rewards.shape), int)
    for time in reversed(range(horizon)):
        arriving = tables.rewards + discount * np.where(tables.terminal, 0, values[time + 1])
        choices = arriving[moves]  # (cells, 4, goals)
        actions[time], values[time] = choices.argmax(1), choices.max(1)
    return values, actions


def _search_with_constant_belief(tables: GridTables, known_values: np.ndarray, discount: float) -> np.ndarray:
    """(cells, horizon) actions per start, when no cell rules out a goal without ending the episode or showing it."""
    moves, num_cells = tables.moves, tables.walls.size
    horizon = len(known_values) - 1
    policy = np.zeros((horizon, num_cells), int)
    unknown = np.zeros(num_cells)
    for time in reversed(range(horizon)):
        later = np.where(tables.informs[:, None], known_values[time + 1], unknown[:, None])
        arriving = (tables.rewards + discount * np.where(tables.terminal, 0, later)).mean(1)
        policy[time], unknown = arriving[moves].argmax(1), arriving[moves].max(1)
    search = np.zeros((num_cells, horizon), int)
    cells = np.arange(num_cells)
    for time in range(horizon):
        search[:, time] = policy[time, cells]
        cells = moves[cells, search[:, time]]
    return search


def _search_ruling_out_cells(tables: GridTables, known_values: np.ndarray, discount: float) -> np.ndarray | None:
    """(cells, horizon) actions per start, when the goal ends the episode and is worth 1; None if not certified."""
    horizon = len(known_values) - 1
    joint = tables.starts / tables.starts.sum(0)
    search = np.zeros((tables.walls.size, horizon), int)
    entries = np.flatnonzero(tables.informs)
    value_from_entry = np.zeros((len(entries), tables.walls.size))
    value_from_entry[:, tables.goals] = known_values[0, entries]
    for start in map(int, np.flatnonzero(joint.sum(1))):
        belief = np.zeros(tables.walls.size)  # probability that the goal is here
        belief[tables.goals] = joint[start] / joint[start].sum()
        walk = _best_walk(tables, start, entries, value_from_entry, belief, horizon, discount)
        if walk is None:
            return None
        search[start, : len(walk)] = walk
    return search


def _best_walk(tables: GridTables, start: int, entries: np.ndarray, value_from_entry: np.ndarray, belief: np.ndarray,
               horizon: int, discount: float) -> list[int] | None:
    """Actions of the best walk from `start` to an information cell; None if it is not certified to be the best.

    Args:
        entries: (entries,) the information cells.
        value_from_entry: (entries, cells) value of standing on the information cell with the goal known to be there.
        belief: (cells,) probability of the goal.
    """
    moves = tables.moves
    to_go = np.full((len(entries), tables.walls.size), -np.inf)
    to_go[np.arange(len(entries)), entries] = value_from_entry @ belief
    totals, choices = np.full((horizon + 1, len(entries)), -np.inf), np.zeros((horizon + 1, *to_go.shape), int)
    for steps in range(1, horizon + 1):
        gain = belief * (1 - discount**steps * value_from_entry)
        arriving = (gain + discount * to_go)[:, moves]  # (entries, cells, 4)
        choices[steps], to_go = arriving.argmax(2), np.where(tables.informs, -np.inf, arriving.max(2))
        totals[steps] = to_go[:, start]
    length, entry = np.unravel_index(totals.argmax(), totals.shape)
    cells, actions = [start], []
    for steps in range(int(length), 0, -1):
        actions.append(int(choices[steps, entry, cells[-1]]))
        cells.append(int(moves[cells[-1], actions[-1]]))
    never_entering = np.sort(belief)[::-1][:horizon] @ discount ** np.arange(min(horizon, len(belief)))
    enough_time = length + tables.walls.shape[0] + tables.walls.shape[1] <= horizon
    certified = len(set(cells)) == len(cells) and totals.max() > never_entering and enough_time
    return actions if certified else None


def evaluate(env: GridWorld, policy: Plan, discount: float) -> Optimum:
    """What `policy` earns in `env`, exactly: every start and goal is played once and weighted."""
    tables, moves = env.tables, env.tables.moves
    starts, goals = np.nonzero(tables.starts)
    weights = 1 / tables.starts.sum(0)[goals] / len(tables.goals)
    cells, known, running = starts, tables.informs[starts], np.ones(len(starts), bool)
    discounted, undiscounted, length, success = np.zeros((4, len(starts)))
    for time in range(env.horizon):
        actions = np.where(known, policy.exploit[time, cells, goals], policy.search[starts, time])
        cells = np.where(running, moves[cells, actions], cells)
        rewards = np.where(running, tables.rewards[cells, goals].astype(float), 0)
        discounted += discount**time * rewards
        undiscounted += rewards
        length += running
        ended = running & tables.terminal[cells, goals]
        success += ended & (rewards > 0)
        known, running = known | tables.informs[cells], running & ~ended
    return Optimum(*(float(weights @ values) for values in (discounted, undiscounted, length, success)))


@struct.dataclass
class PolicyMemory:
    """What the optimal policy remembers."""

    start: jax.Array  # () int32, cell of the first observation
    shown: jax.Array  # () int32, the goal + 1 once it was shown, else 0
    time: jax.Array  # () int32


class OptimalPolicy:
    """Plays a `Plan` from observations alone."""

    def __init__(self, env: GridWorld, policy: Plan) -> None:
        self._env, self._plan = env, policy

    def initial_memory(self) -> PolicyMemory:
        """Before the first observation."""
        zero = jnp.zeros((), jnp.int32)
        return PolicyMemory(zero, zero, zero)

    def act(self, memory: PolicyMemory, observation: jax.Array) -> tuple[jax.Array, PolicyMemory]:
        """() int32 action after `observation`, and the memory that includes it."""
        cell, shown = self._env.read(observation)
        start = jnp.where(memory.time == 0, cell, memory.start)
        known = jnp.where(shown > 0, shown, memory.shown)
        search = jnp.asarray(self._plan.search)[start, memory.time]
        exploit = jnp.asarray(self._plan.exploit)[memory.time, cell, known - 1]
        action = jnp.where(known > 0, exploit, search).astype(jnp.int32)
        return action, PolicyMemory(start, known, memory.time + 1)

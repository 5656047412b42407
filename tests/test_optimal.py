"""Belief-optimal returns against closed forms, brute force, and what the policy earns in the environment."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.grid import CarFlag2D, HeavenHell, Sphinx, optimal
from envs_mjx.grid.world import GridTables, GridWorld, ImageGridWorld, manhattan


def test_heaven_hell_closed_form() -> None:
    best = optimal.optimum(HeavenHell(), 0.99)
    assert best is not None
    assert best.discounted_return == pytest.approx(0.99**13)
    assert (best.undiscounted_return, best.length, best.success) == pytest.approx((1, 14, 1))


@pytest.mark.parametrize("discount", [0.5, 0.85, 0.95, 0.99, 1.0])
def test_sphinx_closed_form(discount: float) -> None:
    env = Sphinx()
    distance = manhattan((6, 6))
    starts = np.flatnonzero(env.tables.starts[:, 0])
    to_information, to_corner = distance[starts, 0], distance[starts][:, env.tables.goals].min(1)
    assert len(starts) == 26
    blind = discount ** (to_corner - 1.0) / 3
    afterwards = (2 * discount**5 + discount**10) / 3
    informed = discount ** (to_information - 1.0) * (afterwards - 0.2)
    best = optimal.optimum(env, discount)
    assert best is not None
    assert best.discounted_return == pytest.approx(np.maximum(blind, informed).mean(), abs=1e-6)
    if discount >= 0.95:  # always worth asking: 5, 5 or 10 steps from there
        assert best.length == pytest.approx(to_information.mean() + 20 / 3)
        assert best.undiscounted_return == pytest.approx(0.8)


class _SmallCarFlag(ImageGridWorld):
    """3 x 5 with one information cell in the middle: small enough to enumerate sets of visited cells."""

    name = "small_carflag"
    horizon = 14

    def __init__(self) -> None:
        walls = np.zeros((3, 5), bool)
        informs = np.arange(15) == 7
        goals = np.flatnonzero(~informs).astype(np.int32)
        at_goal = np.arange(15)[:, None] == goals
        starts = (manhattan((3, 5))[:, goals] >= 2) & ~informs[:, None]
        self.tables = GridTables(walls, goals, at_goal.astype(np.float32), at_goal, informs, starts)
        super().__init__()


def _brute_force(env: GridWorld, discount: float) -> float:
    """Planning over (cell, goals not ruled out, time); an episode's value once the goal is known is its distance."""
    tables, distance = env.tables, manhattan(env.tables.shape)
    joint = tables.starts / tables.starts.sum(0) / len(tables.goals)
    total = 0.0
    for start in map(int, np.flatnonzero(joint.sum(1))):
        weights = {int(goal): joint[start, i] for i, goal in enumerate(tables.goals) if joint[start, i] > 0}

        @functools.cache
        def value(cell: int, left: frozenset[int], time: int, weights=weights) -> float:
            if time == env.horizon or not left:
                return 0.0
            choices = []
            for to in set(tables.moves[cell].tolist()):
                rest = left - {to}
                found = weights[to] if to in left else 0.0
                if tables.informs[to]:
                    found += sum(weights[goal] * discount ** int(distance[to, goal]) for goal in rest
                                 if time + 1 + distance[to, goal] <= env.horizon)
                else:
                    found += discount * value(to, rest, time + 1)
                choices.append(found)
            return max(choices)

        total += value(start, frozenset(weights), 0)
    return total


def test_ruling_out_cells_against_brute_force() -> None:
    env = _SmallCarFlag()
    best = optimal.optimum(env, 0.9)
    assert best is not None
    assert best.discounted_return == pytest.approx(_brute_force(env, 0.9), abs=1e-9)


def test_carflag_between_bounds() -> None:
    env = CarFlag2D()
    best = optimal.optimum(env, 0.99)
    assert best is not None
    assert best.success == pytest.approx(1)
    distance = manhattan((11, 11))
    starts, goals = np.nonzero(env.tables.starts)
    weights = 1 / env.tables.starts.sum(0)[goals] / 112
    cells = env.tables.goals[goals]
    area = np.flatnonzero(env.tables.informs)
    knowing = weights @ 0.99 ** (distance[starts, cells] - 1.0)
    nearest = area[distance[starts][:, area].argmin(1)]
    no_luck = weights @ 0.99 ** (distance[starts, nearest] + distance[nearest, cells] - 1.0)
    assert no_luck < best.discounted_return < knowing
    assert best.discounted_return == pytest.approx(no_luck, abs=0.01)


def test_none_when_unknown() -> None:
    assert optimal.optimum(CarFlag2D(), 0.5) is None
    assert optimal.optimum(object(), 0.99) is None  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("env", [HeavenHell(), Sphinx(), CarFlag2D()], ids=lambda env: env.name)
def test_policy_earns_its_plan(env: GridWorld) -> None:
    discount, num = 0.99, 4000
    best, plan = optimal.optimum(env, discount), optimal.plan(env, discount)
    assert best is not None
    assert plan is not None
    policy = optimal.OptimalPolicy(env, plan)

    def play(key):
        env_state, timestep = env.reset(key)

        def step(carry, time):
            env_state, timestep, memory, over, totals = carry
            action, memory = policy.act(memory, timestep.observation)
            env_state, timestep = env.step(key, env_state, action)
            success = (timestep.done & env.success(timestep)).astype(jnp.float32)
            gained = jnp.stack([discount**time * timestep.reward, timestep.reward, jnp.float32(1), success])
            totals = totals + jnp.where(over, 0, gained)
            return (env_state, timestep, memory, over | timestep.done, totals), None

        start = (env_state, timestep, policy.initial_memory(), jnp.bool_(False), jnp.zeros(4))
        return jax.lax.scan(step, start, jnp.arange(env.horizon, dtype=jnp.float32))[0][-1]

    totals = np.asarray(jax.jit(jax.vmap(play))(jax.random.split(jax.random.key(0), num)))
    tolerance = 4 * totals.std(0) / np.sqrt(num) + 1e-4
    planned = np.array([best.discounted_return, best.undiscounted_return, best.length, best.success])
    assert (np.abs(totals.mean(0) - planned) <= tolerance).all(), (totals.mean(0), planned)

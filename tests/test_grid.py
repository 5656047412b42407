"""The three grid worlds against numbers worked by hand, and their drawings."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from envs_mjx.base import Environment
from envs_mjx.grid import CarFlag2D, HeavenHell, Sphinx, draw
from envs_mjx.grid.world import GridState, GridWorld

RIGHT, UP, LEFT, DOWN = range(4)
KEY = jax.random.key(0)
WORLDS = pytest.mark.parametrize("env", [HeavenHell(), Sphinx(), CarFlag2D()], ids=lambda env: env.name)


def at(env: GridWorld, row: int, column: int, goal: int, time: int = 0) -> GridState:
    cell = row * env.tables.shape[1] + column
    return GridState(jnp.int32(cell), jnp.int32(goal), jnp.int32(time))


def walk(env: GridWorld, env_state: GridState, actions: list[int]):
    """The last state and every time step."""
    step, timesteps = jax.jit(env.step), []
    for action in actions:
        env_state, timestep = step(KEY, env_state, jnp.int32(action))
        timesteps.append(timestep)
    return env_state, timesteps


def place(env: GridWorld, env_state: GridState) -> tuple[int, int]:
    row, column = divmod(int(env_state.cell), env.tables.shape[1])
    return row, column


@pytest.mark.parametrize(("goal", "turn", "reward"), [(0, LEFT, 1), (0, RIGHT, -1), (1, RIGHT, 1), (1, LEFT, -1)])
def test_heaven_hell_by_hand(goal: int, turn: int, reward: float) -> None:
    env = HeavenHell()
    start, first = env.reset(jax.random.key(3))
    assert place(env, start) == (3, 3)
    np.testing.assert_allclose(first.observation, [0.5, 0.75, 0])
    _, seen = walk(env, at(env, 3, 3, goal), [DOWN, *[RIGHT] * 3, *[LEFT] * 3, *[UP] * 4, *[turn] * 3])
    side = 2 * goal - 1
    np.testing.assert_allclose(seen[0].observation, [0.5, 1, 0])
    np.testing.assert_allclose(seen[3].observation, [1, 1, side])
    np.testing.assert_allclose(seen[4].observation, [5 / 6, 1, 0])
    np.testing.assert_allclose(seen[4].state, [5 / 6, 1, side])
    assert [float(t.reward) for t in seen] == [0] * 13 + [reward]
    assert [bool(t.terminated) for t in seen] == [False] * 13 + [True]
    assert bool(env.success(seen[-1])) == (reward > 0)


def test_heaven_hell_walls() -> None:
    env = HeavenHell()
    for row, column, action in [(3, 3, LEFT), (3, 3, RIGHT), (4, 3, LEFT), (4, 3, DOWN), (4, 5, UP), (0, 2, DOWN)]:
        assert place(env, walk(env, at(env, row, column, 0), [action])[0]) == (row, column)
    assert (~env.tables.walls).sum() == 14
    np.testing.assert_array_equal(env.ground_truth(at(env, 0, 5, 1)), [1, 5, 0])


def test_sphinx_by_hand() -> None:
    env = Sphinx()
    end, seen = walk(env, at(env, 0, 2, 1), [LEFT, LEFT, UP, LEFT, DOWN])
    assert place(env, end) == (1, 0)
    np.testing.assert_allclose([float(t.reward) for t in seen], [0, -0.2, -0.2, -0.2, 0])
    expected = np.zeros((6, 6, 2), np.uint8)
    expected[0, 0, 0] = expected[5, 0, 1] = 1
    np.testing.assert_array_equal(seen[1].observation, expected)
    np.testing.assert_array_equal(seen[1].state, expected)
    assert int(seen[0].observation.sum()) == int(seen[4].observation.sum()) == 1
    assert seen[4].observation[1, 0, 0] == seen[4].state[5, 0, 1] == 1
    np.testing.assert_array_equal(env.ground_truth(end), [1, 1, 0])
    for goal in range(3):
        for corner, (row, column, action) in enumerate([(0, 4, RIGHT), (4, 0, DOWN), (5, 4, RIGHT)]):
            _, (timestep,) = walk(env, at(env, row, column, goal), [action])
            assert timestep.terminated
            assert float(timestep.reward) == (corner == goal) == bool(env.success(timestep))


def test_sphinx_starts() -> None:
    starts = Sphinx().tables.starts[:, 0].reshape(6, 6).astype(int)
    np.testing.assert_array_equal(starts, [
        [0, 1, 1, 1, 0, 0],
        [1, 1, 1, 1, 1, 0],
        [1, 1, 1, 1, 1, 1],
        [1, 1, 1, 1, 1, 1],
        [0, 1, 1, 1, 1, 0],
        [0, 0, 1, 1, 0, 0],
    ])


def test_carflag_by_hand() -> None:
    env = CarFlag2D()
    assert len(env.tables.goals) == 112
    goal = int(np.flatnonzero(env.tables.goals == 2 * 11 + 8)[0])
    end, seen = walk(env, at(env, 4, 2, goal), [RIGHT, RIGHT, UP, UP, *[RIGHT] * 4])
    assert place(env, end) == (2, 8)
    plane = np.zeros((11, 11), np.uint8)
    plane[2, 8] = 1
    for index, timestep in enumerate(seen):
        assert int(timestep.observation[..., 1].sum()) == (index == 1)
        np.testing.assert_array_equal(timestep.state[..., 1], plane)
        np.testing.assert_array_equal(timestep.observation[..., 0], timestep.state[..., 0])
    assert seen[1].observation[4, 4, 0] == seen[1].observation[2, 8, 1] == 1
    assert [float(t.reward) for t in seen] == [0] * 7 + [1]
    assert [bool(t.terminated) for t in seen] == [False] * 7 + [True]
    np.testing.assert_array_equal(env.ground_truth(at(env, 4, 2, goal)), [2, 8, 4, 2])
    assert len(env.all_observations()) == 112 + 9 * 112


def test_carflag_starts() -> None:
    starts, goals = CarFlag2D().tables.starts, list(CarFlag2D().tables.goals)
    # Excluded besides the goal itself: 4 neighbours in the open, 2 of a corner, 3 of an edge or beside the area.
    for cell, count in [(2 * 11 + 2, 112 - 5), (0, 112 - 3), (5, 112 - 4), (5 * 11 + 7, 112 - 4)]:
        assert starts[:, goals.index(cell)].sum() == count
    assert not starts[[4 * 11 + 4, 5 * 11 + 5, 6 * 11 + 6]].any()


@WORLDS
def test_resets_are_uniform(env: GridWorld) -> None:
    num = 20_000
    states, _ = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), num))
    drawn = np.zeros(env.tables.starts.shape)
    np.add.at(drawn, (np.asarray(states.cell), np.asarray(states.goal)), 1)
    assert not drawn[~env.tables.starts].any()
    expected = num * env.tables.starts / env.tables.starts.sum(0) / len(env.tables.goals)
    for axis in (0, 1):  # by goal, by start
        mean = expected.sum(axis)
        assert (np.abs(drawn.sum(axis) - mean) <= 5 * np.sqrt(mean)).all()


@WORLDS
def test_read_inverts_observe(env: GridWorld) -> None:
    cells = np.flatnonzero(~env.tables.walls.reshape(-1))
    cells, shown = (x.reshape(-1) for x in np.meshgrid(cells, np.arange(len(env.tables.goals) + 1)))
    cells, shown = cells.astype(np.int32), shown.astype(np.int32)
    read_cells, read_shown = jax.jit(lambda c, s: jax.vmap(env.read)(jax.vmap(env.observe)(c, s)))(cells, shown)
    np.testing.assert_array_equal(read_cells, cells)
    np.testing.assert_array_equal(read_shown, shown)


def exact_random_success(env: GridWorld) -> float:
    """The absorbing Markov chain of the uniform policy, in NumPy."""
    tables, moves = env.tables, env.tables.moves
    at_cell = tables.starts / tables.starts.sum(0) / len(tables.goals)
    success = 0.0
    for _ in range(env.horizon):
        arriving = np.zeros_like(at_cell)
        for action in range(4):
            np.add.at(arriving, moves[:, action], at_cell / 4)
        success += arriving[tables.terminal & (tables.rewards > 0)].sum()
        at_cell = np.where(tables.terminal, 0, arriving)
    return success


@pytest.mark.parametrize(("env", "reference"), [(HeavenHell(), 0.148), (Sphinx(), 0.234), (CarFlag2D(), 0.175)],
                         ids=lambda value: getattr(value, "name", ""))
def test_random_policy_success(env: GridWorld, reference: float) -> None:
    num = 10_000

    def play(key):
        key_reset, key_actions = jax.random.split(key)
        env_state, _ = env.reset(key_reset)
        actions = jax.random.randint(key_actions, (env.horizon,), 0, 4, jnp.int32)

        def step(carry, action):
            env_state, done, success = carry
            env_state, timestep = env.step(KEY, env_state, action)
            return (env_state, done | timestep.done, success | (~done & env.success(timestep))), None

        return jax.lax.scan(step, (env_state, jnp.bool_(False), jnp.bool_(False)), actions)[0][2]

    rate = np.asarray(jax.jit(jax.vmap(play))(jax.random.split(jax.random.key(2), num))).mean()
    exact = exact_random_success(env)  # 0.1603, 0.2462, 0.1593
    assert rate == pytest.approx(exact, abs=4 * np.sqrt(exact * (1 - exact) / num))
    # The reference program's rates are samples too, and its CarFlag-2D starts where the last episode ended.
    assert exact == pytest.approx(reference, abs=0.02)


def test_text_by_hand() -> None:
    env = HeavenHell()
    assert draw.text(env, at(env, 4, 6, 1, time=4)).splitlines() == [
        "x . . . . . G",
        "# # # . # # #",
        "# # # . # # #",
        "# # # . # # #",
        "# # # . . . A",
        "step 4  reward 0  goal shown",
    ]
    assert draw.text(env, at(env, 0, 0, 1, time=9)).endswith("step 9  reward -1")
    assert draw.text(Sphinx(), at(Sphinx(), 2, 1, 2)).startswith("? . . . . o\n. . . . . .\n. A")


@WORLDS
def test_gif_has_every_frame(env: GridWorld, tmp_path) -> None:
    states = [at(env, 0, column, 0, time=column) for column in range(4)]
    frames = [draw.frame(env, env_state) for env_state in states]
    rows, columns = env.tables.shape
    assert frames[0].shape == (rows * 32 + 23, columns * 32 + 1, 3)
    assert frames[0].dtype == np.uint8
    assert not np.array_equal(frames[0], frames[1])
    draw.save_gif(tmp_path / "episode.gif", frames, fps=5)
    with Image.open(tmp_path / "episode.gif") as image:
        assert getattr(image, "n_frames", 1) == 4
    assert (tmp_path / "episode.gif").stat().st_size < 100_000


def test_drawing_errors(tmp_path) -> None:
    class Other(Environment):
        name = "other"

        def reset(self, key):
            raise NotImplementedError

        def step(self, key, env_state, action):
            raise NotImplementedError

    with pytest.raises(draw.NoDrawing, match="'other' cannot be drawn"):
        draw.frame(Other(), at(HeavenHell(), 0, 0, 0))
    with pytest.raises(ValueError, match="0 frames"):
        draw.save_gif(tmp_path / "empty.gif", [])

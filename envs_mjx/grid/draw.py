"""Episodes of the grid worlds as animated GIFs and as text. Runs on the host, outside compiled code."""

import os
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from envs_mjx.base import Environment
from envs_mjx.errors import UserError
from envs_mjx.grid.world import GridState, GridWorld

_CELL = 32  # pixels
_CAPTION = 22  # pixels
_COLOURS = {
    "#": (70, 70, 78),  # wall
    ".": (250, 250, 247),  # free
    "?": (140, 190, 240),  # information
    "G": (96, 186, 110),  # goal
    "x": (214, 84, 76),  # an end that is punished: hell
    "o": (214, 206, 180),  # an end that is worth nothing: a wrong corner
}
_AGENT, _GRID, _INK, _PAPER = (32, 32, 40), (206, 206, 206), (20, 20, 20), (255, 255, 255)


class NoDrawing(UserError):
    """This environment cannot be drawn."""


def frame(env: Environment, env_state: GridState) -> np.ndarray:
    """(height, width, 3) uint8: walls, information cells, goal, ends, agent, and a caption with step and reward."""
    world, kinds = _layout(env, env_state)
    rows, columns = world.tables.shape
    image = Image.new("RGB", (columns * _CELL + 1, rows * _CELL + 1 + _CAPTION), _PAPER)
    draw = ImageDraw.Draw(image)
    _draw_cells(draw, kinds)
    row, column = divmod(int(env_state.cell), columns)
    x, y, margin = column * _CELL, row * _CELL, _CELL // 4
    draw.ellipse((x + margin, y + margin, x + _CELL - margin, y + _CELL - margin), fill=_AGENT)
    draw.text((4, rows * _CELL + 3), _caption(world, env_state), fill=_INK, font=ImageFont.load_default(size=12))
    return np.asarray(image)


def background(env: Environment, env_state: GridState) -> np.ndarray:
    """(height, width, 3) uint8: the world alone, a square of pixels per cell, to draw a path on."""
    world, kinds = _layout(env, env_state)
    rows, columns = world.tables.shape
    image = Image.new("RGB", (columns * _CELL + 1, rows * _CELL + 1), _PAPER)
    _draw_cells(ImageDraw.Draw(image), kinds)
    return np.asarray(image)[:-1, :-1]


def text(env: Environment, env_state: GridState) -> str:
    """The same as lines of text: A agent, G goal, ? information, x hell, o wrong corner, # wall, . free."""
    world, kinds = _layout(env, env_state)
    row, column = divmod(int(env_state.cell), world.tables.shape[1])
    kinds[row][column] = "A"
    return "\n".join([*(" ".join(line) for line in kinds), _caption(world, env_state)])


def drawable(env: Environment) -> GridWorld:
    """The environment, if it can be drawn.

    Raises:
        NoDrawing: it is no grid world.
    """
    if not isinstance(env, GridWorld):
        raise NoDrawing(f"environment {env.name!r} cannot be drawn, as grid worlds (envs_mjx.grid.world) and robot "
                        "tasks can; for any other: python -m mijax.report RUN --html")
    return env


def letters(env: Environment, env_state: GridState) -> list[str]:
    """The world alone, a string per row: G goal, ? information, x hell, o wrong corner, # wall, . free."""
    return ["".join(line) for line in _layout(env, env_state)[1]]


def save_gif(path: str | os.PathLike[str], frames: Sequence[np.ndarray], fps: float = 4) -> None:
    """Write frames (height, width, 3) uint8 as an animated GIF that loops; the last frame stays for a second."""
    if not frames or fps <= 0:
        raise ValueError(f"save_gif: got {len(frames)} frames at {fps} frames per second, expected at least 1 and > 0")
    images = [Image.fromarray(picture).quantize(64, dither=Image.Dither.NONE) for picture in frames]
    durations = [round(1000 / fps)] * (len(images) - 1) + [1000]  # milliseconds
    images[0].save(path, format="GIF", save_all=True, append_images=images[1:], duration=durations, loop=0)


def _draw_cells(draw: ImageDraw.ImageDraw, kinds: list[list[str]]) -> None:
    for row, line in enumerate(kinds):
        for column, kind in enumerate(line):
            x, y = column * _CELL, row * _CELL
            draw.rectangle((x, y, x + _CELL, y + _CELL), fill=_COLOURS[kind], outline=_GRID)


def _layout(env: Environment, env_state: GridState) -> tuple[GridWorld, list[list[str]]]:
    """The world, and a letter of `_COLOURS` for each of its cells."""
    world = drawable(env)
    tables, goal = world.tables, int(env_state.goal)
    kinds = np.full(tables.walls.size, ".")
    kinds[tables.walls.reshape(-1)] = "#"
    kinds[tables.informs] = "?"
    kinds[tables.terminal[:, goal]] = "o"
    kinds[tables.terminal[:, goal] & (tables.rewards[:, goal] < 0)] = "x"
    kinds[tables.goals[goal]] = "G"
    return world, kinds.reshape(tables.shape).tolist()


def _caption(world: GridWorld, env_state: GridState) -> str:
    time, cell, goal = int(env_state.time), int(env_state.cell), int(env_state.goal)
    reward = float(world.tables.rewards[cell, goal]) if time else 0.0
    shown = "  goal shown" if world.tables.informs[cell] else ""
    return f"step {time}  reward {reward:g}{shown}"

"""An episode of a robot task as pictures: what the policy sees, what the state adds, a rendered view beside them."""

import os
import pathlib
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from envs_mjx.robot import window
from envs_mjx.robot.headless import BACKENDS
from envs_mjx.robot.task import OUTCOMES, RobotState, RobotTask

SIDE = 252  # pixels of a panel, three for each pixel of an image
_CAPTION, _GAP = 22, 4  # pixels
_INK, _PAPER = (20, 20, 20), (255, 255, 255)

_RENDER = """
import pickle, sys
import numpy as np
from envs_mjx import registry
from envs_mjx.robot.view import View
task, size, path = sys.argv[1:]
with open(path, "rb") as file:
    states = pickle.load(file)
view = View(registry.make(task), int(size))
np.save(path + ".npy", np.stack([view.picture(state) for state in states]))
view.close()
"""


def frames(env: RobotTask, states: Sequence[RobotState], pictures: np.ndarray | None) -> list[np.ndarray]:
    """(height, width, 3) uint8 each: depth channel, state channel, and `pictures` beside them if there are any.

    Args:
        env: the task.
        states: moments, on the host.
        pictures: (len(states), SIDE, SIDE, 3) uint8, of `rendered`.
    """
    film = []
    for number, env_state in enumerate(states):
        observation, state = map(np.asarray, env.render(env_state))
        panels = {"depth (observation)": grey(observation[..., 0]),
                  "without the immovable (state)": grey(state[..., 1])}
        if pictures is not None:
            panels["rendered; red moves"] = pictures[number]
        film.append(side_by_side(panels, f"step {int(env_state.time)}  {OUTCOMES[int(env_state.outcome)]}"))
    return film


def rendered(env: RobotTask, states: Sequence[RobotState], size: int = SIDE) -> np.ndarray | None:
    """(len(states), size, size, 3) uint8: views from the side; None where no OpenGL is to be had.

    In a process of its own: MuJoCo binds to one OpenGL for good when it is first imported, and a missing one can end
    the process.
    """
    named = os.environ.get("MUJOCO_GL")
    task = f"{type(env).__module__}:{type(env).__qualname__}"  # that it has a registered name is not certain
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "states"
        path.write_bytes(pickle.dumps(list(states)))
        for backend in (named,) if named else BACKENDS:
            run = subprocess.run(
                [sys.executable, "-c", _RENDER, task, str(size), str(path)], capture_output=True, check=False,
                env={**os.environ, "MUJOCO_GL": backend})
            if run.returncode == 0:
                return np.load(f"{path}.npy")
    return None


def grey(depth: np.ndarray) -> np.ndarray:
    """(SIDE, SIDE, 3) uint8 of (84, 84) metres: near is bright."""
    factor = SIDE // depth.shape[0]
    return np.repeat(np.repeat(window.grey(depth), factor, axis=0), factor, axis=1)[..., None].repeat(3, axis=2)


def side_by_side(panels: dict[str, np.ndarray], caption: str) -> np.ndarray:
    """(height, width, 3) uint8: panels (SIDE, SIDE, 3) with their titles, and a caption below them."""
    width = len(panels) * (SIDE + _GAP) - _GAP
    image = Image.new("RGB", (width, SIDE + 2 * _CAPTION), _PAPER)
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(size=12)
    for index, (title, panel) in enumerate(panels.items()):
        x = index * (SIDE + _GAP)
        draw.text((x + 3, 4), title, fill=_INK, font=font)
        image.paste(Image.fromarray(panel), (x, _CAPTION))
    draw.text((3, SIDE + _CAPTION + 4), caption, fill=_INK, font=font)
    return np.asarray(image)

"""A T-maze written for Gymnasium, stepped on the host: the side of the reward is shown once, at the start.

    pip install -e '.[adapters]'
    python -m mijax.train --domain examples.gymnasium_memory:Maze --steps 20000
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from envs_mjx.adapters.gymnasium import FromGymnasium
from envs_mjx.base import Variable

LENGTH = 6
"""Cells from the start to the fork."""


class TMaze(gymnasium.Env):
    """Walk to the fork and turn to the side that the start has shown: +1 if right, -1 if wrong.

    Actions: 0 forward, 1 turn left, 2 turn right; turns count at the fork alone, and end the episode. Observation (2,):
    place / LENGTH, and the side as -1 or +1 at the start, 0 from then on. `info["state"]` (2,): the same with the side
    always. Best: LENGTH + 1 steps; without memory every turn is a guess.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  (Gymnasium's own convention)
    observation_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = spaces.Discrete(3)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Draw the side."""
        super().reset(seed=seed)
        self._place, self._side = 0, int(self.np_random.integers(2))
        return self._show()

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Walk or turn."""
        turned = self._place == LENGTH and action > 0
        reward = (1.0 if action - 1 == self._side else -1.0) if turned else 0.0
        self._place = min(self._place + int(action == 0), LENGTH)
        observation, info = self._show()
        return observation, reward, turned, False, info

    def _show(self) -> tuple[np.ndarray, dict]:
        place, side = self._place / LENGTH, 2.0 * self._side - 1
        seen = np.array([place, side if self._place == 0 else 0.0], np.float32)
        return seen, {"state": np.array([place, side], np.float32)}


class Maze(FromGymnasium):
    """The T-maze as one of ours: the privileged state tells the side at every step."""

    def __init__(self) -> None:
        super().__init__(TMaze, horizon=20, state="state",
                         variables=(Variable("place", hidden=False), Variable("side", hidden=True)))

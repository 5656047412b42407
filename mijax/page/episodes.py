"""Greedy episodes as the page plays them: what the agent sees, what is true, what it remembers."""

import base64
import io
from typing import Any

import jax
import numpy as np
from PIL import Image

from envs_mjx.base import ArraySpec, DiscreteActions
from envs_mjx.grid import draw
from envs_mjx.grid.world import GridWorld
from mijax.episode import Trace
from mijax.evaluate_robot import is_robot
from mijax.learner import Learner
from mijax.page.numbers import finite

NEAR = " Near is bright."
"""Said of depth images, which are drawn inverted."""
Episodes = dict[str, Any]
"""Some episodes of one run, as JSON has them."""


def episode_data(learner: Learner, trace: Trace, *, seed: int, step: int) -> Episodes:
    """All episodes of a trace.

    Args:
        learner: of the trace.
        trace: N episodes.
        seed: whose they are.
        step: of its checkpoint.
    """
    env = learner.domain
    discrete = isinstance(env.action_spec, DiscreteActions)
    count = trace.q.shape[-1] if discrete else trace.action.shape[-1]
    names = list(env.action_spec.names) or [str(action) for action in range(count)]
    return {
        "seed": seed, "step": step, "weight": learner.config.information.intrinsic_weight,
        "actions": names, "discrete": discrete, "about": env.interface.observation + NEAR * is_robot(env),
        "variables": [{"name": variable.name, "hidden": variable.hidden} for variable in env.variables],
        "episodes": [_episode(learner, trace, index) for index in range(len(trace.length))],
    }


def _episode(learner: Learner, trace: Trace, index: int) -> dict[str, Any]:
    moments = slice(0, int(trace.length[index]) + 1)

    def cut(values: np.ndarray | None) -> Any:
        return None if values is None else finite(values[index][moments])

    shown = {
        "reward": cut(trace.reward), "reveals": trace.reveals[index][moments].tolist(), "action": cut(trace.action),
        "q": cut(trace.q), "bonus": cut(trace.bonus), "explained": cut(trace.explained),
        "explained_by_agent": cut(trace.explained_by_agent), "truth": cut(trace.truth),
        "attention": None if trace.attention is None else _triangles(trace.attention[index][:, moments, moments]),
    }
    return shown | _views(learner, trace, index, moments)


def _triangles(attention: np.ndarray) -> list[list[list[float]]]:
    """(H, L, L) weights -> of each head and token, where it looks among the tokens up to itself."""
    return [[finite(row[: place + 1], 3) for place, row in enumerate(head)] for head in attention]


def _views(learner: Learner, trace: Trace, index: int, moments: slice) -> dict[str, Any]:
    """What is seen and what is true: a grid world by its cells, images as images, anything else as numbers."""
    env = learner.domain
    if isinstance(env, GridWorld):
        env_state = jax.tree.map(lambda x: x[index], trace.env_state)
        told = trace.reveals[index] | (learner.env is not env)  # the second: an agent that is shown the state
        goal = int(env.tables.goals[env_state.goal[0]])
        first = jax.tree.map(lambda x: x[0], env_state)
        return {"grid": {"kinds": draw.letters(env, first), "cells": env_state.cell[moments].tolist(), "goal": goal,
                         "told": told[moments].tolist()}}
    near_is_bright = is_robot(env)
    return {"seen": _view(trace.observation[index][moments], learner.env.observation_spec, near_is_bright),
            "true": _view(trace.state[index][moments], learner.env.state_spec, near_is_bright)}


def _view(arrays: np.ndarray, spec: ArraySpec, near_is_bright: bool) -> dict[str, Any]:
    """`images`: by channel, a PNG per moment; or `numbers`, a list per moment."""
    if not spec.is_image:
        return {"numbers": finite(arrays.reshape(len(arrays), -1), 3)}
    channels = np.moveaxis(arrays[..., : spec.shape[-1] - spec.blank].astype(np.float64), -1, 0)
    return {"images": [_pictures(channel, near_is_bright) for channel in channels]}


def _pictures(frames: np.ndarray, near_is_bright: bool) -> list[str]:
    """(L, rows, columns) -> grey PNGs as base64, from the smallest to the largest number of the episode."""
    low, high = frames.min(), frames.max()
    grey = np.round(255 * (frames - low) / max(high - low, 1e-9)).astype(np.uint8)
    return [_png(255 - frame if near_is_bright else frame) for frame in grey]


def _png(grey: np.ndarray) -> str:
    file = io.BytesIO()
    Image.fromarray(grey).save(file, "PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode()

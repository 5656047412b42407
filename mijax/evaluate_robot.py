"""`python -m mijax.evaluate --planner` and `--random`: a robot task's expert, or random actions, measured."""

import functools
import pathlib
import sys
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeGuard

import jax
import numpy as np

import configs
from envs_mjx import registry
from envs_mjx.base import Environment
from envs_mjx.grid import draw
from mijax.config import ConfigError
from mijax.rollout import Actor
from mijax.types import Params

if TYPE_CHECKING:
    from envs_mjx.robot.task import RobotState, RobotTask
    from envs_mjx.robot.trial import Trial

EPISODE_FILE, PAGE_FILE = "planner.gif", "planner.html"
HALVES = ("movable_first", "immovable_first")
"""Success by what is touched first."""
DEMONSTRATED = ", ".join(configs.ROBOTS)


def is_robot(env: Environment) -> "TypeGuard[RobotTask]":
    """Whether an environment is a robot task. Where none has been made, MuJoCo is not imported for the answer."""
    task = sys.modules.get("envs_mjx.robot.task")
    return task is not None and isinstance(env, task.RobotTask)


def robot(option: str, domain: str) -> "RobotTask":
    """The robot task of that name; `ConfigError` for any other domain, before any work."""
    env = registry.make(domain)
    if not is_robot(env):
        raise ConfigError(f"--domain: got {domain!r}, accepted: with --{option} a robot task: {DEMONSTRATED}")
    return env


def evaluate_planner(
    domain: str, episodes: int, out: pathlib.Path, gif: bool, libraries: pathlib.Path | None, say: Callable[[str], None]
) -> "Trial":
    """Play the scripted expert, half of the episodes with the immovable object first; say what came of it.

    Args:
        domain: a robot task.
        episodes: how many.
        out: folder for the pictures.
        gif: whether to write an episode as `out`/planner.gif.
        libraries: node modules for `out`/planner.html; None: no page.
        say: prints a line.
    """
    env = robot("planner", domain)
    from envs_mjx.robot import page, trial  # MuJoCo is imported with the task only

    scripts = None if libraries is None else page.load_scripts(libraries)
    started = time.perf_counter()
    played = trial.expert_trial(env, jax.random.key(0), episodes)
    say(f"{domain}: {episodes} episodes of the scripted expert in {time.perf_counter() - started:.0f} s")
    assert played.movable_first is not None
    say(f"{'works first on':<22}{'episodes':>9}{'success':>9}{'mean length':>13}{'median':>8}")
    for name, rows in (("the immovable object", ~played.movable_first), ("the movable object", played.movable_first),
                       ("either", np.ones(episodes, bool))):
        if rows.any():
            length = played.length[rows]
            say(f"{name:<22}{rows.sum():>9}{played.success[rows].mean():>9.3f}{length.mean():>13.1f}"
                f"{np.median(length):>8.0f}")
    say(_endings(played))
    moments = played.episode(int(np.argmax(played.success & ~played.movable_first)))
    if gif or scripts is not None:
        out.mkdir(parents=True, exist_ok=True)
    if scripts is not None:
        (out / PAGE_FILE).write_text(page.page(env, moments, scripts))
        say(f"an episode that begins with the immovable object: {out / PAGE_FILE}")
    if gif:
        save_gif(env, moments, out / EPISODE_FILE, say)
        say(f"an episode that begins with the immovable object: {out / EPISODE_FILE}")
    return played


def evaluate_random(domain: str, episodes: int, say: Callable[[str], None]) -> "Trial":
    """Play uniformly random actions; say how the episodes ended and whether anything shown was not finite."""
    env = robot("random", domain)
    from envs_mjx.robot import trial

    started = time.perf_counter()
    played = trial.random_trial(env, jax.random.key(0), episodes)
    say(f"{domain}: {episodes} episodes of random actions in {time.perf_counter() - started:.0f} s, "
        f"mean length {played.length.mean():.1f}")
    say(_endings(played))
    say(f"frames shown with a number that is not finite: {played.not_finite}")
    return played


def evaluate_policy(
    env: "RobotTask", actor: Actor, params: Params, key: jax.Array, episodes: int, discount: float
) -> dict[str, float]:
    """Means over greedy episodes; and success by which object was touched first, the movable or the immovable one, left
    out where that never happened."""
    from envs_mjx.robot import trial

    played = trial.policy_trial(
        env, functools.partial(actor.act, params), actor.initial_memory, actor.no_action, key, episodes)
    assert played.movable_first is not None
    discounted = played.success * discount ** (played.length - 1.0)
    results = {"success": played.success, "return": played.success, "discounted_return": discounted,
               "length": played.length, "reveals": played.touched}
    rows = zip(HALVES, (played.touched & played.movable_first, played.touched & ~played.movable_first), strict=True)
    results |= {name: played.success[which] for name, which in rows if which.any()}
    return {name: float(np.mean(values)) for name, values in results.items()}


def _endings(played: "Trial") -> str:
    return "endings: " + ", ".join(f"{name} {count}" for name, count in played.counts().items())


def save_gif(
    env: "RobotTask", moments: "Sequence[RobotState]", path: pathlib.Path, say: Callable[[str], None]
) -> None:
    """An episode of a robot task as a film: depth, what the state adds, and a rendered view where there is OpenGL."""
    from envs_mjx.robot import film

    pictures = film.rendered(env, moments)
    if pictures is None:
        say("no OpenGL without a display (EGL or OSMesa): the pictures show depth and state, and no rendered view")
    draw.save_gif(path, film.frames(env, moments, pictures))

"""`python -m mijax.evaluate RUN`: greedy episodes of a finished or running run's newest checkpoints.

`python -m mijax.evaluate --planner --domain block_pulling` plays a robot task's scripted expert, `--random` random
actions.
"""

import dataclasses
import functools
import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
import tyro

from envs_mjx import registry
from envs_mjx.base import Environment, EnvState
from envs_mjx.grid import draw
from envs_mjx.grid.optimal import optimum
from mijax import evaluate_robot, runtime
from mijax.agents.forgetful import Forgetful
from mijax.agents.variants import memory_of
from mijax.config import ConfigError, require
from mijax.learner import Learner, LearnerState, make_learner
from mijax.rollout import Actor
from mijax.run_folder import RunFolder
from mijax.seeds import evaluation_key
from mijax.trained import load_learner_state, seeds_of, training_of

EPISODE_FILE = "episode.gif"
COLUMNS = ("success", "return", "discounted_return", "of_optimum", "length", "reveals", *evaluate_robot.HALVES)


@dataclasses.dataclass(frozen=True)
class EvaluateOptions:
    """Play a run's newest checkpoint greedily: success, returns, length, how often information was asked for.

    With --planner or --random no run is played but a robot task's scripted expert, or random actions.
    """

    run: tyro.conf.Positional[pathlib.Path | None] = None
    """Run folder, of a run that has finished or is still at work."""
    planner: bool = False
    """Play the scripted expert of --domain."""
    random: bool = False
    """Play random actions in --domain."""
    domain: str | None = None
    """The robot task of --planner and --random: block_pulling, block_pushing or drawer_opening."""
    episodes: int = 500
    """Episodes per seed."""
    remember: int = 0
    """Steps, the present one among them, that the agent may remember: at each it acts as if the episode had begun so
    many steps ago. 0: all. An agent that remembers falls to a guess with 2."""
    seeds: str | None = None
    """Which seeds (0,1; a single one with a comma: 3,) or the first so many (2); default all of the run's."""
    gif: bool = False
    """Write an episode of each seed as RUN/seed_K/episode.gif, or one of --planner as OUT/planner.gif."""
    html: bool = False
    """Write an episode of --planner as OUT/planner.html, a page that needs no network (once: `make viewer`)."""
    viewer_libraries: pathlib.Path = pathlib.Path(".cache/viewer/node_modules")
    """Node modules that the page is made with: three and lil-gui."""
    out: pathlib.Path | None = None
    """Folder for the pictures of --planner; default runs/DOMAIN-planner."""
    text: bool = False
    """Print an episode of each seed, step by step."""


def play(learner: Learner, state: LearnerState, key: jax.Array, actor: Actor | None = None) -> list[EnvState]:
    """The environment's states over one greedy episode, from the reset to the end, on the host; `actor`: played by
    another than the agent."""
    env, agent, params = learner.env, actor or learner.agent, state.agent.target

    @jax.jit
    def episode(params: Any, key: jax.Array) -> tuple[EnvState, EnvState, jax.Array]:
        key_reset, key_steps = jax.random.split(key)
        first, timestep = env.reset(key_reset)

        def step(carry: tuple, key: jax.Array) -> tuple[tuple, tuple]:
            env_state, observation, memory, previous_action = carry
            memory, action = agent.act(params, memory, observation[None], previous_action)
            env_state, timestep = env.step(key, env_state, action[0])
            return (env_state, timestep.observation, memory, action), (env_state, timestep.done)

        carry = first, timestep.observation, agent.initial_memory(1), agent.no_action(1)
        _, (later, done) = jax.lax.scan(step, carry, jax.random.split(key_steps, env.horizon))
        return first, later, done

    first, later, done = jax.device_get(episode(params, key))
    return [first, *(jax.tree.map(lambda x, t=t: x[t], later) for t in range(int(np.argmax(done)) + 1))]


def evaluate_seed(
    learner: Learner, state: LearnerState, key: jax.Array, episodes: int, actor: Actor
) -> dict[str, float]:
    """Means over greedy episodes, the discounted return in fractions of the best possible where that is known, and of a
    robot task the success by what was touched first."""
    discount = learner.config.evaluation.discount
    if evaluate_robot.is_robot(learner.env):
        return evaluate_robot.evaluate_policy(learner.env, actor, state.agent.target, key, episodes, discount)
    program = jax.jit(functools.partial(learner.evaluate, actor=actor), static_argnums=2)
    results = {name: float(np.mean(values)) for name, values in program(state, key, episodes).items()}
    best = optimum(learner.domain, discount)
    if best is not None:
        results["of_optimum"] = results["discounted_return"] / best.discounted_return
    return results


def table(rows: Mapping[str, Mapping[str, float]], steps: Mapping[str, int]) -> str:
    """A line per seed, and one for their mean when there are several."""
    columns = [name for name in COLUMNS if all(name in row for row in rows.values())]
    lines = [["seed", "step", *(name.replace("_", " ") for name in columns)]]
    lines += [[seed, f"{steps[seed]:,}", *(f"{row[name]:.3f}" for name in columns)] for seed, row in rows.items()]
    if len(rows) > 1:
        lines.append(["mean", "", *(f"{np.mean([row[name] for row in rows.values()]):.3f}" for name in columns)])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)


def show(env: Environment, states: Sequence[EnvState], title: str, gif: pathlib.Path | None, text: bool) -> None:
    """One episode in the terminal, and as a file."""
    if text:
        print(f"{title}\n\n" + "\n\n".join(draw.text(env, env_state) for env_state in states) + "\n")
    if gif is None:
        return
    if evaluate_robot.is_robot(env):
        evaluate_robot.save_gif(env, states, gif, print)
    else:
        draw.save_gif(gif, [draw.frame(env, env_state) for env_state in states])
    print(f"{title}: {gif}")


def check(options: EvaluateOptions) -> None:
    """Raise `ConfigError` for options that do not go together, before any work."""
    require(options.episodes >= 1, "episodes", options.episodes, "a number >= 1")
    require(options.remember >= 0, "remember", options.remember, "a number >= 1, or 0 for all")
    require(not (options.planner and options.random), "random", True, "--planner or --random, not both")
    if not (options.planner or options.random):
        if options.run is None:
            raise ConfigError("got no run folder, accepted: one, or --planner or --random with --domain")
        for name, given in (("domain", options.domain), ("html", options.html or None), ("out", options.out)):
            require(given is None, name, str(given), "with --planner only; a run has its own domain and folder")
        return
    policy = "planner" if options.planner else "random"
    require(options.run is None, policy, str(options.run), f"no run folder beside --{policy}")
    require(options.domain is not None, policy, True, f"with --domain, one of {evaluate_robot.DEMONSTRATED}")
    for name, given in (("seeds", options.seeds), ("text", options.text), ("remember", options.remember)):
        require(not given, name, given, f"with a run only, not with --{policy}")
    require(options.planner or not (options.gif or options.html or options.out), "random", True,
            "without --gif, --html and --out: pictures are of --planner")


def evaluate(options: EvaluateOptions) -> dict[str, dict[str, float]] | None:
    """Evaluate the seeds that were asked for: results by seed. None with --planner and --random."""
    check(options)
    if options.domain is not None and options.random:
        evaluate_robot.evaluate_random(options.domain, options.episodes, print)
        return None
    if options.domain is not None:
        out = options.out or pathlib.Path("runs") / f"{registry.file_name(options.domain)}-planner"
        libraries = options.viewer_libraries if options.html else None
        evaluate_robot.evaluate_planner(options.domain, options.episodes, out, options.gif, libraries, print)
        return None
    assert options.run is not None
    run = RunFolder.open(options.run)
    config, seeds = training_of(run).config, seeds_of(run, options.seeds)
    learner = make_learner(registry.make(config.domain), config)
    require(options.remember <= learner.domain.horizon, "remember", options.remember,
            f"a number <= {learner.domain.horizon}, the longest episode, or 0 for all")
    if options.text or (options.gif and not evaluate_robot.is_robot(learner.domain)):
        draw.drawable(learner.domain)  # said before the episodes are played
    actor = Forgetful(learner.agent, options.remember) if options.remember else learner.agent
    rows, steps = {}, {}
    for seed in seeds:
        step, state = load_learner_state(run, seed, learner)
        key = evaluation_key(seed, step)
        rows[str(seed)], steps[str(seed)] = evaluate_seed(learner, state, key, options.episodes, actor), step
        if options.gif or options.text:
            gif = run.seed_path(seed) / EPISODE_FILE if options.gif else None
            show(learner.domain, play(learner, state, key, actor), f"seed {seed}, step {step:,}", gif, options.text)
    print(f"{config.domain}, {config.agent}, {memory_of(config)}: {options.episodes} greedy episodes per seed")
    print(table(rows, steps))
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    options = tyro.cli(EvaluateOptions, args=arguments, prog="python -m mijax.evaluate")

    def work() -> None:
        runtime.prepare()
        evaluate(options)

    return runtime.exit_code(work)


if __name__ == "__main__":
    sys.exit(main())

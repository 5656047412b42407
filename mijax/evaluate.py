"""`python -m mijax.evaluate RUN`: greedy episodes of a finished or running run's newest checkpoints."""

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
from mijax import checkpoint, runtime, stage1
from mijax.agents.variants import memory_of, needs_representation
from mijax.config import Config, ConfigError, config_from_dict, parse_seeds, require
from mijax.learner import Learner, LearnerState, make_learner
from mijax.metrics import RunError, RunFolder
from mijax.representation.storage import RepresentationError, load_representation
from mijax.seeds import evaluation_key, training_key

USER_ERRORS = (ConfigError, RunError, RepresentationError, registry.UnknownDomain, registry.ContractError,
               draw.NoDrawing, OSError)
"""What a user can mend: shown as one line."""
EPISODE_FILE = "episode.gif"
COLUMNS = ("success", "return", "discounted_return", "of_optimum", "length", "reveals")


@dataclasses.dataclass(frozen=True)
class EvaluateOptions:
    """Play a run's newest checkpoint greedily: success, returns, length, how often information was asked for."""

    run: tyro.conf.Positional[pathlib.Path]
    """Run folder, of a run that has finished or is still at work."""
    episodes: int = 500
    """Episodes per seed."""
    seeds: str | None = None
    """Which seeds (0,1; a single one with a comma: 3,) or the first so many (2); default all of the run's."""
    gif: bool = False
    """Write an episode of each seed as RUN/seed_K/episode.gif."""
    text: bool = False
    """Print an episode of each seed, step by step."""


def config_of(run: RunFolder) -> Config:
    """The options that a run is trained under."""
    stored = run.config()
    if "agent" not in stored:
        raise RunError(f"{run.path}: holds representations but no agent to evaluate")
    return config_from_dict({name: value for name, value in stored.items() if name not in ("seed_list", "track")})


def load_learner_state(run: RunFolder, seed: int, learner: Learner) -> tuple[int, LearnerState]:
    """The environment step of a seed's newest whole checkpoint, and the state there."""
    if not checkpoint.exists(run, [seed]):
        raise RunError(f"{run.path}: seed {seed} has no checkpoint yet")
    representation = None
    if needs_representation(learner.config):
        representation = load_representation(stage1.folder_of(run, seed), learner.domain)
    template = jax.eval_shape(learner.init, training_key(seed), representation)
    checkpoints = checkpoint.Checkpoints(run, seed)
    step, states = checkpoint.load_latest({seed: checkpoints}, template, functools.partial(print, file=sys.stderr))
    checkpoints.close()
    return step, states[seed]


def play(learner: Learner, state: LearnerState, key: jax.Array) -> list[EnvState]:
    """The environment's states over one greedy episode, from the reset to the end, on the host."""
    env, agent, params = learner.env, learner.agent, state.agent.target

    @jax.jit
    def episode(params: Any, key: jax.Array) -> tuple[EnvState, EnvState, jax.Array]:
        key_reset, key_steps = jax.random.split(key)
        first, timestep = env.reset(key_reset)

        def step(carry: tuple, key: jax.Array) -> tuple[tuple, tuple]:
            env_state, observation, memory, previous_action = carry
            memory, action = agent.act(params, memory, observation[None], previous_action)
            env_state, timestep = env.step(key, env_state, action[0])
            return (env_state, timestep.observation, memory, action), (env_state, timestep.done)

        carry = first, timestep.observation, agent.initial_memory(1), jax.numpy.full((1,), -1, jax.numpy.int32)
        _, (later, done) = jax.lax.scan(step, carry, jax.random.split(key_steps, env.horizon))
        return first, later, done

    first, later, done = jax.device_get(episode(params, key))
    return [first, *(jax.tree.map(lambda x, t=t: x[t], later) for t in range(int(np.argmax(done)) + 1))]


def evaluate_seed(learner: Learner, state: LearnerState, key: jax.Array, episodes: int) -> dict[str, float]:
    """Means over greedy episodes, and the discounted return in fractions of the best possible where that is known."""
    program = jax.jit(learner.evaluate, static_argnums=2)
    results = {name: float(np.mean(values)) for name, values in program(state, key, episodes).items()}
    best = optimum(learner.domain, learner.config.evaluation.discount)
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
    if gif is not None:
        draw.save_gif(gif, [draw.frame(env, env_state) for env_state in states])
        print(f"{title}: {gif}")


def evaluate(options: EvaluateOptions) -> dict[str, dict[str, float]]:
    """Evaluate the seeds that were asked for; results by seed."""
    require(options.episodes >= 1, "episodes", options.episodes, "a number >= 1")
    run = RunFolder.open(options.run)
    config, present = config_of(run), run.seeds()
    seeds = present if options.seeds is None else parse_seeds(options.seeds)
    missing = [seed for seed in seeds if seed not in present]
    if missing or not seeds:
        named = f"no seed {missing[0]}" if missing else "no seed"
        raise RunError(f"{run.path}: has {named} (it has {', '.join(map(str, present)) or 'none'})")
    learner = make_learner(registry.make(config.domain), config)
    rows, steps = {}, {}
    for seed in seeds:
        step, state = load_learner_state(run, seed, learner)
        key = evaluation_key(seed, step)
        rows[str(seed)], steps[str(seed)] = evaluate_seed(learner, state, key, options.episodes), step
        if options.gif or options.text:
            gif = run.seed_path(seed) / EPISODE_FILE if options.gif else None
            show(learner.domain, play(learner, state, key), f"seed {seed}, step {step:,}", gif, options.text)
    print(f"{config.domain}, {config.agent}, {memory_of(config)}: {options.episodes} greedy episodes per seed")
    print(table(rows, steps))
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """The command."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = tyro.cli(EvaluateOptions, args=list(arguments), prog="python -m mijax.evaluate")
    runtime.prepare()
    try:
        evaluate(options)
    except USER_ERRORS as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

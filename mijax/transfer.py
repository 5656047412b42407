"""`python -m mijax.transfer RUN`: a robot policy in another simulator that plays the real world (paper Table 1).

`python -m mijax.transfer --planner --domain block_pulling` plays the scripted expert there, which reads poses: what the
other world allows. Half of the episodes begin with the immovable object.
"""

import contextlib
import dataclasses
import functools
import json
import pathlib
import re
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
import tyro

import configs
from envs_mjx import registry
from envs_mjx.grid import draw
from envs_mjx.robot.gap import GAPS
from mijax import evaluate_robot, runtime
from mijax.config import ConfigError, require
from mijax.files import make_folder
from mijax.learner import Learner, LearnerState, make_learner
from mijax.run_folder import RunError, RunFolder
from mijax.seeds import evaluation_key
from mijax.trained import load_learner_state, seeds_of, training_of
from mijax.versions import current_versions

if TYPE_CHECKING:
    from envs_mjx.robot.real_trial import Half, Policy, RealEpisode
    from envs_mjx.robot.realworld import RealWorld
    from envs_mjx.robot.task import RobotTask

_SAY_EVERY = 10  # episodes


@dataclasses.dataclass(frozen=True)
class TransferOptions:
    """Play a run's newest checkpoint in another simulator: success, protective stops, misses (paper Table 1).

    With --planner no run is played but the scripted expert of --domain.
    """

    run: tyro.conf.Positional[pathlib.Path | None] = None
    """Run folder of a robot task, of a run that has finished or is still at work."""
    planner: bool = False
    """Play the scripted expert of --domain."""
    domain: str | None = None
    """The task of --planner: block_pulling, block_pushing or drawer_opening."""
    episodes: int = 50
    """Episodes per seed; every other one begins with the immovable object."""
    gap: str = "mild"
    """How different the other world is: none, mild or hard (envs_mjx/robot/gap.py has the numbers)."""
    seeds: str | None = None
    """Which seeds of the run (0,1; a single one with a comma: 3,) or the first so many (2); default all."""
    gif: bool = False
    """Write a film of one episode for each way in which episodes ended."""
    out: pathlib.Path | None = None
    """Folder for results and films; default RUN/transfer_GAP, or runs/DOMAIN-planner/transfer_GAP."""


class AgentPolicy:
    """A trained agent, greedy. It is shown observations and nothing else."""

    looks = True

    def __init__(self, learner: Learner, state: LearnerState) -> None:
        """Args: learner and state: of a checkpoint; the averaged parameters act, as in evaluation."""
        agent = learner.agent
        self._first = agent.initial_memory(1), agent.no_action(1)
        self._act = jax.jit(functools.partial(agent.act, state.agent.target))

    def start(self, key: jax.Array, env_state: Any) -> Any:
        """An empty history."""
        del key, env_state
        return self._first

    def act(self, memory: Any, observation: np.ndarray | None, env_state: Any) -> tuple[Any, np.ndarray]:
        """The greedy action (4,) after one more `observation` (84, 84, 2)."""
        del env_state
        assert observation is not None
        history, previous_action = memory
        history, action = self._act(history, observation[None], previous_action)
        return (history, action), np.asarray(action[0])


def check(options: TransferOptions) -> None:
    """Raise `ConfigError` for options that do not go together, before any work."""
    require(options.gap in GAPS, "gap", options.gap, ", ".join(GAPS))
    require(options.episodes >= 1, "episodes", options.episodes, "a number >= 1")
    if options.planner:
        require(options.run is None, "planner", str(options.run), "no run folder beside --planner")
        require(options.domain is not None, "planner", True, f"with --domain, one of {evaluate_robot.DEMONSTRATED}")
        require(options.seeds is None, "seeds", options.seeds, "with a run only, not with --planner")
    else:
        if options.run is None:
            raise ConfigError("got no run folder, accepted: one, or --planner with --domain")
        require(options.domain is None, "domain", options.domain, "with --planner only; a run has its own domain")


def transfer(options: TransferOptions) -> "dict[str, list[Half]]":
    """Play what was asked for; rows of the table by seed, or under "planner"."""
    check(options)
    if options.planner:
        assert options.domain is not None
        task = evaluate_robot.robot("planner", options.domain)
        folder = f"{registry.file_name(options.domain)}-planner"
        out = options.out or pathlib.Path("runs") / folder / f"transfer_{options.gap}"
        title = f"{options.domain}, the scripted expert, gap {options.gap}"
        with contextlib.closing(_world(task, options.gap)) as world:
            from envs_mjx.robot.real_trial import ExpertPolicy

            return {"planner": _play(world, ExpertPolicy(task), jax.random.key(0), options, out, title)}
    assert options.run is not None
    run = RunFolder.open(options.run)
    config = training_of(run).config
    require(registry.plain_name(config.domain) in configs.ROBOTS, "run", str(options.run),
            f"a run on a robot task ({evaluate_robot.DEMONSTRATED}), not on {config.domain}")
    seeds = seeds_of(run, options.seeds)
    task = registry.make(config.domain)
    assert evaluate_robot.is_robot(task)
    learner = make_learner(task, config)
    require(not learner.agent.declaration.sees_state, "run", str(options.run),
            f"a run of an agent that sees observations; {config.agent} sees the state, which no robot has")
    states = {seed: load_learner_state(run, seed, learner) for seed in seeds}
    rows = {}
    with contextlib.closing(_world(task, options.gap)) as world:
        for seed, (step, state) in states.items():
            out = (options.out or run.path / f"transfer_{options.gap}") / f"seed_{seed}"
            title = f"{config.domain}, {config.agent}, seed {seed}, step {step:,}, gap {options.gap}"
            policy, key = AgentPolicy(learner, state), evaluation_key(seed, step)
            rows[str(seed)] = _play(world, policy, key, options, out, title)
    return rows


def _world(task: "RobotTask", gap: str) -> "RealWorld":
    """The other world of a task; `RunError` where its cameras have no OpenGL."""
    from envs_mjx.robot import headless

    if headless.bind() is None:
        raise RunError("no OpenGL without a display: the cameras need EGL or OSMesa (Debian: libegl1 or libosmesa6)")
    from envs_mjx.robot.realworld import RealWorld

    return RealWorld(task, GAPS[gap])


def _play(
    world: "RealWorld", policy: "Policy", key: jax.Array, options: TransferOptions, out: pathlib.Path, title: str
) -> "list[Half]":
    from envs_mjx.robot.real_trial import halves, play_beginning_with
    from envs_mjx.robot.realworld import IMMOVABLE, MOVABLE

    make_folder(out)
    episodes = []
    for number in range(options.episodes):
        first = MOVABLE if number % 2 else IMMOVABLE
        episodes.append(play_beginning_with(world, policy, jax.random.fold_in(key, number), first))
        if (number + 1) % _SAY_EVERY == 0 and number + 1 < options.episodes:
            print(f"{number + 1} of {options.episodes} episodes", file=sys.stderr)
    rows = halves(episodes)
    print(f"{title}: {options.episodes} episodes")
    print(table(rows))
    (out / "transfer.json").write_text(json.dumps(_results(title, rows, episodes), indent=1) + "\n")
    print(f"every episode: {out / 'transfer.json'}")
    if options.gif:
        _films(world, episodes, out, print)
    return rows


def table(rows: "Sequence[Half]") -> str:
    """A line for each half that there is, and one for all episodes."""
    lines = [f"{'touched first':<22}{'success':>9}{'protective stop':>17}{'miss':>8}{'mean length':>13}"]
    for row in rows:
        cells = (f"{count}/{row.episodes}" for count in (row.success, row.protective_stops, row.misses))
        lines.append("{:<22}{:>9}{:>17}{:>8}".format(row.name, *cells) + f"{row.mean_length:>13.1f}")
    return "\n".join(lines)


def _results(title: str, rows: "Sequence[Half]", episodes: "Sequence[RealEpisode]") -> dict[str, Any]:
    from envs_mjx.robot.task import OUTCOMES

    played = [{"outcome": OUTCOMES[episode.outcome], "length": episode.length,
               "touched_first": {-1: None, 0: "immovable", 1: "movable"}[episode.first_touched],
               "pressed_newtons": round(episode.states[-1].pressed, 1)} for episode in episodes]
    return {"played": title, "versions": current_versions(), "table": [dataclasses.asdict(row) for row in rows],
            "episodes": played}


def _films(
    world: "RealWorld", episodes: "Sequence[RealEpisode]", out: pathlib.Path, say: Callable[[str], None]
) -> None:
    """One film for each way to end; an episode that begins with the immovable object is preferred: it is harder."""
    from envs_mjx.robot.real_trial import frames
    from envs_mjx.robot.realworld import IMMOVABLE
    from envs_mjx.robot.task import OUTCOMES

    for outcome in sorted({episode.outcome for episode in episodes}):
        ended = [episode for episode in episodes if episode.outcome == outcome]
        chosen = next((episode for episode in ended if episode.first_touched == IMMOVABLE), ended[0])
        path = out / (re.sub(r"\W+", "_", OUTCOMES[outcome]) + ".gif")
        draw.save_gif(path, frames(world, chosen))
        say(f"{OUTCOMES[outcome]}: {path}")


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    options = tyro.cli(TransferOptions, args=arguments, prog="python -m mijax.transfer")

    def work() -> None:
        runtime.prepare()
        transfer(options)

    return runtime.exit_code(work)


if __name__ == "__main__":
    sys.exit(main())

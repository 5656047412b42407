"""`python -m mijax.train`: both stages on a domain, resumable, with curves at the end."""

import argparse
import dataclasses
import pathlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro

import configs
from configs.paper import paper
from envs_mjx import registry
from envs_mjx.base import ContinuousActions, Environment
from envs_mjx.contract import check_contract
from envs_mjx.errors import UserError
from envs_mjx.grid.optimal import optimum
from mijax import checkpoint, report, runtime, stage1
from mijax.agents.variants import memory_of, needs_representation, pretrain_updates, reads, stage1_of, title_of
from mijax.config import Config, Stage1Config, config_from_dict, options_of, parse_seeds, require
from mijax.hosts import Host, check, meet, require_seeds
from mijax.learner import Learner, make_learner
from mijax.progress import ProgressDisplay
from mijax.results import load, summarise
from mijax.run_folder import RunError, RunFolder
from mijax.seeds import SeedRunner, training_key
from mijax.trackers import TrackerName, make_tracker, require_tracker
from mijax.trained import Training, training_of

FINAL_EPISODES = 500
"""Greedy episodes of each seed behind the numbers of summary.json."""
FOLDER_SECONDS = 600
"""How long other hosts wait for host 0 to make the run folder, or to write a resumed run's new budget there."""


class TrainingError(RunError):
    """Training cannot go on; the run folder is whole up to its last checkpoint."""


@dataclasses.dataclass(frozen=True)
class TrainOptions:
    """Train an agent on a domain: stage 1 (representation), then stage 2 (task)."""

    config: Annotated[Config, tyro.conf.arg(name="")]
    preset: Literal["default", "paper"] = "default"
    """Whose numbers the other options start from: ours, or the paper's."""
    seeds: str = "1"
    """How many seeds (5: seeds 0 to 4), or which ones (3,7; a single one with a comma: 3,)."""
    out: pathlib.Path | None = None
    """Run folder to make; default runs/DOMAIN-AGENT-MEMORY."""
    resume: pathlib.Path | None = None
    """Run folder to go on with, under its own options; only --track, --hosts and --steps may be given with it, and
    --steps stretches the schedules of step size and imitation."""
    representation: pathlib.Path | None = None
    """Run whose stage 1 is taken over instead of training one: each seed's, or its first one's where a seed has none
    there."""
    track: TrackerName = "none"
    """Where metrics go besides the run folder."""
    hosts: str = ""
    """Share the seeds out among several hosts that see the same run folder, one process on each: `auto` where JAX finds
    the hosts itself (SLURM, Open MPI, Kubernetes), or ADDRESS:PORT,INDEX,COUNT with an address of host 0 and an INDEX
    that differs; everything else is the same on each."""


def parse(arguments: Sequence[str]) -> TrainOptions:
    """Options in two stages: the domain first, since its preset gives the defaults of all the others."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--domain", default="heaven_hell")
    first.add_argument("--preset", default="default")
    first.add_argument("--resume", type=pathlib.Path)
    first.add_argument("--steps", type=int)
    first.add_argument("--track")
    first.add_argument("--hosts", default="")
    known, others = first.parse_known_args(list(arguments))
    if known.resume is not None and not {"-h", "--help"} & set(others):
        return _resumed(known, others, arguments)
    config = configs.preset(known.domain)
    if known.preset == "paper":
        # Robots are not made here: their physics starts JAX, before its devices are set.
        robot = registry.plain_name(known.domain) in configs.ROBOTS
        vector = not robot and not registry.make(known.domain).observation_spec.is_image
        config = paper(config, vector, known.steps)
    default = TrainOptions(config=config)
    return tyro.cli(TrainOptions, default=default, args=list(arguments), prog="python -m mijax.train")


def _resumed(known: argparse.Namespace, others: Sequence[str], arguments: Sequence[str]) -> TrainOptions:
    stray = [*others, *(word for word in arguments if word.split("=")[0] in ("--domain", "--preset"))]
    require(not stray, "resume", " ".join(stray),
            "no option but --steps, --track and --hosts: a run goes on under its own")
    run = RunFolder.open(known.resume)
    training = training_of(run)
    config = training.config
    if known.steps is not None:
        require(known.steps >= config.steps, "steps", known.steps, f"at least the run's {config.steps}")
        config = dataclasses.replace(config, steps=known.steps)
    seeds = ",".join(map(str, training.seeds)) + ","
    return TrainOptions(config, seeds=seeds, resume=known.resume, track=known.track or training.track,
                        hosts=known.hosts)


def unread_options(config: Config, env: Environment) -> list[str]:
    """Options that differ from both presets, and that the agent never looks at, or replaces: Believer some of stage 1.
    """
    ours = configs.preset(config.domain)
    presets = [options_of(preset) for preset in (ours, paper(ours, not env.observation_spec.is_image, config.steps))]
    continuous = isinstance(env.action_spec, ContinuousActions)
    used = options_of(dataclasses.replace(config, stage1=stage1_of(config)))
    return [f"--{name.replace('_', '-')}" for name, value in options_of(config).items()
            if (not reads(config, continuous, name) or used[name] != value)
            and all(preset[name] != value for preset in presets)]


def _require_kind(source: RunFolder, wanted: Stage1Config, pretrains: bool) -> None:
    """Raise `ConfigError` unless another run's features are of the kind that an agent is about, Believer's or ours, and
    for one that `pretrains`, of as many episodes as it takes them to be."""
    stored = source.config()
    read = config_from_dict({name: stored[name] for name in ("agent", "stage1") if name in stored})
    other = stage1_of(read) if "agent" in stored else read.stage1
    kinds = {True: "Believer's (a KL penalty)", False: "ours (CLUB)"}
    require((other.lambda_kl > 0) == (wanted.lambda_kl > 0), "representation", str(source.path),
            f"a run with features of the other kind: {kinds[wanted.lambda_kl > 0]}")
    require(not pretrains or (other.data, other.episodes) == (wanted.data, wanted.episodes), "stage1.episodes",
            f"{wanted.episodes} ({wanted.data})",
            f"{other.episodes} ({other.data}), as {source.path} has, whose episodes the replay starts with")


def folder_of(options: TrainOptions) -> pathlib.Path:
    """The run's folder, whether it exists or not."""
    config = options.config
    name = f"{registry.file_name(config.domain)}-{config.agent}-{memory_of(config)}"
    return options.resume or options.out or pathlib.Path("runs") / name


def open_run(options: TrainOptions, host: Host, fill: Callable[[RunFolder], None] | None = None) -> RunFolder:
    """The run folder to work in: a new one, which host 0 makes and `fill` puts representations into, or the one to go
    on with."""
    path = folder_of(options)
    asked = Training(options.config, parse_seeds(options.seeds), options.track).as_dict()
    if host.index == 0:
        return RunFolder.create(path, asked, fill) if options.resume is None else RunFolder.open(path)
    deadline = time.monotonic() + FOLDER_SECONDS
    while not (path / "config.json").exists() or training_of(RunFolder.open(path)).as_dict() != asked:
        if time.monotonic() > deadline:
            raise RunError(f"{path}: host 0 has not begun this run; give every host the same options, and an --out "
                           "that every host sees")
        time.sleep(0.2)
    return RunFolder.open(path)


class CompileClock:
    """Seconds XLA has spent compiling, from JAX's own events."""

    def __init__(self) -> None:
        self._total, self._lock = 0.0, threading.Lock()
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        del kwargs
        if event.endswith("backend_compile_duration"):  # what the cache has is in it as well
            with self._lock:
                self._total += duration_secs

    def lap(self) -> float:
        """Seconds since the last call."""
        with self._lock:
            seconds, self._total = self._total, 0.0
        return seconds


class StopRequest:
    """Ctrl-C and SIGTERM ask for an orderly stop; a second one quits at once."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self.asked, self._say = False, say
        self._previous = {number: signal.signal(number, self._handle) for number in (signal.SIGINT, signal.SIGTERM)}

    def _handle(self, number: int, frame: Any) -> None:
        del number, frame
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        self._say("stopping: finishing the current chunk, then saving (once more to quit at once)")

    def restore(self) -> None:
        """Give the signals back."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)


def train(options: TrainOptions, say: Callable[[str], None] = print) -> RunFolder:
    """Run or go on with a training; returns its folder."""
    config, every_seed = options.config, parse_seeds(options.seeds)
    require_tracker(options.track)
    check(options.hosts, len(every_seed))
    env = registry.make(config.domain)
    check_contract(env)
    fill = None  # what cannot be trained is refused before anything is written
    warmup = make_learner(env, config).warmup_steps
    require(config.steps > warmup, "steps", config.steps, f"more than the {warmup} of the warm-up")
    if options.representation is not None:
        require(needs_representation(config), "representation", options.representation,
                f"none: --agent {config.agent} looks through no features here")
        source = RunFolder.open(options.representation)
        fill = stage1.reuse(source, env, config.stage1.features, every_seed, say)
        _require_kind(source, stage1_of(config), pretrain_updates(config) > 0)
    unread = unread_options(config, env)
    if unread:
        say(f"not read by --agent {config.agent} on {env.name}: {', '.join(unread)}")
    if options.resume is None:
        RunFolder(folder_of(options)).refuse_taken()  # by every host, before host 0 can have made it
    if options.hosts:
        say(f"--hosts {options.hosts}: waiting for the other hosts")
    host = meet(options.hosts)
    require_seeds(options.hosts, host.count, len(every_seed))
    training = Training(config, host.share(every_seed), options.track)
    run = open_run(options, host, fill)
    lost = [seed for seed in training.seeds if run.has_results(seed) and not checkpoint.exists(run, [seed])]
    if lost:
        raise TrainingError(f"{run.path}: seed {lost[0]} has results, but no checkpoint to go on from, and "
                            "training it again would replace them; choose another --out")
    if options.resume is not None and run.summary() is not None and config.steps == training_of(run).config.steps:
        say(f"{run.path}: has ended, at its {config.steps:,} steps; --steps with more goes on")
        return run
    with run.held(training.seeds):
        if options.resume is not None and host.index == 0:
            run.amend(steps=config.steps, track=training.track)
        title = title_of(config, continuous=isinstance(env.action_spec, ContinuousActions))
        say(f"{run.path}: {title} ({config.agent}, {memory_of(config)}) on {env.name}, "
            f"seeds {list(training.seeds)}")
        _both_stages(run, env, training, say)
    return run


def _both_stages(run: RunFolder, env: Environment, training: Training, say: Callable[[str], None]) -> None:
    """Stage 1 where it is needed and not done, and stage 2 from where it stands."""
    config, seeds = training.config, training.seeds
    clock = CompileClock()
    learnt = None
    if needs_representation(config):
        try:
            learnt = stage1.representations(run, env, stage1_of(config), seeds, say)
        except UserError:
            run.discard(seeds)  # options that stage 1 cannot do anything with are no run to go on with
            raise
    checkpoints = checkpoint.open_all(run, seeds, config.checkpoint.keep)
    for abreast in checkpoint.abreast(checkpoints):
        runner = SeedRunner(lambda pack: make_learner(env, config, pack), tuple(abreast), config.seeds.strategy)
        clock.lap()  # what stage 1 compiled is in its own seconds
        started = time.perf_counter()
        _start(runner, run, abreast, learnt, say)
        compiled = clock.lap()
        before = {"start": time.perf_counter() - started - compiled, "compile": compiled}
        if not _loop(runner, run, abreast, training, clock, before, say):
            break
        _conclude(runner, run, env, say)
    for each in checkpoints.values():
        each.close()


def _start(
    runner: SeedRunner, run: RunFolder, checkpoints: dict[int, checkpoint.Checkpoints], learnt: Any,
    say: Callable[[str], None],
) -> None:
    """From the newest checkpoint, or from scratch; metrics after it are dropped and will be written again."""
    resumes = all(each.steps() for each in checkpoints.values())
    if not resumes:
        say(f"stage 2: compiling, then {_prelude(runner.learner)}")
    template = jax.eval_shape(
        runner.learner.init, training_key(0), None if learnt is None else learnt[runner.seeds[0]])
    runner.compile(template)
    runtime.release_memory()
    if resumes:
        step, states = checkpoint.load_latest(checkpoints, template, say)
        runner.restore(states)
        run.truncate_after(step, runner.seeds)
        for each in checkpoints.values():
            each.drop_after(step)
        say(f"going on from step {step:,}")
    else:
        run.truncate_after(-1, runner.seeds)
        runner.init(learnt)
        shown = all(runner.learner.has_demonstrations(state) for state in runner.states().values())
        require(shown, "sac.demonstrations", runner.learner.demonstrations,
                f"0, as the expert of {runner.learner.env.name} solves none of its episodes; in another --out, with "
                f"--representation {run.path} where stage 1 is done")
        updates = runner.learner.pretrain_iterations * runner.learner.updates_per_iteration
        if updates:
            with ProgressDisplay("pre-training", updates, unit="updates") as progress:
                runner.pretrain(progress.update)
        runtime.release_memory()


def _prelude(learner: Learner) -> str:
    """What comes before the first update, which on a robot takes a minute or two."""
    config, parts = learner.config, []
    if learner.remembers:
        parts.append(f"{config.stage1.episodes:,} random episodes of stage 1")
    if learner.demonstrations:
        parts.append(f"{learner.demonstrations} demonstrations")
    if learner.agent.declaration.believes:
        parts.append(f"{config.believer.updates:,} updates of the history model")
    if learner.warmup_steps:
        parts.append(f"{learner.warmup_steps:,} random steps")
    return ", ".join(parts)


def _loop(
    runner: SeedRunner, run: RunFolder, checkpoints: dict[int, checkpoint.Checkpoints], training: Training,
    clock: CompileClock, before: Mapping[str, float], say: Callable[[str], None],
) -> bool:
    """Chunks, evaluations, metrics and checkpoints up to the run's steps; False when asked to stop before.

    `before`: seconds by part, of what went before; they belong to the first row.
    """
    config = training.config
    tracker, stop = make_tracker(training.track, run), StopRequest(say)
    agent, evaluations = runner.learner.agent, 0

    def save() -> None:
        for seed, state in runner.states().items():
            checkpoints[seed].save(runner.step, state)

    try:
        with ProgressDisplay("stage 2", runner.last_step, start=runner.step) as progress:
            while runner.step < config.steps and not stop.asked:
                rows = _advance(runner, config, clock, {} if evaluations else before)
                for seed, row in rows.items():
                    _refuse_divergence(seed, row, agent.group, agent.options.learning_rate)
                    run.append(seed, row)
                    tracker.log(seed, row)
                progress.update(runner.step, _overview(rows))
                evaluations += 1
                if evaluations % config.checkpoint.every == 0 or runner.step >= config.steps or stop.asked:
                    save()
        if runner.step < config.steps:
            save()
            say(f"stopped at step {runner.step:,}; go on with: python -m mijax.train --resume {run.path}")
    finally:
        stop.restore()
        tracker.close()
    return runner.step >= config.steps


def _advance(
    runner: SeedRunner, config: Config, clock: CompileClock, before: Mapping[str, float]
) -> dict[int, dict[str, float]]:
    """One chunk and its evaluation: a row of metrics by seed. Wall seconds are those of all seeds together, shared."""
    clock.lap()
    started = time.perf_counter()
    metrics = runner.advance()
    compiled = clock.lap()
    trained = time.perf_counter()
    results = runner.evaluate(config.evaluation.episodes)
    compiled_evaluation = clock.lap()
    ended = time.perf_counter()
    if compiled + compiled_evaluation > 0:
        runtime.release_memory()
    share = 1 / len(runner.seeds)
    wall = {"compile": compiled + compiled_evaluation, "training": trained - started - compiled,
            "evaluation": ended - trained - compiled_evaluation}
    wall = {f"wall/{part}": max(wall.get(part, 0) + before.get(part, 0), 0) * share for part in {**before, **wall}}
    stepped = (runner.step - runner.learner.warmup_steps) // config.iteration_steps
    iterations = runner.learner.pretrain_iterations + stepped
    update = iterations * runner.learner.updates_per_iteration
    return {
        seed: {"step": runner.step, "update": update}
        | {f"evaluation/{name}": value for name, value in results[seed].items()} | metrics[seed] | wall
        for seed in runner.seeds
    }


def _refuse_divergence(seed: int, row: Mapping[str, float], group: str, learning_rate: float) -> None:
    bad = [name for name, value in row.items() if name.startswith("loss/") and not np.isfinite(value)]
    if bad:
        raise TrainingError(
            f"seed {seed}: {bad[0]} is {row[bad[0]]} at step {row['step']:,}, and would be again on resuming; train "
            f"anew in another --out, with a smaller --{group}.learning-rate than {learning_rate}")


def _overview(rows: Mapping[int, Mapping[str, float]]) -> dict[str, float]:
    """What the progress line shows: means over the seeds."""
    names = {"return": "evaluation/return", "success": "evaluation/success", "length": "evaluation/length",
             "td": "loss/td", "aux": "loss/auxiliary", "f": "loss/f", "eps": "train/epsilon"}
    columns = {short: [row[name] for row in rows.values() if name in row] for short, name in names.items()}
    return {short: float(np.mean(values)) for short, values in columns.items() if values}


def _conclude(runner: SeedRunner, run: RunFolder, env: Environment, say: Callable[[str], None]) -> None:
    """The last evaluation of every seed here; summary.json, curve.png and the table once all seeds of the run ended."""
    final = runner.evaluate(FINAL_EPISODES)
    environment = runner.environment_seconds() / len(runner.seeds)
    for seed in runner.seeds:
        run.write_end(seed, runner.step, {"evaluation": final[seed], "stage1": stage1.seconds_of(run, seed),
                                          "environment": environment})
    with run.concluding():
        ends = {seed: run.end(seed, runner.step) for seed in training_of(run).seeds}
        ended = {seed: end for seed, end in ends.items() if end is not None}
        if len(ended) < len(ends):
            left = [seed for seed in ends if seed not in ended]
            say(f"seeds {list(runner.seeds)} have ended, seeds {left} have not: whoever ends last writes the summary")
            return
        best = optimum(env, runner.learner.config.evaluation.discount)
        values = None if best is None else {
            "return": best.undiscounted_return, "discounted_return": best.discounted_return, "success": best.success,
            "length": best.length}
        summary = summarise(run, optimum=values, final={seed: end["evaluation"] for seed, end in ended.items()},
                            wall={seed: {"stage1": end["stage1"]} for seed, end in ended.items()})
        for seed, end in ended.items():
            wall = summary["seeds"][str(seed)]["wall"]
            training = wall.pop("training", 0.0)
            wall["environment"] = min(end["environment"], training)
            wall["update"] = training - wall["environment"]
        run.write_summary(summary)
        say(report.write_report(load([run.path]), run.path))


def _prepare(seeds: str, strategy: str) -> None:
    """A device of the CPU for every seed that can have a core of its own."""
    count = len(parse_seeds(seeds))
    shard = strategy == "shard" or (strategy == "auto" and count > 1)
    runtime.prepare(host_devices=min(runtime.cores(), count) if shard else 1)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    given = sys.argv[1:] if arguments is None else arguments

    def work() -> None:
        first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
        for name, default in (("--seeds", "1"), ("--seeds.strategy", "auto"), ("--resume", None)):
            first.add_argument(name, default=default, dest=name)
        known = vars(first.parse_known_args(list(given))[0])
        if known["--resume"] is None:  # before `parse`, which may make an environment, and that may start JAX
            _prepare(known["--seeds"], known["--seeds.strategy"])
        options = parse(given)
        if known["--resume"] is not None:
            _prepare(options.seeds, options.config.seeds.strategy)
        train(options)

    return runtime.exit_code(work)


if __name__ == "__main__":
    runtime.leave(main())

"""`python -m launch.bench [--json] [--only environments stage2 ...]`: how fast everything is on this machine.

Each rate is the best of a few repetitions, compilation apart (cold: without the cache on disk). Arithmetic is counted
by `launch.arithmetic`; "of matmul" is its rate as a fraction of that of a float32 matrix product in the same run.
"""

import argparse
import dataclasses
import functools
import json
import resource
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, PartitionSpec
from rich.console import Console
from rich.table import Table

import configs
from configs.paper import paper
from envs_mjx import registry
from envs_mjx.base import Environment
from envs_mjx.grid.optimal import OptimalPolicy, plan
from envs_mjx.grid.world import GridWorld
from launch.arithmetic import operations
from mijax import runtime
from mijax.agents.dqn import AgentState
from mijax.agents.variants import VARIANTS
from mijax.config import Config, TrunkKind
from mijax.learner import Learner, LearnerState, make_learner
from mijax.nets.encoders import encoder_for
from mijax.packing import fit_folds, gather_rows, one_per_row, row_choices
from mijax.replay import Replay, StepRecord, sample_episodes
from mijax.representation.dataset import collect
from mijax.representation.problem import Problem
from mijax.representation.train import LossWeights, initial_state, make_epoch
from mijax.rollout import select
from mijax.seeds import SeedRunner
from mijax.types import Metrics, Representation


@dataclasses.dataclass(frozen=True)
class Sizes:
    """How much of everything is run; the rates do not depend on it beyond noise."""

    matrix: int = 2048
    repetitions: int = 5
    batches: tuple[int, ...] = (1, 64, 4096)
    environment_steps: int = 1_000_000
    """Environment steps per measurement, at most `max_scan` batches of them."""
    max_scan: int = 2000
    stage1_episodes: int | None = None
    """Episodes of stage 1's data set; None: the preset's."""
    updates: int = 8
    """Stage-2 updates per measurement, in one scan as in training."""
    replay_episodes: int = 256
    batch_episodes: int | None = None
    """Episodes per stage-2 update; None: the preset's."""
    seeds: int = 5
    """Seeds that are trained together."""
    chunk_steps: int = 1000
    """Environment steps of each seed that are timed together."""
    robot_steps: int = 200
    """Steps of each robot environment per measurement."""


FULL_LENGTH, TRAINED = "full length", "trained agent's replay"
QUICK = Sizes(matrix=64, repetitions=1, batches=(1, 8), environment_steps=64, max_scan=8, stage1_episodes=30, updates=1,
              replay_episodes=8, batch_episodes=4, seeds=2, chunk_steps=20, robot_steps=2)
"""Tries every measurement in seconds; its numbers mean nothing."""


@dataclasses.dataclass(frozen=True)
class Result:
    """One measurement."""

    domain: str
    what: str
    per_second: float
    unit: str
    milliseconds: float
    """Of one unit: an update, or a step of the whole batch."""
    compile_seconds: float
    gflop: float | None
    """Arithmetic of one unit; None where it is no matter of products."""
    matmul_fraction: float | None
    peak_memory_mib: float
    """Of the whole process so far."""
    detail: str = ""


class Bench:
    """Measures, and relates each measurement to the matmul rate."""

    def __init__(self, sizes: Sizes) -> None:
        self.sizes = sizes
        self.matmul_gflops = 0.0
        self.matmul_gflops = self._matmul_gflop / self.matmul().milliseconds * 1e3

    @property
    def _matmul_gflop(self) -> float:
        return 2e-9 * self.sizes.matrix**3

    def matmul(self) -> Result:
        """The product of two square matrices, chained so that each one is needed."""
        size, chain = self.sizes.matrix, 4
        x = jnp.ones((size, size)) / size
        return self.measure("", f"float32 matmul {size}", "products", chain, 1,
                            lambda x: jax.lax.fori_loop(0, chain, lambda _, y: y @ x, x), x, gflop=self._matmul_gflop)

    def measure(
        self, domain: str, what: str, unit: str, repeats: int, batch: int, function: Callable, *arguments: Any,
        gflop: float | None = None, detail: str = ""
    ) -> Result:
        """Compile, warm up and time `function`, which does `repeats` times `batch` units of work."""
        started = time.perf_counter()
        compiled = jax.jit(function).lower(*arguments).compile()
        compile_seconds = time.perf_counter() - started
        jax.block_until_ready(compiled(*arguments))
        runs = (_seconds_of(functools.partial(compiled, *arguments)) for _ in range(self.sizes.repetitions))
        seconds = min(runs) / repeats
        fraction = gflop / seconds / self.matmul_gflops if gflop and self.matmul_gflops else None
        return Result(domain, what, batch / seconds, unit, seconds * 1e3, compile_seconds, gflop, fraction,
                      peak_memory_mib(), detail)


def peak_memory_mib() -> float:
    """Peak resident memory of this process."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def bench_environments(bench: Bench, env: Environment) -> Iterator[Result]:
    """A random policy; episodes that end start anew, as in the learner.

    The largest of each array that a step shows is consumed: sums of uint8 images would cost as much as the steps do.
    """
    for batch in bench.sizes.batches:
        steps = max(1, min(bench.sizes.max_scan, bench.sizes.environment_steps // batch))
        devices = len(jax.local_devices())
        devices = devices if batch % (64 * devices) == 0 else 1

        def run(keys: jax.Array, batch: int = batch // devices, steps: int = steps) -> jax.Array:
            start = jax.vmap(env.reset)(jax.random.split(keys[0], batch))

            def step(carry: tuple, key: jax.Array) -> tuple[tuple, jax.Array]:
                key_action, key_step, key_reset = jax.random.split(key, 3)
                action = jax.vmap(env.action_spec.sample)(jax.random.split(key_action, batch))
                env_state, timestep = jax.vmap(env.step)(jax.random.split(key_step, batch), carry[0], action)
                fresh = jax.vmap(env.reset)(jax.random.split(key_reset, batch))
                shown = jnp.stack([jnp.max(x).astype(jnp.float32) for x in jax.tree.leaves(timestep)])
                return select(timestep.done, fresh, (env_state, timestep)), shown

            return jnp.sum(jax.lax.scan(step, start, jax.random.split(keys[0], steps))[1])[None]

        mesh = jax.make_mesh((devices,), ("environments",), axis_types=(AxisType.Auto,))
        spread = jax.shard_map(run, mesh=mesh, in_specs=PartitionSpec("environments"),
                               out_specs=PartitionSpec("environments"), check_vma=False)
        yield bench.measure(
            env.name, f"environment, batch {batch}", "steps", steps, batch, spread,
            jax.random.split(jax.random.key(0), devices),
            detail=f"{devices} device{'s' * (devices > 1)}; consumed: the largest of all that a step shows")


def bench_robot(bench: Bench, env: Environment) -> Iterator[Result]:
    """A robot task whole, on all cores; MuJoCo C of the same model; the replay's memory, as images and as moments."""
    from launch import robots  # it needs MuJoCo

    first, second = robots.measure_apart(env.name, bench.sizes.robot_steps, bench.sizes.repetitions)
    batch = robots.BATCH * second.devices

    def result(what: str, per_second: float, unit: str, units: int, compile_seconds: float, detail: str) -> Result:
        return Result(env.name, what, per_second, unit, 1e3 * units / per_second, compile_seconds, None, None,
                      peak_memory_mib(), detail)

    yield result(f"environment, batch {batch}", max(first.steps_per_second, second.steps_per_second), "steps", batch,
                 first.compile_seconds, f"{second.devices} devices, 84 x 84 observation and state; a second process "
                 f"compiles in {second.compile_seconds:.1f} s")
    yield result("MuJoCo C, physics alone", max(first.c_steps_per_second, second.c_steps_per_second), "steps", 1, 0.0,
                 "the same model, one core")
    yield result("moments shown", max(first.frames_per_second, second.frames_per_second), "moments", 1, 0.0,
                 f"{robots.TRANSITIONS:,} transitions take {second.moment_mib:.0f} MiB as moments, "
                 f"{second.image_mib:.0f} as images")


def bench_acting(bench: Bench, env: Environment) -> Iterator[Result]:
    """The policy alone: a token in, an action out, with the memory carried along."""
    learner, agent, _ = fresh_learner(env, configs.preset(env.name), bench.sizes)
    batch, steps = learner.config.num_envs, min(env.horizon, bench.sizes.max_scan)
    observation = jnp.zeros((batch, *env.observation_spec.shape), env.observation_spec.dtype)

    def step(carry: tuple, _: None) -> tuple[tuple, None]:
        return learner.agent.act(agent.params["agent"], carry[0], observation, carry[1]), None

    def run(start: tuple) -> tuple:
        return jax.lax.scan(step, start, None, steps)[0]

    start = (learner.agent.initial_memory(batch), jnp.full((batch,), -1, jnp.int32))
    gflop = 1e-9 * operations(lambda carry: step(carry, None)[0], start)
    yield bench.measure(env.name, f"acting, batch {batch}", "steps", steps, batch, run, start, gflop=gflop)


def bench_stage1(bench: Bench, env: Environment) -> Iterator[Result]:
    """Encoder updates, each with its updates of CLUB's estimator: one epoch."""
    config = configs.preset(env.name).stage1
    if bench.sizes.stage1_episodes:
        config = dataclasses.replace(config, episodes=bench.sizes.stage1_episodes, batch_size=100)
    data = collect(env, jax.random.key(0), config.episodes, config.data)
    problem = Problem.of(env, config, data)
    state, updates = initial_state(problem, jax.random.key(1)), problem.updates_per_epoch
    epoch = functools.partial(make_epoch(problem), LossWeights.of(config))
    gflop = 1e-9 * operations(epoch, state, jax.random.key(2)) / updates
    yield bench.measure(env.name, "stage 1", "updates", updates, 1, epoch, state, jax.random.key(2), gflop=gflop,
                        detail=f"batch {config.batch_size}, {updates} updates per epoch")


def bench_stage2(bench: Bench, env: Environment) -> Iterator[Result]:
    """Gradient updates from the replay on: of episodes that last to the horizon, and of a trained agent's."""
    yield from _updates(bench, env, "stage 2", configs.preset(env.name))
    yield from _updates(bench, env, "stage 2, paper's sizes", paper_sizes(env))


def bench_sac(bench: Bench, env: Environment) -> Iterator[Result]:
    """The preset's SAC updates from a replay of the expert's episodes, by how frames are encoded."""
    trunks: Sequence[TrunkKind] = ("z_o", "psi", "shared")
    for trunk in trunks:
        preset = configs.preset(env.name)
        sac = dataclasses.replace(
            preset.sac, trunk=trunk, pretrain_updates=0, demonstrations=min(80, bench.sizes.replay_episodes),
            batch_episodes=bench.sizes.batch_episodes or preset.sac.batch_episodes)
        learner, _, representation = fresh_learner(env, dataclasses.replace(preset, sac=sac), bench.sizes)
        state = jax.jit(learner.init)(jax.random.key(0), representation)
        keys = jax.random.split(jax.random.key(3), bench.sizes.updates)

        def run(state: LearnerState, learner: Learner = learner, keys: jax.Array = keys) -> tuple[AgentState, Metrics]:
            return jax.lax.scan(
                lambda agent, key: learner.update(agent, state.replay, state.representation, key), state.agent, keys)

        yield bench.measure(env.name, f"stage 2, trunk {trunk}", "updates", len(keys), 1, run, state,
                            detail=f"{sac.batch_episodes} episodes of the expert")


def bench_agents(bench: Bench, env: Environment) -> Iterator[Result]:
    """Updates of every agent with every memory at the paper's sizes, episodes that last to the horizon."""
    for agent, declaration in VARIANTS.items():
        for memory in () if declaration.sees_state else declaration.memories:
            config = dataclasses.replace(paper_sizes(env), agent=agent, memory=memory)
            yield from _updates(bench, env, f"agent {agent}, {memory}", config, (FULL_LENGTH,))


def bench_seeds(bench: Bench, env: Environment) -> Iterator[Result]:
    """A chunk of training, as it runs, of one seed and of several, by the strategy that `auto` picks."""
    one = 0.0
    for count in (1, bench.sizes.seeds):
        config = configs.preset(env.name)
        dqn = dataclasses.replace(config.dqn, replay_steps=100_000, warmup_episodes=config.num_envs, pretrain_updates=0)
        evaluation = dataclasses.replace(config.evaluation, every=bench.sizes.chunk_steps)
        config = dataclasses.replace(config, dqn=dqn, evaluation=evaluation)
        representation = fresh_learner(env, config, bench.sizes)[2]
        runner = SeedRunner(functools.partial(make_learner, env, config), range(count), "auto")
        started = time.perf_counter()
        runner.init(dict.fromkeys(runner.seeds, representation))
        runner.advance()
        compile_seconds = time.perf_counter() - started
        seconds = min(_seconds_of(runner.advance) for _ in range(bench.sizes.repetitions))
        one = one or seconds
        updates = runner.learner.iterations_per_chunk * runner.learner.updates_per_iteration
        yield Result(env.name, f"{count} seed{'s' * (count > 1)} by {runner.strategy}", updates / seconds, "updates",
                     seconds / updates * 1e3, compile_seconds, None, None, peak_memory_mib(),
                     f"updates of all seeds, with the environment steps between: {seconds / one:.2f} times one seed; "
                     f"{len(jax.local_devices())} devices")


def _seconds_of(function: Callable[[], Any]) -> float:
    started = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - started


def paper_sizes(env: Environment) -> Config:
    """The preset with the paper's networks and batch; without dropout, which would add passes the paper does not make.
    """
    preset = configs.preset(env.name)
    published = paper(preset, vector_observation=not env.observation_spec.is_image)
    network = dataclasses.replace(published.network, dropout=0.0)
    dqn = dataclasses.replace(preset.dqn, batch_episodes=published.dqn.batch_episodes)
    return dataclasses.replace(preset, network=network, dqn=dqn)


def _updates(
    bench: Bench, env: Environment, what: str, config: Config, replays: Sequence[str] = (FULL_LENGTH, TRAINED)
) -> Iterator[Result]:
    learner, agent, representation = fresh_learner(env, config, bench.sizes)
    trained = optimal_replay(env, learner, representation, bench.sizes.replay_episodes)
    if trained is None:
        return
    full = dataclasses.replace(trained, length=jnp.full_like(trained.length, env.horizon + 1))
    keys = jax.random.split(jax.random.key(3), bench.sizes.updates)

    def run(agent: AgentState, replay: Replay) -> tuple[AgentState, Metrics]:
        return jax.lax.scan(lambda agent, key: learner.update(agent, replay, representation, key), agent, keys)

    for name, replay in ((name, {FULL_LENGTH: full, TRAINED: trained}[name]) for name in replays):
        rows = rows_of_updates(learner, replay, keys)
        gflop = float(np.mean([update_gflop(learner, agent, representation, replay, r) for r in rows]))
        detail = f"{np.mean(rows):.0f} rows of {env.horizon + 1} tokens, mean episode {np.mean(replay.length):.1f}"
        yield bench.measure(env.name, f"{what}, {name}", "updates", len(keys), 1, run, agent, replay, gflop=gflop,
                            detail=detail)


def fresh_learner(env: Environment, config: Config, sizes: Sizes) -> tuple[Learner, AgentState, Representation]:
    """An untrained agent over untrained encoders: the same work as trained ones."""
    dqn = dataclasses.replace(config.dqn, batch_episodes=sizes.batch_episodes or config.dqn.batch_episodes)
    learner = make_learner(env, dataclasses.replace(config, dqn=dqn))
    features = config.stage1.features
    phi, psi = (
        encoder_for(spec, features).init(jax.random.key(0), jnp.zeros((1, *spec.shape), spec.dtype))["params"]
        for spec in (env.state_spec, env.observation_spec)
    )
    representation = Representation(phi=phi, psi=psi, z_s_mean=jnp.zeros((features,)), z_s_variance=jnp.ones(()),
                                    data_key=jnp.zeros((2,), jnp.uint32))
    return learner, learner.agent.init(jax.random.key(1), representation), representation


def optimal_replay(
    env: Environment, learner: Learner, representation: Representation, episodes: int
) -> Replay | None:
    """A replay of the best possible episodes, as long as a trained agent's; None when no plan is known."""
    best = plan(env, learner.config.dqn.discount)
    if best is None or not isinstance(env, GridWorld):
        return None
    policy = OptimalPolicy(env, best)

    def play(key: jax.Array) -> tuple[StepRecord, jax.Array]:
        key_reset, key_steps = jax.random.split(key)
        env_state, timestep = env.reset(key_reset)

        def step(carry: tuple, key: jax.Array) -> tuple[tuple, tuple]:
            env_state, timestep, memory, over = carry
            action, memory = policy.act(memory, timestep.observation)
            env_state, timestep = env.step(key, env_state, action)
            return (env_state, timestep, memory, over | timestep.done), (timestep, action, over)

        start = (env_state, timestep, policy.initial_memory(), jnp.zeros((), bool))
        _, (later, action, over) = jax.lax.scan(step, start, jax.random.split(key_steps, env.horizon))
        timesteps = jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), timestep, later)
        previous = jnp.concatenate([jnp.full((1,), -1, jnp.int32), action])
        return learner.recorder(representation)(timesteps, previous), 1 + jnp.sum(~over, dtype=jnp.int32)

    data, length = jax.jit(jax.vmap(play))(jax.random.split(jax.random.key(2), episodes))
    slots = jnp.arange(episodes, dtype=jnp.int32)
    return Replay(data=data, length=length, finished=slots, open_slots=slots[:0], count=jnp.int32(episodes))


def rows_of_updates(learner: Learner, replay: Replay, keys: jax.Array) -> list[int]:
    """How many rows of tokens each update computes."""
    batch, row_length = learner.config.dqn.batch_episodes, replay.data.reward.shape[1]
    choices = row_choices(batch // 2)

    def used(key: jax.Array) -> jax.Array:
        slots = sample_episodes(replay, jax.random.split(key)[0], batch)
        return fit_folds(replay.length[slots], row_length).num_rows

    return [2 * min(rows for rows in choices if rows >= needed) for needed in np.asarray(jax.lax.map(used, keys))]


def update_gflop(
    learner: Learner, agent: AgentState, representation: Representation, replay: Replay, rows: int
) -> float:
    """Arithmetic of one stage-2 update on `rows` rows of tokens."""
    def update(agent: AgentState, key: jax.Array) -> AgentState:
        tokens = gather_rows(replay, jnp.arange(rows) % replay.capacity, one_per_row(rows), rows, learner.observations)
        return learner.agent.update(agent, tokens, representation, key)[0]

    return 1e-9 * operations(update, agent, jax.random.key(0))


def show(results: Sequence[Result], console: Console) -> None:
    """Print a table."""
    table = Table(box=None, pad_edge=False)
    for name in ("domain", "what", "per second", "", "ms", "compile s", "GFLOP", "of matmul", "peak MiB", "detail"):
        table.add_column(name, justify="left" if name in ("domain", "what", "", "detail") else "right", no_wrap=True)
    for r in results:
        table.add_row(
            r.domain, r.what, f"{r.per_second:,.1f}" if r.per_second < 1000 else f"{r.per_second:,.0f}", r.unit,
            f"{r.milliseconds:.3f}", f"{r.compile_seconds:.1f}", "" if r.gflop is None else f"{r.gflop:.3g}",
            "" if r.matmul_fraction is None else f"{r.matmul_fraction:.2f}", f"{r.peak_memory_mib:.0f}", r.detail)
    console.print(table)


PARTS: dict[str, Callable[[Bench, Environment], Iterator[Result]]] = {
    "environments": bench_environments, "acting": bench_acting, "stage1": bench_stage1, "stage2": bench_stage2,
    "agents": bench_agents, "seeds": bench_seeds}
ROBOT_PARTS = {"environments": bench_robot, "stage1": bench_stage1, "stage2": bench_sac}
"""What there is to measure on a robot task."""


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Options of the command."""
    parser = argparse.ArgumentParser(prog="python -m launch.bench", description="How fast everything is here.")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--only", nargs="+", choices=tuple(PARTS), default=tuple(PARTS), help="parts to measure")
    parser.add_argument("--domains", nargs="+", choices=(*configs.DOMAINS, *configs.ROBOTS),
                        default=configs.DOMAINS, help="the robots only where named")
    parser.add_argument("--quick", action="store_true", help="tiny sizes; the numbers mean nothing")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = parse(sys.argv[1:] if arguments is None else arguments)
    runtime.prepare(host_devices=runtime.cores() if {"environments", "seeds"} & set(options.only) else 1)
    if not options.quick:
        jax.config.update("jax_enable_compilation_cache", False)
    bench = Bench(QUICK if options.quick else Sizes())
    results = [bench.matmul()]
    for domain in options.domains:
        parts = ROBOT_PARTS if domain in configs.ROBOTS else PARTS
        for part in (part for part in parts if part in options.only):
            results.extend(parts[part](bench, registry.make(domain)))
    if options.json:
        print(json.dumps({"matmul_gflops": bench.matmul_gflops, "results": [vars(r) for r in results]}, indent=2))
    else:
        show(results, Console(width=None if sys.stdout.isatty() else 200))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Several seeds: every strategy follows the same numbers, and a checkpoint of one restores under another."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest
from tokens import FEATURES, TINY, representation

from envs_mjx import registry
from launch.scale import gflop, traffic
from mijax.config import Config, DQNConfig, EvaluationConfig, SeedStrategy, Stage1Config
from mijax.learner import LearnerState, make_learner
from mijax.seeds import SeedRunner, resolve, training_key

pytestmark = pytest.mark.lenient

SEEDS = (0, 1, 2)
CONFIG = Config(
    memory="gru", stage1=Stage1Config(features=FEATURES), network=TINY,
    dqn=DQNConfig(batch_episodes=4, warmup_episodes=4, replay_steps=1000),
    evaluation=EvaluationConfig(every=200, episodes=4),
)
"""20 updates in a chunk. Without dropout, whose bits depend on how the episodes are packed."""
States = dict[int, LearnerState]


def fresh(seeds: tuple[int, ...], strategy: SeedStrategy, config: Config = CONFIG) -> SeedRunner:
    """Seeds that have not started."""
    env = registry.make("heaven_hell")
    return SeedRunner(lambda pack: make_learner(env, config, pack), seeds, strategy)


def started(seeds: tuple[int, ...], strategy: SeedStrategy) -> SeedRunner:
    """`mi`, each seed with encoders of its own."""
    runner = fresh(seeds, strategy)
    runner.init({seed: representation(registry.make("heaven_hell"), seed) for seed in seeds})
    return runner


def copied(states: States) -> States:
    """A chunk takes the buffers of the states it starts from."""
    return jax.tree.map(lambda x: x.copy(), states)


def equal(x: Any, y: Any) -> bool:
    """Bit for bit."""
    return all(jax.tree.leaves(jax.tree.map(np.array_equal, x, y)))


def note_compiled(names: list[str], event: str, duration_secs: float, **kwargs: str | int) -> None:
    """Listens to what JAX compiles, or takes from its cache."""
    del duration_secs
    if event.endswith("backend_compile_duration"):
        names.append(str(kwargs.get("fun_name")))


class Followed:
    """All seeds under a strategy: their metrics over two chunks, their states at the start and between them."""

    def __init__(self, strategy: SeedStrategy) -> None:
        compiled: list[str] = []
        listener = functools.partial(note_compiled, compiled)
        jax.monitoring.register_event_duration_secs_listener(listener)
        env = registry.make("heaven_hell")
        self.runner = fresh(SEEDS, strategy)
        self.programs = self.runner.compile(jax.eval_shape(
            self.runner.learner.init, training_key(0), representation(env, 0)))
        self.compiled_at_first = compiled.copy()
        self.runner.init({seed: representation(env, seed) for seed in SEEDS})
        self.start = copied(self.runner.states())
        self.first = self.runner.advance()
        self.step, self.states = self.runner.step, copied(self.runner.states())
        self.second = self.runner.advance()
        self.compiled = compiled.copy()
        jax.monitoring.unregister_event_duration_listener(listener)

    def go_on_from(self, states: States) -> SeedRunner:
        """The runner, at other states."""
        self.runner.restore(copied(states))
        return self.runner


@pytest.fixture(scope="module")
def follow() -> Callable[[SeedStrategy], Followed]:
    """Every strategy is compiled once."""
    return functools.cache(Followed)


def assert_close(metrics: dict[int, dict[str, float]], expected: dict[int, dict[str, float]], rtol: float) -> None:
    for seed in SEEDS:
        for name, value in expected[seed].items():
            np.testing.assert_allclose(
                metrics[seed][name], value, rtol=rtol, atol=rtol / 10, err_msg=f"{seed} {name}")


@pytest.mark.parametrize(("strategy", "rtol"), [("shard", 0.0), ("vmap", 2e-3)])
def test_strategies_agree(follow: Callable[[SeedStrategy], Followed], strategy: SeedStrategy, rtol: float) -> None:
    """From the start; and, going on where `map` stopped, on the same numbers as `map`."""
    mapped, other = follow("map"), follow(strategy)
    assert other.step == mapped.step
    assert_close(other.first, mapped.first, rtol)
    runner = other.go_on_from(mapped.states)
    assert runner.step == mapped.step
    for seed, state in runner.states().items():
        for part in ("agent", "replay", "representation"):
            assert equal(getattr(state, part), getattr(mapped.states[seed], part))
    assert_close(runner.advance(), mapped.second, rtol)


@pytest.mark.parametrize("strategy", ["map", "shard", "vmap"])
def test_a_state_goes_on_bit_for_bit(follow: Callable[[SeedStrategy], Followed], strategy: SeedStrategy) -> None:
    followed = follow(strategy)
    assert followed.go_on_from(followed.states).advance() == followed.second


def test_seeds_have_their_own_representations_and_ways(follow: Callable[[SeedStrategy], Followed]) -> None:
    states = follow("vmap").states
    for seed in SEEDS:
        expected = representation(registry.make("heaven_hell"), seed)
        assert equal(states[seed].representation, expected)
        assert not equal(states[seed].agent.params, states[(seed + 1) % 3].agent.params)
        assert not equal(states[seed].replay.data.z_s, states[(seed + 1) % 3].replay.data.z_s)


@pytest.mark.parametrize("strategy", ["shard", "vmap"])
def test_every_device_is_used(follow: Callable[[SeedStrategy], Followed], strategy: SeedStrategy) -> None:
    states = follow(strategy).runner.states()
    assert list(states) == list(SEEDS)
    devices = {seed: next(iter(state.iteration.devices())) for seed, state in states.items()}
    assert len(set(devices.values())) == len(jax.local_devices()) == 2


@pytest.mark.parametrize("strategy", ["shard", "vmap"])
def test_devices_work_alone(follow: Callable[[SeedStrategy], Followed], strategy: SeedStrategy) -> None:
    """Nothing passes between them, and under `shard` each does what one does with one seed."""
    programs = follow(strategy).programs
    assert len(programs) == 2
    assert [traffic(program) for program in programs] == [0, 0]
    if strategy == "shard":
        alone, = follow("map").programs
        assert [gflop(program) for program in programs] == [gflop(alone)] * 2
        assert gflop(alone) > 0


def test_traffic_is_seen() -> None:
    mesh = jax.make_mesh((2,), ("seeds",), axis_types=(jax.sharding.AxisType.Auto,))
    spread = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("seeds"))
    shape = jax.ShapeDtypeStruct((8,), np.float32, sharding=spread)
    assert traffic(jax.jit(lambda x: x - x.mean()).lower(shape).compile()) > 0
    assert traffic(jax.jit(lambda x: x * 2).lower(shape).compile()) == 0


def test_a_seed_alone_is_the_same_bit_for_bit(follow: Callable[[SeedStrategy], Followed]) -> None:
    alone, many = started((2,), "map"), follow("map")
    assert alone.advance()[2] == many.first[2]
    one, other = alone.states()[2], many.states[2]
    assert equal((one.agent, one.replay), (other.agent, other.replay))


def test_an_agent_without_a_representation_warms_up_alike(follow: Callable[[SeedStrategy], Followed]) -> None:
    """Its replay is that of `mi` without z_s."""
    runner = fresh(SEEDS, "vmap", dataclasses.replace(CONFIG, agent="base"))
    runner.init(None)
    for seed, state in runner.states().items():
        expected = follow("map").start[seed].replay
        assert state.representation is None
        assert equal(state.replay, dataclasses.replace(expected, data=dataclasses.replace(expected.data, z_s=None)))


@pytest.mark.parametrize("strategy", ["map", "shard", "vmap"])
def test_learning_is_compiled_once_before_there_is_a_state(
    follow: Callable[[SeedStrategy], Followed], strategy: SeedStrategy,
) -> None:
    followed = follow(strategy)
    learning = [name for name in followed.compiled if "chunk" in name]
    assert learning
    assert [name for name in followed.compiled_at_first if "chunk" in name] == learning


def test_auto() -> None:
    assert resolve("auto", 1) == "map"
    assert resolve("auto", 5) == "shard"  # on the CPU of the tests
    assert resolve("vmap", 1) == "vmap"
    assert fresh(SEEDS, "auto").strategy == "shard"


def test_evaluation_does_not_touch_the_learning(follow: Callable[[SeedStrategy], Followed]) -> None:
    followed = follow("map")
    runner = followed.go_on_from(followed.states)
    results = runner.evaluate(4)
    assert set(results) == set(SEEDS)
    assert 0 <= results[0]["success"] <= 1
    assert runner.advance() == followed.second

"""Several seeds: every strategy follows the same numbers, and a checkpoint of one restores under another."""

import jax
import numpy as np
import pytest

from envs_mjx import registry
from mijax.config import Config, DQNConfig, EvaluationConfig, NetworkConfig, SeedStrategy
from mijax.learner import make_learner
from mijax.seeds import SeedRunner, resolve

pytestmark = pytest.mark.lenient

SEEDS = (0, 1, 2)
CONFIG = Config(
    agent="base",
    network=NetworkConfig(action_embedding=4, observation_embedding=4, critic_hidden=(8,), auxiliary_hidden=(8,),
                          dropout=0.0),
    dqn=DQNConfig(batch_episodes=4, warmup_episodes=4, replay_steps=1000),
    evaluation=EvaluationConfig(every=200, episodes=4),
)
"""20 updates in a chunk. Without dropout, whose bits depend on how the episodes are packed."""


def runner(seeds: tuple[int, ...], strategy: SeedStrategy) -> SeedRunner:
    env = registry.make("heaven_hell")
    made = SeedRunner(lambda pack: make_learner(env, CONFIG, pack), seeds, strategy)
    made.init(None)
    return made


@pytest.fixture(scope="module")
def mapped() -> tuple[SeedRunner, dict[int, dict[str, float]]]:
    made = runner(SEEDS, "map")
    return made, made.advance()


@pytest.mark.parametrize("strategy", ["shard", "vmap"])
def test_strategies_agree(mapped: tuple[SeedRunner, dict], strategy: SeedStrategy) -> None:
    other = runner(SEEDS, strategy)
    metrics = other.advance()
    assert other.step == mapped[0].step
    for seed in SEEDS:
        for name, value in mapped[1][seed].items():
            np.testing.assert_allclose(metrics[seed][name], value, rtol=2e-3, atol=2e-4, err_msg=f"{seed} {name}")


def test_shard_uses_every_device() -> None:
    states = runner(SEEDS, "shard").states()
    devices = {seed: next(iter(state.iteration.devices())) for seed, state in states.items()}
    assert len(set(devices.values())) == len(jax.local_devices()) == 2


def test_a_seed_alone_is_the_same_bit_for_bit(mapped: tuple[SeedRunner, dict]) -> None:
    alone = runner((2,), "map")
    assert alone.advance()[2] == mapped[1][2]
    one, many = alone.states()[2], mapped[0].states()[2]
    same = jax.tree.map(lambda x, y: bool((x == y).all()), (one.agent, one.replay), (many.agent, many.replay))
    assert all(jax.tree.leaves(same))


def test_a_state_of_map_goes_on_under_vmap(mapped: tuple[SeedRunner, dict]) -> None:
    before = mapped[0].states()
    env = registry.make("heaven_hell")
    other = SeedRunner(lambda pack: make_learner(env, CONFIG, pack), SEEDS, "vmap")
    other.restore(before)
    assert other.step == mapped[0].step
    for seed, state in other.states().items():
        equal = jax.tree.map(lambda x, y: bool((x == y).all()), state.agent.params, before[seed].agent.params)
        assert all(jax.tree.leaves(equal))


def test_auto() -> None:
    assert resolve("auto", 1) == "map"
    assert resolve("auto", 5) == "shard"  # on the CPU of the tests
    assert resolve("vmap", 1) == "vmap"


def test_evaluation_does_not_touch_the_learning(mapped: tuple[SeedRunner, dict]) -> None:
    before = mapped[0].states()[0]
    results = mapped[0].evaluate(4)
    assert set(results) == set(SEEDS)
    assert 0 <= results[0]["success"] <= 1
    same = jax.tree.map(lambda x, y: x is y, mapped[0].states()[0], before)
    assert all(jax.tree.leaves(same))

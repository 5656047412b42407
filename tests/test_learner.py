"""The jitted loop: its schedule, what it stores, what it may not see, and whether it learns."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from tokens import FEATURES, TINY, random_like, representation

from envs_mjx.base import ArraySpec, DiscreteActions, Environment, TimeStep
from mijax.agents.variants import needs_representation
from mijax.config import (
    BelieverConfig,
    Config,
    DQNConfig,
    EvaluationConfig,
    InformationConfig,
    NetworkConfig,
    Stage1Config,
)
from mijax.learner import Learner, LearnerState, make_learner
from mijax.representation.dataset import collect
from mijax.representation.model import networks_for
from mijax.types import Metrics, Representation

NUM_ENVS, STEPS = 4, 3  # 12 environment steps and 6 updates in an iteration
CONFIG = Config(
    memory="gru", steps=10_000, num_envs=NUM_ENVS, steps_per_iteration=STEPS, stage1=Stage1Config(features=FEATURES),
    network=dataclasses.replace(TINY, dropout=NetworkConfig().dropout),
    dqn=DQNConfig(batch_episodes=4, updates_per_step=0.5, warmup_episodes=10, replay_steps=1000, epsilon_steps=200,
                  epsilon_final=0.1),
    evaluation=EvaluationConfig(every=24),
)
BASE = dataclasses.replace(CONFIG, agent="base")
pytestmark = pytest.mark.lenient  # every update runs Adam


@struct.dataclass
class RecallState:
    """What `Recall` remembers."""

    cue: jax.Array  # () int32
    time: jax.Array  # () int32


class Recall(Environment):
    """A cue, 0 or 1, is seen at the start; after three empty steps the action must name it: +1 if it does, else 0.

    Observation (3,): the cue as -1 or +1 at time 0 and 0 later, the time, and whether the episode is over. State (2,):
    the cue and the time. Without memory nothing beats a guess, 0.5.
    """

    name, horizon, choice = "recall", 5, 3
    observation_spec, state_spec, action_spec = ArraySpec((3,)), ArraySpec((2,)), DiscreteActions(2)

    def reset(self, key: jax.Array) -> tuple[RecallState, TimeStep]:
        env_state = RecallState(jax.random.randint(key, (), 0, 2), jnp.zeros((), jnp.int32))
        return env_state, self.show(env_state, jnp.zeros(()), jnp.zeros((), bool))

    def step(self, key: jax.Array, env_state: RecallState, action: jax.Array) -> tuple[RecallState, TimeStep]:
        del key
        chosen = env_state.time == self.choice
        after = RecallState(env_state.cue, env_state.time + 1)
        return after, self.show(after, (chosen & (action == env_state.cue)).astype(jnp.float32), chosen)

    def show(self, env_state: RecallState, reward: jax.Array, terminated: jax.Array) -> TimeStep:
        sign, time = 2.0 * env_state.cue - 1, env_state.time.astype(jnp.float32)
        observation = jnp.stack([jnp.where(time == 0, sign, 0), time / self.horizon, terminated.astype(jnp.float32)])
        return TimeStep(observation, jnp.stack([sign, time]), reward, terminated, jnp.zeros((), bool))


class Actions(Recall):
    """Never terminates, and the return spells out the actions: sum_t 2^t a_t."""

    def step(self, key: jax.Array, env_state: RecallState, action: jax.Array) -> tuple[RecallState, TimeStep]:
        after, timestep = super().step(key, env_state, action)
        reward = action.astype(jnp.float32) * 2.0**env_state.time
        return after, dataclasses.replace(
            timestep, reward=reward, terminated=jnp.zeros((), bool), truncated=after.time >= self.horizon)


def with_garbage_states(env: type[Recall]) -> Recall:
    """The same task, whose states are noise."""

    class Garbage(env):
        def show(self, env_state: RecallState, reward: jax.Array, terminated: jax.Array) -> TimeStep:
            timestep = super().show(env_state, reward, terminated)
            return dataclasses.replace(timestep, state=jnp.sin(97.0 * timestep.state + timestep.observation[:2]))

    return Garbage()


def random_representation() -> Representation:
    """Encoders that were never trained, and the scale of what they say: phi still tells the cue."""
    untrained, phi = representation(Recall()), networks_for(Recall(), FEATURES).phi
    z: Any = phi.apply({"params": untrained.phi}, jnp.array([[s, t] for s in (-1.0, 1.0) for t in range(5)]))
    return dataclasses.replace(untrained, z_s_mean=z.mean(0), z_s_variance=z.var(0).sum())


class Run:
    """A learner with its functions compiled; how often `chunk` was."""

    def __init__(self, env: Environment, config: Config) -> None:
        self.learner, self.traces = make_learner(env, config, pack=False), 0
        self.representation = random_representation() if needs_representation(config) else None
        self.init = jax.jit(self.learner.init)
        self.chunk = jax.jit(self._chunk)
        self.evaluate = jax.jit(self.learner.evaluate, static_argnums=2)

    def start(self, seed: int = 0) -> LearnerState:
        return self.init(jax.random.key(seed), self.representation)

    def _chunk(self, state: LearnerState) -> tuple[LearnerState, Metrics]:
        self.traces += 1
        return self.learner.run_chunk(state)


def equal(x: Any, y: Any) -> bool:
    """Two pytrees hold the same numbers, bit for bit."""
    def numbers(leaf: Any) -> np.ndarray:
        return np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)

    same = jax.tree.map(lambda a, b: np.array_equal(numbers(a), numbers(b)), x, y)
    return all(jax.tree.leaves(same))


@pytest.fixture(scope="module")
def base() -> tuple[Run, list[LearnerState], list[dict[str, np.ndarray]]]:
    """`base` at the start and after each of three chunks of 2 iterations, and the chunks' metrics."""
    run = Run(Recall(), BASE)
    states, metrics = [run.start()], []
    for _ in range(3):
        state, measured = run.chunk(states[-1])
        states.append(state)
        metrics.append(jax.device_get(measured))
    return run, states, metrics


def test_a_chunk_compiles_once_and_does_the_same_again(base):
    run, states, metrics = base
    assert run.traces == 1  # for three chunks
    state, again = run.chunk(states[1])
    assert equal(state, states[2])
    assert equal(again, metrics[1])


@pytest.mark.parametrize("agent", ["zp", "ua", "believer", "mdp"])
def test_every_agent_runs_in_the_loop(agent: str):
    stage1, believer = dataclasses.replace(CONFIG.stage1, episodes=8), BelieverConfig(samples=3, updates=2)
    run = Run(Recall(), dataclasses.replace(CONFIG, agent=agent, memory="auto", stage1=stage1, believer=believer))
    state, metrics = run.chunk(run.start())
    assert int(state.agent.updates) == 12
    assert all(np.isfinite(x) for name, x in jax.device_get(metrics).items() if not name.startswith("train/"))
    results = run.evaluate(state, jax.random.key(0), 3)
    assert results["return"].shape == (3,)


def test_every_iteration_is_the_same_work(base):
    run, states, metrics = base
    learner: Learner = run.learner
    assert learner.warmup_steps == 12 * Recall.horizon  # 10 episodes in rounds of 4 environments
    assert learner.iterations_per_chunk == 2
    for i, state in enumerate(states):
        assert int(state.iteration) == 2 * i
        assert int(learner.environment_steps(state)) == 60 + 24 * i
        assert int(state.agent.updates) == 12 * i
        replay = state.replay
        finished = int(np.asarray(replay.length)[np.asarray(replay.finished)[: int(replay.count)]].sum() - replay.count)
        assert finished + int(state.episodes.position.sum()) == 60 + 24 * i  # every step is in the replay
    assert sum(int(m["train/episodes"]) for m in metrics) == int(states[-1].replay.count - states[0].replay.count)
    assert metrics[0]["train/length"] == Recall.choice + 1
    assert all(np.isfinite(x) for m in metrics for x in m.values())


def test_epsilon_falls_linearly_and_stays(base):
    learner: Learner = base[0].learner
    for steps, expected in ((0, 1.0), (100, 0.55), (200, 0.1), (10_000, 0.1)):
        assert float(learner.epsilon(jnp.int32(steps))) == pytest.approx(expected)
    assert base[2][1]["train/epsilon"] == pytest.approx(1 - 0.9 * (60 + 48) / 200)


def finished_episodes(state: LearnerState) -> list[dict[str, np.ndarray]]:
    """Observations, rewards and ends of all finished episodes."""
    replay = jax.device_get(state.replay)
    return [{name: getattr(replay.data, name)[slot, : replay.length[slot]]
             for name in ("observation", "previous_action", "reward", "terminated", "truncated")}
            for slot in replay.finished[: int(replay.count)]]


def test_episodes_are_stored_whole_from_the_reset_to_the_final_observation(base):
    for episode in finished_episodes(base[1][-1]):
        observation = episode["observation"]
        np.testing.assert_allclose(observation[:, 1], np.arange(5) / Recall.horizon, rtol=1e-6)
        assert observation[:, 2].tolist() == [0, 0, 0, 0, 1]
        assert episode["terminated"].tolist() == [False] * 4 + [True]
        assert not episode["truncated"].any()
        assert abs(observation[0, 0]) == 1
        assert episode["previous_action"][0] == -1
        assert episode["reward"][-1] == ((observation[0, 0] > 0) == episode["previous_action"][-1])
        assert not episode["reward"][:-1].any()


def test_resets_draw_the_hidden_variable_anew(base):
    cues = np.array([episode["observation"][0, 0] for episode in finished_episodes(base[1][-1])])
    assert len(cues) >= 24
    by_round = cues[: len(cues) // NUM_ENVS * NUM_ENVS].reshape(-1, NUM_ENVS)
    assert (by_round.min(axis=0) != by_round.max(axis=0)).all()  # in every environment over time
    assert (by_round.min(axis=1) != by_round.max(axis=1)).any()  # and between environments


def test_seeds_differ(base):
    run, states, _ = base
    assert not equal(run.start(seed=1).replay, states[0].replay)


def test_packing_gives_the_same_update(base):
    run, states, _ = base
    packed = make_learner(Recall(), BASE, pack=True)
    replay = states[-1].replay
    short = dataclasses.replace(replay, length=jnp.minimum(replay.length, 3))  # two of them fit in one row
    (first, metrics), (second, expected) = (
        jax.jit(learner.update)(states[-1].agent, short, None, jax.random.key(2)) for learner in (packed, run.learner))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-6), metrics, expected)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-5), first.target, second.target)


# What may depend on the state


@pytest.mark.parametrize("agent", ["base", "ba", "ua"])
def test_acting_does_not_see_the_state(agent: str):
    """Greedy or exploring, its actions, which the return spells, are the same whatever the states say."""
    config = dataclasses.replace(CONFIG, agent=agent)
    runs = [Run(env, config) for env in (Actions(), with_garbage_states(Actions))]
    collect = [jax.jit(run.learner.collect_chunk) for run in runs]
    state, sequences = runs[0].start(), []
    state = dataclasses.replace(state, iteration=jnp.int32(100))  # nearly greedy
    for seed in range(24):
        lively = random_like(state.agent.target, 1.0, seed)
        of_agent = dataclasses.replace(state.agent, params={"agent": lively}, target=lively)
        state = dataclasses.replace(state, agent=of_agent)
        greedy, other = (run.evaluate(state, jax.random.key(3), 64) for run in runs)
        assert equal(greedy, other)
        assert equal(*(program(state)[0] for program in collect))
        sequences.append(len(np.unique(greedy["return"])))
    assert max(sequences) == 2  # one for each cue: some of these agents do look at it


def test_garbage_states_change_nothing_in_training_without_z_s(base):
    _, states, metrics = base
    state, measured = Run(with_garbage_states(Recall), BASE).chunk(states[0])
    assert equal(measured, metrics[0])
    assert not equal(state.episodes.timestep.state, states[1].episodes.timestep.state)
    for part in ("agent", "replay", "iteration"):
        assert equal(getattr(state, part), getattr(states[1], part))


def test_garbage_states_reach_only_the_losses_on_z_s():
    """With both weights at 0, z_s is predicted and measured; the agent and all it does stay the same."""
    config = dataclasses.replace(CONFIG, information=InformationConfig(auxiliary_weight=0.0, intrinsic_weight=0.0))
    runs = [Run(env, config) for env in (Recall(), with_garbage_states(Recall))]
    start = runs[0].start()
    (state, metrics), (other, garbage) = (run.chunk(start) for run in runs)
    assert {name for name in metrics if not equal(metrics[name], garbage[name])} == {
        "loss/auxiliary", "auxiliary/explained"}
    assert equal(state.agent.params["agent"], other.agent.params["agent"])
    assert not equal(state.replay.data.z_s, other.replay.data.z_s)
    without_labels = [dataclasses.replace(s.replay, data=dataclasses.replace(s.replay.data, z_s=None))
                      for s in (state, other)]
    assert equal(*without_labels)


# Learning


def test_recall_cannot_be_solved_without_memory():
    """All that is seen from the first step on is the same for both cues."""
    env = Recall()
    for time in range(1, env.choice + 1):
        seen = [env.show(RecallState(jnp.int32(cue), jnp.int32(time)), jnp.zeros(()), jnp.zeros((), bool)).observation
                for cue in range(2)]
        assert equal(*seen)


def test_the_replay_of_ours_starts_with_the_episodes_that_stage_1_learnt_from():
    config = dataclasses.replace(
        CONFIG, dqn=dataclasses.replace(CONFIG.dqn, pretrain_updates=8),
        stage1=Stage1Config(features=FEATURES, episodes=9))
    run = Run(Recall(), config)
    assert run.representation is not None
    key = jax.random.key(5)
    run.representation = dataclasses.replace(run.representation, data_key=jax.random.key_data(key))
    state, data = run.start(), collect(Recall(), key, 9)
    assert run.learner.warmup_steps == 0
    assert int(state.iteration) == -run.learner.pretrain_iterations == -2  # 6 updates in an iteration
    assert int(state.replay.count) == 9
    transitions = 0
    for number, slot in enumerate(np.asarray(state.replay.finished[:9])):
        steps, rows = int(state.replay.length[slot]) - 1, np.flatnonzero(np.asarray(data.episode) == number)
        stored = jax.tree.map(lambda x, slot=slot: np.asarray(x[slot]), state.replay.data)
        assert steps == len(rows)
        np.testing.assert_array_equal(stored.observation[:steps], data.observations[data.observation[rows]])
        np.testing.assert_array_equal(stored.observation[1 : steps + 1], data.observations[data.next_observation[rows]])
        np.testing.assert_array_equal(stored.previous_action[: steps + 1], [-1, *data.action[rows]])
        np.testing.assert_array_equal(stored.reward[: steps + 1], [0, *data.reward[rows]])
        np.testing.assert_array_equal(stored.terminated[1 : steps + 1], data.terminal[rows])
        z_s: Any = networks_for(Recall(), FEATURES).phi.apply(
            {"params": run.representation.phi}, data.states[data.state[rows]])
        np.testing.assert_allclose(stored.z_s[:steps], z_s, rtol=1e-5)
        transitions += steps
    assert transitions == data.size
    assert run.learner.epsilon(jnp.int32(0)) == pytest.approx(config.dqn.pretrained_epsilon)
    assert run.learner.epsilon(jnp.int32(10**6)) == pytest.approx(config.dqn.epsilon_final)


def test_who_has_no_stage_1_starts_with_random_episodes(base):
    assert BASE.dqn.pretrain_updates == 0
    eager = dataclasses.replace(BASE, dqn=dataclasses.replace(BASE.dqn, pretrain_updates=8))
    learner = make_learner(Recall(), eager)
    assert learner.pretrain_iterations == 0
    assert learner.warmup_steps == base[0].learner.warmup_steps > 0
    assert learner.epsilon(jnp.int32(0)) == 1


LEARNING = dataclasses.replace(
    CONFIG, num_envs=8, steps_per_iteration=4, steps=3200,
    network=NetworkConfig(action_embedding=8, observation_embedding=8, gru_width=16, critic_hidden=(32,),
                          auxiliary_hidden=(32,)),
    dqn=DQNConfig(batch_episodes=16, updates_per_step=0.25, learning_rate=3e-3, target_rate=0.02, epsilon_steps=1000,
                  replay_steps=20_000, pretrain_updates=200),
    evaluation=EvaluationConfig(every=3200), believer=BelieverConfig(samples=4, updates=300),
)


SLOW_LEARNERS = (("mi", "gpt"), ("mi", "gru"), ("base", "gpt"), ("zp", "gru"), ("ba", "gpt"), ("ba", "gru"),
                 ("ua", "gpt"), ("ua", "gru"), ("believer", "gpt"), ("believer", "gru"), ("mdp", "mlp"))


@pytest.mark.parametrize(("agent", "memory"), [
    ("base", "gru"), *(pytest.param(*names, marks=pytest.mark.slow) for names in SLOW_LEARNERS)])
def test_a_memory_task_is_solved(agent: str, memory: Any):
    run = Run(Recall(), dataclasses.replace(LEARNING, agent=agent, memory=memory))
    state, _ = run.chunk(run.start())
    results = jax.device_get(run.evaluate(state, jax.random.key(1), 200))
    assert results["success"].mean() >= 0.99
    assert results["return"].mean() >= 0.99
    assert (results["length"] == Recall.choice + 1).all()
    np.testing.assert_allclose(results["discounted_return"], results["return"] * 0.99**Recall.choice, rtol=1e-5)

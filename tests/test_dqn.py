"""The Double-DQN core against targets worked out by loops over an episode."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tokens import CONTINUOUS, DISCRETE, FEATURES, ROW, SPANS, TINY, AgentCase, Shapes, episodes, representation

from mijax.agents.dqn import DQN, AgentState, make_dqn
from mijax.config import Config, ConfigError, DQNConfig, InformationConfig, Stage1Config

CONFIG = Config(
    memory="gru", stage1=Stage1Config(features=FEATURES), network=TINY, dqn=DQNConfig(discount=0.9, target_rate=0.1),
    information=InformationConfig(
        intrinsic_weight=0.5, auxiliary_weight=0.25, folds=2, intrinsic_form="explained_variance"),
)
BASE = dataclasses.replace(CONFIG, agent="base")
SHAPES = Shapes(DISCRETE)


def agent_of(config: Config) -> DQN:
    return make_dqn(SHAPES, config)


def changed(config: Config, **dqn: Any) -> Config:
    return dataclasses.replace(config, dqn=dataclasses.replace(config.dqn, **dqn))


@pytest.fixture(scope="module")
def states() -> dict[str, AgentState]:
    """Of `mi` and `base`, with random parameters."""
    return {config.agent: AgentCase(make_dqn, DISCRETE, config).state for config in (CONFIG, BASE)}


def loss_by_loops(q: Any, q_target: Any, bonus: np.ndarray, dqn: DQNConfig) -> tuple[float, int]:
    """The TD loss transition by transition, and how many traces were cut at an action that was not greedy."""
    tokens = jax.device_get(episodes(DISCRETE))
    errors, cut = [], 0
    for row, first, end in SPANS:
        later = 0.0
        for t in reversed(range(first + 1, end)):  # the transition that arrives at token t
            value = q_target[row, t, np.argmax(q[row, t])]
            if dqn.value_bound:
                value = min(max(value, -dqn.value_bound), dqn.value_bound)
            ended = tokens.terminated[row, t] or (tokens.truncated[row, t] and not dqn.bootstrap_at_time_limit)
            taken = q[row, t, tokens.previous_action[row, t + 1]] if t + 1 < end else -np.inf
            greedy_next = taken >= np.max(q[row, t]) - dqn.trace_tolerance
            cut += t + 1 < end and not greedy_next
            trace = dqn.trace_decay if greedy_next else 0.0
            future = 0.0 if ended else dqn.discount * ((1 - trace) * value + trace * later)
            later = float(tokens.reward[row, t] + bonus[row, t] + future)
            errors.append(later - float(q[row, t - 1, tokens.previous_action[row, t]]))
    return float(np.mean(np.square(errors))), cut


@pytest.mark.parametrize(
    ("bootstrap", "trace_decay", "tolerance", "bound"),
    [(False, 0.0, 0.0, 0.0), (True, 0.7, 0.0, 0.0), (True, 0.7, 0.1, 0.0), (True, 0.7, 0.0, 0.1)])
def test_td_loss_by_hand(
    states: dict[str, AgentState], bootstrap: bool, trace_decay: float, tolerance: float, bound: float
):
    config = changed(BASE, bootstrap_at_time_limit=bootstrap, trace_decay=trace_decay, trace_tolerance=tolerance,
                     value_bound=bound)
    agent, state, tokens = agent_of(config), states["base"], episodes(DISCRETE)
    network: Any = jax.jit(agent.network.apply)
    q, q_target = (network({"params": p}, tokens).q for p in (state.params["agent"], state.target))
    expected, cut = loss_by_loops(q, q_target, np.zeros((2, ROW)), config.dqn)
    loss, metrics = jax.jit(agent.loss)(state.params, state.target, tokens, None, state.updates, jax.random.key(0))
    assert 0 < cut < 6
    assert float(loss) == pytest.approx(expected, rel=1e-4)
    assert float(metrics["loss/td"]) == pytest.approx(expected, rel=1e-4)
    assert float(metrics["train/bonus"]) == 0


@pytest.mark.parametrize(("form", "telescopes"), [
    ("explained_variance", False), ("cosine", False), ("cosine", True), ("log_likelihood", True)])
def test_losses_and_bonus_of_ours_by_hand(states: dict[str, AgentState], form: Any, telescopes: bool):
    config = dataclasses.replace(CONFIG, information=dataclasses.replace(
        CONFIG.information, intrinsic_form=form, intrinsic_telescopes=telescopes))
    state = AgentCase(make_dqn, DISCRETE, config).state if form == "log_likelihood" else states["mi"]
    agent, tokens, rep = agent_of(config), episodes(DISCRETE), representation(SHAPES)
    assert agent.information_model is not None
    network: Any = jax.jit(agent.network.apply)
    online, averaged = (network({"params": p}, tokens) for p in (state.params["agent"], state.target))
    q, k, q_target = online.q, online.z_s, averaged.q
    model: Any = jax.jit(agent.information_model.apply)
    believed = [model({"params": params}, tokens) for params in state.params["f"]]  # row i is fold i
    k, *f = (np.arange(FEATURES) + np.sqrt(2) * np.asarray(x) for x in (k, *(b.mean for b in believed)))  # units of z_s
    z = np.asarray(tokens.z_s)

    def nats(x: np.ndarray, mean: np.ndarray, log_variance: float) -> float:
        return -(log_variance + np.sum((x - mean) ** 2) / 2.0 / math.exp(log_variance)) / 2

    def cosine(x: np.ndarray, y: np.ndarray) -> float:
        return float(x @ y / np.linalg.norm(x) / np.linalg.norm(y))

    bonus, errors_f, errors_k, errors_variance = np.zeros((2, ROW)), [], [], []
    for row, first, end in SPANS:
        for t in range(first, end):
            errors_f.append(np.sum((z[row, t] - f[row][row, t]) ** 2) / 2.0)
            unseen = f[1 - row][row]  # the bonus comes from the model that is not trained on this episode
            z_t, z_before = z[row, t], z[row, t - 1 if telescopes else t]
            errors_k.append(np.sum((z[row, t] - k[row, t]) ** 2) / 2.0)
            if form == "log_likelihood":
                errors_variance.append(-nats(z[row, t], f[row][row, t], float(believed[row].log_variance[row, t])))
            if t > first and form == "cosine":
                bonus[row, t] = 0.5 * (cosine(z_t, unseen[t]) - cosine(z_before, unseen[t - 1]))
            elif t > first and form == "log_likelihood":
                before, after = (
                    max(nats(x, unseen[i], float(believed[1 - row].log_variance[row, i])) / math.log(10), -1)
                    for i, x in ((t - 1, z_before), (t, z_t)))
                bonus[row, t] = 0.5 * (after - before)
            elif t > first:
                before, after = (np.sum((x - unseen[i]) ** 2) for i, x in ((t - 1, z_before), (t, z_t)))
                bonus[row, t] = 0.5 * (before - after) / 2.0
    expected, _ = loss_by_loops(q, q_target, bonus, config.dqn)
    loss, metrics = jax.jit(agent.loss)(state.params, state.target, tokens, rep, state.updates, jax.random.key(0))
    assert float(metrics["loss/f"]) == pytest.approx(np.mean(errors_f), rel=1e-4)
    assert float(metrics["loss/auxiliary"]) == pytest.approx(np.mean(errors_k), rel=1e-4)
    assert float(metrics["loss/td"]) == pytest.approx(expected, rel=1e-4)
    assert float(metrics["train/bonus"]) == pytest.approx(bonus.sum() / len(SPANS), rel=1e-3, abs=1e-6)
    total = expected + np.mean(errors_f) + 0.25 * np.mean(errors_k) + np.mean(errors_variance or [0.0])
    assert float(loss) == pytest.approx(total, rel=1e-4)


def test_f_learns_from_its_own_loss_only(states: dict[str, AgentState]):
    """The bonus is a reward: no gradient of the TD loss reaches f, and none of f's loss reaches the agent."""
    agent, state, tokens, rep = agent_of(CONFIG), states["mi"], episodes(DISCRETE), representation(SHAPES)

    @jax.jit
    def gradients(params: Any) -> tuple[Any, Any]:
        def part(params: Any, name: str) -> jax.Array:
            return agent.loss(params, state.target, tokens, rep, state.updates, jax.random.key(0))[1][name]

        return jax.grad(part)(params, "loss/td"), jax.grad(part)(params, "loss/f")

    of_td, of_f = jax.device_get(gradients(state.params))
    for untouched in (of_td["f"], of_f["agent"], of_td["agent"]["state_head"]):
        assert not any(x.any() for x in jax.tree.leaves(untouched))
    assert all(np.abs(x).sum() > 0 for x in jax.tree.leaves(of_td["agent"]["bottom"]))


@pytest.mark.lenient
def test_updates_move_the_target_a_little_and_learn_a_batch_by_heart(states: dict[str, AgentState]):
    config = changed(CONFIG, learning_rate=1e-2, trace_tolerance=0.0)
    config = dataclasses.replace(config, information=dataclasses.replace(config.information, intrinsic_weight=0.01))
    agent, state, tokens, rep = agent_of(config), states["mi"], episodes(DISCRETE), representation(SHAPES)
    update = jax.jit(agent.update)
    after, first = update(state, tokens, rep, jax.random.key(0))

    moved = jax.tree.map(lambda new, old: float(jnp.abs(new - old).max()), after.params, state.params)
    assert max(jax.tree.leaves(moved)) <= 1.01e-2  # Adam's first step is the step size wherever there is a gradient
    assert min(max(jax.tree.leaves(moved[part])) for part in ("agent", "f")) >= 0.99e-2
    by_hand = jax.tree.map(lambda old, new: 0.9 * old + 0.1 * new, state.target, after.params["agent"])
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-6), after.target, by_hand)
    assert int(after.updates) == 1

    for key in jax.random.split(jax.random.key(1), 300):
        after, last = update(dataclasses.replace(after, target=state.target), tokens, rep, key)
    for name in ("loss/td", "loss/f", "loss/auxiliary"):
        assert float(last[name]) < 0.03 * float(first[name])


def test_loss_under_vmap_equals_one_by_one(states: dict[str, AgentState]):
    agent, tokens, state = agent_of(BASE), episodes(DISCRETE), states["base"]
    both = jax.tree.map(lambda x: jnp.stack([x, x * 1.1]), state.params)

    def loss(params: Any) -> jax.Array:
        return agent.loss(params, state.target, tokens, None, state.updates, jax.random.key(0))[0]

    np.testing.assert_allclose(jax.jit(jax.vmap(loss))(both), jax.lax.map(loss, both), rtol=1e-4)


def test_the_memoryless_branch_starts_from_psi_only_when_asked():
    fresh = dataclasses.replace(CONFIG, information=InformationConfig(start_from_psi=False))
    rep = representation(SHAPES)

    @jax.jit
    def bottoms(key: jax.Array) -> list[Any]:
        states = [agent_of(config).init(key, rep) for config in (CONFIG, fresh)]
        return [network["bottom"] for state in states for network in (state.params["agent"], state.target)]

    online, target, online_fresh, target_fresh = bottoms(jax.random.key(3))
    jax.tree.map(np.testing.assert_array_equal, [online, target], [rep.psi, rep.psi])
    jax.tree.map(np.testing.assert_array_equal, online_fresh, target_fresh)
    assert not all(jax.tree.leaves(jax.tree.map(lambda x, y: bool((x == y).all()), online_fresh, rep.psi)))


def test_the_plain_agent_has_no_use_for_a_representation():
    init = agent_of(BASE).init
    without, with_one = (jax.eval_shape(init, jax.random.key(0), rep) for rep in (None, representation(SHAPES)))
    assert without == with_one


def test_the_value_is_the_best_action_s(states: dict[str, AgentState]):
    agent, params = agent_of(BASE), states["base"].params["agent"]
    seen = agent.initial_memory(3), jnp.asarray(np.random.default_rng(0).normal(size=(3, 2)), jnp.float32)
    none = jnp.full((3,), -1, jnp.int32)
    q = jax.jit(agent.action_values)(params, *seen, none)[1]
    np.testing.assert_array_equal(jax.jit(agent.value)(params, *seen, none), np.max(q, axis=1))
    np.testing.assert_array_equal(jax.jit(agent.act)(params, *seen, none)[1], np.argmax(q, axis=1))


def test_exploration(states: dict[str, AgentState]):
    agent, num = agent_of(BASE), 3000
    explore = jax.jit(agent.explore)
    memory, params = agent.initial_memory(num), states["base"].params["agent"]
    observation, none = jnp.ones((num, 2)), jnp.full((num,), -1, jnp.int32)
    greedy = set(np.asarray(jax.jit(agent.act)(params, memory, observation, none)[1]).tolist())
    assert len(greedy) == 1
    shares = {}
    for epsilon in (0.0, 0.5, 1.0):
        _, action = explore(params, memory, observation, none, jnp.float32(epsilon), jax.random.key(0))
        shares[epsilon] = np.bincount(action, minlength=DISCRETE.num)[next(iter(greedy))] / num
        assert action.dtype == jnp.int32
    assert shares[0.0] == 1
    assert shares[0.5] == pytest.approx(0.5 + 0.5 / DISCRETE.num, abs=0.05)
    assert shares[1.0] == pytest.approx(1 / DISCRETE.num, abs=0.05)


def test_continuous_actions_are_refused():
    with pytest.raises(ConfigError, match="continuous actions"):
        make_dqn(Shapes(CONTINUOUS), CONFIG)

"""The agents of the paper: what each network sees, and the losses that set it apart, against loops."""

import dataclasses
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tokens import (
    DISCRETE,
    END,
    FEATURES,
    ROW,
    SPANS,
    TINY,
    AgentCase,
    Shapes,
    dependencies,
    episodes,
    representation,
)

from envs_mjx.base import ArraySpec
from mijax.agents.dqn import DQN, make_dqn
from mijax.agents.state_shown import StateShown
from mijax.agents.variants import VARIANTS, memory_of, stage1_of, title_of
from mijax.config import BelieverConfig, Config, ConfigError, DQNConfig, MDPConfig, Stage1Config
from mijax.types import Tokens

GAMMA = 0.9
CONFIG = Config(stage1=Stage1Config(features=FEATURES), network=dataclasses.replace(TINY, dropout=0.1),
                believer=BelieverConfig(samples=5), dqn=DQNConfig(discount=GAMMA, trace_decay=0.0))


class Case(AgentCase[DQN]):
    """An agent on Double DQN with random parameters, and its network compiled."""

    def __init__(self, name: str, **changes: Any) -> None:
        super().__init__(make_dqn, DISCRETE, dataclasses.replace(CONFIG, agent=name, **changes))
        self.network: Any = jax.jit(self.agent.network.apply)

    def outputs(self, tokens: Tokens | None = None, target: bool = False) -> Any:
        params = self.state.target if target else self.state.params["agent"]
        return self.network({"params": params}, self.tokens if tokens is None else tokens)


SEEN = {  # agent: what Q(h, a) of the last token of an episode depends on, and its critic
    "mi": ("past present", ""), "base": ("past present", ""), "zp": ("past present", ""),
    "ba": ("past present", "state"), "ua": ("past present", "past present state"), "believer": ("past present", ""),
    "mdp": ("present state", ""),
}


@pytest.mark.parametrize("name", VARIANTS)
def test_what_each_network_sees(name: str):
    case = Case(name)

    def at_the_end(tokens: Tokens) -> dict[str, Any]:
        outputs = case.outputs(tokens)
        return {"q": outputs.q[END], "critic": None if outputs.critic is None else outputs.critic[END]}

    found = dependencies(at_the_end, case.tokens)
    assert (found["q"], found["critic"]) == SEEN[name]


def targets_by_loops(q: Any, q_target: Any, rewards: np.ndarray) -> dict[tuple[int, int], float]:
    """One-step targets r + gamma (1 - d) Q_target(., argmax_a Q(h', a)) of each transition, by its first token."""
    tokens, targets = jax.device_get(episodes(DISCRETE)), {}
    for row, first, end in SPANS:
        for t in range(first + 1, end):
            ended = tokens.terminated[row, t] or tokens.truncated[row, t]
            value = 0.0 if ended else GAMMA * q_target[row, t, np.argmax(q[row, t])]
            targets[row, t - 1] = float(rewards[row, t] + value)
    return targets


@pytest.mark.parametrize("name", ["base", "ba", "ua"])
def test_both_heads_regress_the_critics_targets(name: str):
    case = Case(name, network=TINY)
    online, averaged = case.outputs(), case.outputs(target=True)
    bootstrap = averaged.q if online.critic is None else averaged.critic
    targets = targets_by_loops(online.q, bootstrap, np.asarray(case.tokens.reward))
    loss, metrics = case.losses()
    expected = {}
    for key, head in (("loss/td", online.q), ("loss/critic", online.critic)):
        if head is not None:
            taken = {(row, t): int(case.tokens.previous_action[row, t + 1]) for row, t in targets}
            expected[key] = np.mean([(y - float(head[row, t, taken[row, t]]))**2 for (row, t), y in targets.items()])
            assert metrics[key] == pytest.approx(expected[key], rel=1e-4)
    assert loss == pytest.approx(sum(expected.values()), rel=1e-4)


def test_self_prediction_by_hand():
    case = Case("zp")
    online, averaged = case.outputs(), case.outputs(target=True)
    errors = [np.sum(np.square(online.next_summary[row, t] - averaged.summary[row, t + 1]))
              for row, first, end in SPANS for t in range(first, end - 1)]
    loss, metrics = case.losses()
    assert metrics["loss/self_prediction"] == pytest.approx(np.mean(errors), rel=1e-4)
    assert loss == pytest.approx(metrics["loss/td"] + np.mean(errors), rel=1e-4)


def test_the_auxiliary_error_counts_in_variances_or_as_it_is():
    found = {}
    for in_variances in (True, False):
        case = Case("mi", information=dataclasses.replace(
            CONFIG.information, auxiliary_in_variances=in_variances, auxiliary_weight=0.5))
        found[in_variances], metrics = case.losses()
    variance = float(cast(Any, case.representation).z_s_variance)
    assert variance != 1
    added = found[False] - found[True]
    assert added == pytest.approx(0.5 * metrics["loss/auxiliary"] * (variance - 1), rel=1e-3)


def test_the_next_summary_is_predicted_from_the_action_that_leads_there():
    case = Case("zp")
    row, first, end = SPANS[0]
    taken = case.tokens.previous_action  # at token t, the action that led there

    def predicted(token: int) -> np.ndarray:
        changed = dataclasses.replace(case.tokens, previous_action=taken.at[row, token].set(1 - taken[row, token]))
        return np.asarray(case.outputs(changed).next_summary)

    before = np.asarray(case.outputs().next_summary)
    last = end - 1
    assert not np.allclose(predicted(last)[row, last - 1], before[row, last - 1])
    np.testing.assert_array_equal(predicted(last)[row, first : last - 1], before[row, first : last - 1])


def test_belief_loss_by_hand():
    case = Case("believer", network=TINY)
    rep = case.representation
    assert rep is not None
    z = (np.asarray(case.tokens.z_s) - np.arange(FEATURES)) / np.sqrt(2)
    outputs: Any = case.agent.network.apply(  # a gradient pass: its latents are drawn, dropout or not
        {"params": case.state.params["agent"]}, dataclasses.replace(case.tokens, z_s=jnp.asarray(z)), False,
        rngs={"dropout": jax.random.split(jax.random.key(0))[0]})
    decoded, mean, log_variance, log_scale = (np.asarray(x, float) for x in outputs.belief)
    terms = []
    for row, first, end in SPANS:
        for t in range(first, end):
            errors = (z[row, t] - decoded[row, t]) / np.exp(log_scale)
            density = sum(-0.5 * error**2 - log_scale - 0.5 * np.log(2 * np.pi) for error in errors)
            kl = 0.5 * np.sum(mean[row, t]**2 + np.exp(log_variance[row, t]) - 1 - log_variance[row, t])
            terms.append(kl - density)
    assert case.losses()[1]["loss/belief"] == pytest.approx(np.mean(terms), rel=1e-3)


def test_beliefs_stay_within_their_episode():
    """With fresh samples, Q of an episode does not change when the other episodes do, in its row or elsewhere."""
    case = Case("believer")

    @jax.jit
    def q(frames: jax.Array) -> jax.Array:
        tokens = dataclasses.replace(case.tokens, frames=frames)
        outputs: Any = case.agent.network.apply(
            {"params": case.state.params["agent"]}, tokens, False, rngs={"dropout": jax.random.key(1)})
        return outputs.q

    before = q(jnp.asarray(case.tokens.frames))
    for row, first, end in SPANS:
        inside = np.zeros((2, ROW, 1), bool)
        inside[row, first:end] = True
        after = q(jnp.where(inside.reshape(-1, 1), jnp.asarray(case.tokens.frames), 9.0))
        np.testing.assert_array_equal(after[row, first:end], before[row, first:end])
        assert not np.array_equal(after, before)


@pytest.mark.lenient
def test_believers_pretraining_fits_the_belief_and_leaves_the_values():
    case = Case("believer")
    init = jax.jit(case.agent.init)(jax.random.key(0), case.representation)
    step = jax.jit(case.agent.fit_belief)
    state, losses = init, []
    for key in jax.random.split(jax.random.key(1), 200):
        state, metrics = step(state, case.tokens, case.representation, key)
        losses.append(float(metrics["loss/belief"]))
    assert np.mean(losses[-20:]) < np.mean(losses[:20]) - 1
    for untouched in ("q_head", "bottom"):
        jax.tree.map(np.testing.assert_array_equal, state.params["agent"][untouched], init.params["agent"][untouched])
    jax.tree.map(np.testing.assert_array_equal, state.target, state.params["agent"])


@pytest.mark.lenient
def test_belief_learns_what_is_hidden_and_what_the_history_tells():
    """z_s is one of two points of 32 features; the observation tells which one from the third token on. A decoder whose
    deviation starts at 1 leaves the error at 0.5 here and at 1.0 on Heaven-Hell."""
    wide = 32
    config = dataclasses.replace(
        CONFIG, stage1=Stage1Config(features=wide), network=dataclasses.replace(TINY, auxiliary_hidden=(64, 64)))
    agent = make_dqn(Shapes(DISCRETE), dataclasses.replace(config, agent="believer"))
    tokens, rng, copies = episodes(DISCRETE), np.random.default_rng(3), 16
    segment, position = (np.tile(x, (copies, 1)) for x in (tokens.segment, tokens.position))
    side = np.take_along_axis(rng.choice([-1.0, 1.0], (len(segment), 4)), segment, axis=1)
    told = (position >= 2) & (segment > 0)
    point = rng.normal(size=wide)
    z_s = side[..., None] * point / np.linalg.norm(point)
    frames = np.stack([side * told, told], axis=-1).reshape(-1, 2)
    many = jax.tree.map(lambda x: jnp.tile(x, (copies, *[1] * (x.ndim - 1))), tokens)
    tokens = dataclasses.replace(many, z_s=jnp.asarray(z_s, jnp.float32), frames=jnp.asarray(frames, jnp.float32))
    rep = dataclasses.replace(
        representation(Shapes(DISCRETE), features=wide), z_s_mean=jnp.zeros(wide), z_s_variance=jnp.float32(1))

    def fit(state: Any, key: jax.Array) -> tuple[Any, Any]:
        return agent.fit_belief(state, tokens, rep, key)

    state, metrics = jax.jit(lambda state, keys: jax.lax.scan(fit, state, keys))(
        jax.jit(agent.init)(jax.random.key(0), rep), jax.random.split(jax.random.key(1), 400))
    last = {name: float(np.mean(values[-50:])) for name, values in metrics.items()}
    assert last["belief/error"] < 0.1
    assert last["belief/kl"] > 0.1

    samples = agent.network.apply(
        {"params": state.params["agent"]}, tokens, method=lambda network, tokens: network.branches(tokens).samples)
    along = np.stack([np.asarray(sample) for sample in samples]).reshape(5, *segment.shape, wide) @ z_s[0, 0]
    right = along * side * side[0, 0]  # 1: the point that it is
    assert np.mean(right[:, told] > 0.5) > 0.8
    first = along[:, position == 0]
    assert first.min() < -0.5
    assert first.max() > 0.5


@pytest.mark.parametrize("sees", ["z_s", "z_s_z_o", "state"])
def test_the_mdp_agent_acts_on_frozen_features_or_on_the_state(sees: Any):
    case = Case("mdp", mdp=MDPConfig(sees=sees))
    rep = representation(Shapes(DISCRETE))
    init = jax.jit(case.agent.init)(jax.random.key(0), rep)
    same = all(jax.tree.leaves(jax.tree.map(lambda x, y: bool((x == y).all()), init.params["agent"]["phi"], rep.phi)))
    assert same == (sees != "state")

    def loss(params: Any) -> jax.Array:
        return case.agent.loss(params, init.target, case.tokens, None, init.updates, jax.random.key(0))[0]

    grads = jax.jit(jax.grad(loss))(init.params)["agent"]
    assert any(np.any(x) for x in jax.tree.leaves(grads["phi"])) == (sees == "state")
    assert not any(np.any(x) for x in jax.tree.leaves(grads["psi"]))
    frames = jnp.asarray(case.tokens.frames)
    other = case.outputs(dataclasses.replace(case.tokens, frames=frames.at[:, 3:].set(9.0)))
    assert np.array_equal(case.outputs().q, other.q) == (sees != "z_s_z_o")


def test_memories():
    assert [memory_of(dataclasses.replace(CONFIG, agent=name)) for name in VARIANTS] == [
        "gpt", "gpt", "gru", "gpt", "gpt", "gpt", "mlp"]
    with pytest.raises(ConfigError, match=r"--memory: got 'gpt', accepted: gru \(--agent zp\)"):
        make_dqn(Shapes(DISCRETE), dataclasses.replace(CONFIG, agent="zp", memory="gpt"))
    assert title_of(dataclasses.replace(CONFIG, agent="base", memory="gru")) == "DTQN (GRU)"
    assert title_of(CONFIG) == "Ours"


def test_believer_learns_its_features_with_its_own_penalty():
    stage1 = stage1_of(dataclasses.replace(CONFIG, agent="believer"))
    assert stage1.lambda_kl > 0
    assert stage1.lambda_club == stage1.lambda_dim_s == stage1.lambda_dim_o == stage1.phi_shrinkage == 0
    assert stage1_of(CONFIG) == CONFIG.stage1
    asked = dataclasses.replace(CONFIG.stage1, lower_bound="variables", lambda_dim_o=0.7)
    assert stage1_of(dataclasses.replace(CONFIG, agent="believer", stage1=asked)).lambda_dim_o == 0.7


def test_states_that_do_not_fit_beside_observations_are_refused():
    with pytest.raises(ConfigError, match="cannot be laid side by side"):
        StateShown(Shapes(DISCRETE, state_spec=ArraySpec((3, 3, 1))))

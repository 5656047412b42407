"""The agents of the paper: what each network sees, and the losses that set it apart, against loops."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.base import ArraySpec, DiscreteActions, Environment
from mijax.agents.dqn import DQN, AgentState, make_dqn
from mijax.agents.variants import VARIANTS, memory_of, needs_representation, stage1_of, title_of
from mijax.config import BelieverConfig, Config, ConfigError, DQNConfig, MDPConfig, NetworkConfig, Stage1Config
from mijax.nets.privileged import StateShown
from mijax.representation.model import init_parameters, networks_for
from mijax.types import Representation, Tokens

ACTIONS, FEATURES, ROW, GAMMA = 3, 4, 6, 0.9
TINY = NetworkConfig(action_embedding=4, observation_embedding=4, gru_width=8, critic_hidden=(16,),
                     auxiliary_hidden=(16,), dropout=0.1)
CONFIG = Config(stage1=Stage1Config(features=FEATURES), network=TINY, believer=BelieverConfig(samples=5),
                dqn=DQNConfig(discount=GAMMA, trace_decay=0.0))


class Shapes(Environment):
    """Nothing but shapes."""

    name, horizon, action_spec = "shapes", ROW - 1, DiscreteActions(ACTIONS)
    observation_spec, state_spec = ArraySpec((2,)), ArraySpec((3,))

    def reset(self, key):
        raise NotImplementedError

    def step(self, key, env_state, action):
        raise NotImplementedError


def representation() -> Representation:
    zeros = [jnp.zeros((1, *spec.shape)) for spec in (Shapes.state_spec, Shapes.observation_spec)]
    parameters = init_parameters(networks_for(Shapes(), FEATURES), jax.random.key(5), *zeros)
    return Representation(parameters["phi"], parameters["psi"], jnp.arange(FEATURES, dtype=jnp.float32), jnp.float32(2))


def episodes() -> Tokens:
    """Row 0: episodes of 3 steps and of 1 step, both terminated; row 1: one of 4 steps, truncated, and padding."""
    rng = np.random.default_rng(0)
    segment = np.array([[1, 1, 1, 1, 2, 2], [3, 3, 3, 3, 3, 0]])
    position = np.array([[0, 1, 2, 3, 0, 1], [0, 1, 2, 3, 4, 0]])
    terminated, truncated = np.zeros((2, *segment.shape), bool)
    terminated[0, 3] = terminated[0, 5] = truncated[1, 4] = True
    action = rng.integers(0, ACTIONS, segment.shape)
    return Tokens(
        frames=jnp.asarray(rng.normal(size=(segment.size, 2)), jnp.float32), frame=None,
        previous_action=jnp.asarray(np.where(position == 0, -1, action), jnp.int32),
        reward=jnp.asarray(rng.normal(size=segment.shape), jnp.float32), terminated=jnp.asarray(terminated),
        truncated=jnp.asarray(truncated), segment=jnp.asarray(segment, jnp.int32),
        position=jnp.asarray(position, jnp.int32),
        z_s=jnp.asarray(rng.normal(size=(*segment.shape, FEATURES)), jnp.float32),
        states=jnp.asarray(rng.normal(size=(segment.size, 3)), jnp.float32))


SPANS = ((0, 0, 4), (0, 4, 6), (1, 0, 5))  # row, first token, end: the three episodes


class Agent:
    """An agent with large random parameters, those of its target network different, and its network compiled."""

    def __init__(self, name: str, **changes: Any) -> None:
        self.config = dataclasses.replace(CONFIG, agent=name, **changes)
        env = StateShown(Shapes()) if name == "mdp" else Shapes()
        self.dqn: DQN = make_dqn(env, self.config)
        self.tokens = episodes()
        if name == "mdp":
            both = jnp.concatenate([jnp.asarray(self.tokens.states), jnp.asarray(self.tokens.frames)], -1)
            self.tokens = dataclasses.replace(self.tokens, frames=both)
        self.representation = representation() if needs_representation(self.config) else None
        shapes, rng = jax.eval_shape(self.dqn.init, jax.random.key(0), self.representation), np.random.default_rng(7)
        params, target = jax.tree.map(
            lambda x: jnp.asarray(rng.normal(0, 0.4, x.shape), x.dtype), (shapes.params, shapes.target))
        self.state = AgentState(params, target, self.dqn.optimizer.init(params), jnp.zeros((), jnp.int32))
        self.network: Any = jax.jit(self.dqn.network.apply)

    def outputs(self, tokens: Tokens | None = None, target: bool = False) -> Any:
        params = self.state.target if target else self.state.params["agent"]
        return self.network({"params": params}, self.tokens if tokens is None else tokens)

    def losses(self) -> tuple[float, dict[str, float]]:
        loss, metrics = jax.jit(self.dqn.loss)(
            self.state.params, self.state.target, self.tokens, self.representation, self.state.updates,
            jax.random.key(0))
        return float(loss), {name: float(value) for name, value in metrics.items()}


SEEN = {  # agent: what Q(h, a) of the last token of an episode depends on, and its critic
    "mi": ("past present", ""), "base": ("past present", ""), "zp": ("past present", ""),
    "ba": ("past present", "state"), "ua": ("past present", "past present state"), "believer": ("past present", ""),
    "mdp": ("present state", ""),
}


@pytest.mark.parametrize("name", VARIANTS)
def test_what_each_network_sees(name: str):
    agent = Agent(name)
    tokens = agent.tokens
    t = 3  # the last token of the first episode of row 0
    frames, states = np.array(tokens.frames), np.array(tokens.states)
    shown = 3 if name == "mdp" else 0  # entries of the state in an observation
    past, present, state, state_frames = frames.copy(), frames.copy(), states.copy(), frames.copy()
    past[1], present[t, shown:], state[t], state_frames[t, :shown] = 5, 5, 5, 5
    changes = {
        "past": {"frames": past}, "present": {"frames": present},
        "state": {"states": state, "frames": state_frames}}
    before = agent.outputs()
    seen = {"q": set(), "critic": set()}
    for what, change in changes.items():
        after = agent.outputs(dataclasses.replace(tokens, **{k: jnp.asarray(v) for k, v in change.items()}))
        for head, of_head in seen.items():
            old, new = getattr(before, head), getattr(after, head)
            if old is not None and not np.array_equal(old[0, t], new[0, t]):
                of_head.add(what)
    assert (seen["q"], seen["critic"]) == tuple(set(words.split()) for words in SEEN[name])


def targets_by_loops(q: Any, q_target: Any, rewards: np.ndarray) -> dict[tuple[int, int], float]:
    """One-step targets r + gamma (1 - d) Q_target(., argmax_a Q(h', a)) of each transition, by its first token."""
    tokens, targets = jax.device_get(episodes()), {}
    for row, first, end in SPANS:
        for t in range(first + 1, end):
            ended = tokens.terminated[row, t] or tokens.truncated[row, t]
            value = 0.0 if ended else GAMMA * q_target[row, t, np.argmax(q[row, t])]
            targets[row, t - 1] = float(rewards[row, t] + value)
    return targets


@pytest.mark.parametrize("name", ["base", "ba", "ua"])
def test_both_heads_regress_the_critics_targets(name: str):
    agent = Agent(name, network=dataclasses.replace(TINY, dropout=0.0))
    online, averaged = agent.outputs(), agent.outputs(target=True)
    bootstrap = averaged.q if online.critic is None else averaged.critic
    targets = targets_by_loops(online.q, bootstrap, np.asarray(agent.tokens.reward))
    loss, metrics = agent.losses()
    expected = {}
    for key, head in (("loss/td", online.q), ("loss/critic", online.critic)):
        if head is not None:
            taken = {(row, t): int(agent.tokens.previous_action[row, t + 1]) for row, t in targets}
            expected[key] = np.mean([(y - float(head[row, t, taken[row, t]]))**2 for (row, t), y in targets.items()])
            assert metrics[key] == pytest.approx(expected[key], rel=1e-4)
    assert loss == pytest.approx(sum(expected.values()), rel=1e-4)


def test_self_prediction_by_hand():
    agent = Agent("zp")
    online, averaged = agent.outputs(), agent.outputs(target=True)
    errors = [np.sum(np.square(online.next_summary[row, t] - averaged.summary[row, t + 1]))
              for row, first, end in SPANS for t in range(first, end - 1)]
    loss, metrics = agent.losses()
    assert metrics["loss/self_prediction"] == pytest.approx(np.mean(errors), rel=1e-4)
    assert loss == pytest.approx(metrics["loss/td"] + np.mean(errors), rel=1e-4)


def test_belief_loss_by_hand():
    agent = Agent("believer", network=dataclasses.replace(TINY, dropout=0.0))
    rep = agent.representation
    assert rep is not None
    z = (np.asarray(agent.tokens.z_s) - np.arange(FEATURES)) / np.sqrt(2)
    outputs: Any = agent.dqn.network.apply(  # a gradient pass: its latents are drawn, dropout or not
        {"params": agent.state.params["agent"]}, dataclasses.replace(agent.tokens, z_s=jnp.asarray(z)), False,
        rngs={"dropout": jax.random.split(jax.random.key(0))[0]})
    decoded, mean, log_variance, log_scale = (np.asarray(x, float) for x in outputs.belief)
    terms = []
    for row, first, end in SPANS:
        for t in range(first, end):
            errors = (z[row, t] - decoded[row, t]) / np.exp(log_scale)
            density = sum(-0.5 * error**2 - log_scale - 0.5 * np.log(2 * np.pi) for error in errors)
            kl = 0.5 * np.sum(mean[row, t]**2 + np.exp(log_variance[row, t]) - 1 - log_variance[row, t])
            terms.append(kl - density)
    assert agent.losses()[1]["loss/belief"] == pytest.approx(np.mean(terms), rel=1e-3)


def test_beliefs_stay_within_their_episode():
    """With fresh samples, Q of an episode does not change when the other episodes do, in its row or elsewhere."""
    agent = Agent("believer")

    @jax.jit
    def q(frames: jax.Array) -> jax.Array:
        tokens = dataclasses.replace(agent.tokens, frames=frames)
        outputs: Any = agent.dqn.network.apply(
            {"params": agent.state.params["agent"]}, tokens, False, rngs={"dropout": jax.random.key(1)})
        return outputs.q

    before = q(jnp.asarray(agent.tokens.frames))
    for row, first, end in SPANS:
        inside = np.zeros((2, ROW, 1), bool)
        inside[row, first:end] = True
        after = q(jnp.where(inside.reshape(-1, 1), jnp.asarray(agent.tokens.frames), 9.0))
        np.testing.assert_array_equal(after[row, first:end], before[row, first:end])
        assert not np.array_equal(after, before)


@pytest.mark.lenient
def test_believers_pretraining_fits_the_belief_and_leaves_the_values():
    agent = Agent("believer")
    init = jax.jit(agent.dqn.init)(jax.random.key(0), agent.representation)
    step = jax.jit(agent.dqn.pretrain)
    state, losses = init, []
    for key in jax.random.split(jax.random.key(1), 200):
        state, metrics = step(state, agent.tokens, agent.representation, key)
        losses.append(float(metrics["loss/belief"]))
    assert np.mean(losses[-20:]) < np.mean(losses[:20]) - 1
    for untouched in ("q_head", "bottom"):
        jax.tree.map(np.testing.assert_array_equal, state.params["agent"][untouched], init.params["agent"][untouched])
    jax.tree.map(np.testing.assert_array_equal, state.target, state.params["agent"])


@pytest.mark.parametrize("sees", ["z_s", "z_s_z_o", "state"])
def test_the_mdp_agent_acts_on_frozen_features_or_on_the_state(sees: Any):
    agent = Agent("mdp", mdp=MDPConfig(sees=sees))
    rep = representation()
    init = jax.jit(agent.dqn.init)(jax.random.key(0), rep)
    same = all(jax.tree.leaves(jax.tree.map(lambda x, y: bool((x == y).all()), init.params["agent"]["phi"], rep.phi)))
    assert same == (sees != "state")

    def loss(params: Any) -> jax.Array:
        return agent.dqn.loss(params, init.target, agent.tokens, None, init.updates, jax.random.key(0))[0]

    grads = jax.jit(jax.grad(loss))(init.params)["agent"]
    assert any(np.any(x) for x in jax.tree.leaves(grads["phi"])) == (sees == "state")
    assert not any(np.any(x) for x in jax.tree.leaves(grads["psi"]))
    frames = jnp.asarray(agent.tokens.frames)
    other = agent.outputs(dataclasses.replace(agent.tokens, frames=frames.at[:, 3:].set(9.0)))
    assert np.array_equal(agent.outputs().q, other.q) == (sees != "z_s_z_o")


def test_memories():
    assert [memory_of(dataclasses.replace(CONFIG, agent=name)) for name in VARIANTS] == [
        "gpt", "gpt", "gru", "gpt", "gpt", "gpt", "mlp"]
    with pytest.raises(ConfigError, match=r"--memory: got 'gpt', accepted: gru \(--agent zp\)"):
        make_dqn(Shapes(), dataclasses.replace(CONFIG, agent="zp", memory="gpt"))
    assert title_of(dataclasses.replace(CONFIG, agent="base", memory="gru")) == "DTQN (GRU)"
    assert title_of(CONFIG) == "Ours"


def test_believer_learns_its_features_with_its_own_penalty():
    stage1 = stage1_of(dataclasses.replace(CONFIG, agent="believer"))
    assert stage1.lambda_kl > 0
    assert stage1.lambda_club == stage1.lambda_dim_s == stage1.lambda_dim_o == stage1.phi_shrinkage == 0
    assert stage1_of(CONFIG) == CONFIG.stage1


def test_states_that_do_not_fit_beside_observations_are_refused():
    class Apart(Shapes):
        state_spec = ArraySpec((3, 3, 1))

    with pytest.raises(ConfigError, match="cannot be laid side by side"):
        StateShown(Apart())

"""Double DQN over whole episodes with a two-branch memory agent (paper Section 3.2, Appendix A)."""

import dataclasses
from typing import Any, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct

from envs_mjx.base import DiscreteActions, Environment
from mijax.agents.variants import Variant, variant
from mijax.config import Config, ConfigError, require
from mijax.losses import information as info
from mijax.losses import td
from mijax.nets.two_branch import HistoryEncoder, InformationModel, MemoryState, TwoBranchQ
from mijax.types import Metrics, Params, Representation, Tokens


@struct.dataclass
class AgentState:
    """Everything that learning changes."""

    params: Params  # {"agent": ..., "f": [one per fold]}
    target: Params  # the agent's moving average: bootstraps and, being steadier, acts greedily in evaluations
    optimizer: Any  # Adam's moments
    updates: jax.Array  # () int32


@dataclasses.dataclass(frozen=True)
class DQN:
    """The functions of one agent; all pure, all state in `AgentState` and `MemoryState`."""

    config: Config
    declaration: Variant
    network: TwoBranchQ
    information_model: InformationModel | None
    optimizer: optax.GradientTransformation

    def init(self, key: jax.Array, representation: Representation | None) -> AgentState:
        """Fresh parameters; the memoryless branch starts from psi when the agent uses a representation."""
        tokens = _example_tokens(self.network)
        key_agent, key_f = jax.random.split(key)
        agent = dict(self.network.init(key_agent, tokens)["params"])
        if self.declaration.uses_z_s and self.config.information.start_from_psi:
            agent["bottom"] = cast(Representation, representation).psi
        params: dict[str, Params] = {"agent": agent}
        if self.information_model is not None:
            keys = jax.random.split(key_f, self.config.information.folds)
            params["f"] = [self.information_model.init(key, tokens)["params"] for key in keys]
        target = jax.tree.map(jnp.copy, params["agent"])
        return AgentState(params, target, self.optimizer.init(params), jnp.zeros((), jnp.int32))

    def initial_memory(self, batch: int) -> MemoryState:
        """What `batch` episodes that have not started remember."""
        return cast(MemoryState, self.network.apply({}, batch, method=TwoBranchQ.initial_state))

    def act(
        self, params: Params, memory: MemoryState, observation: jax.Array, previous_action: jax.Array
    ) -> tuple[MemoryState, jax.Array]:
        """Greedy actions of (B,) episodes after one more observation; the state is no argument.

        Args:
            params: parameters of the two-branch network.
            memory: what the episodes remember.
            observation: (B, *observation_shape).
            previous_action: (B,) int32, -1 at the start of an episode.

        Returns:
            The new memory and (B,) int32 actions.
        """
        memory, q = self._step(params, memory, observation, previous_action)
        return memory, jnp.argmax(q, axis=-1).astype(jnp.int32)

    def value(
        self, params: Params, memory: MemoryState, observation: jax.Array, previous_action: jax.Array
    ) -> jax.Array:
        """(B,) max_a Q(h, a) after one more observation; arguments as for `act`."""
        return jnp.max(self._step(params, memory, observation, previous_action)[1], axis=-1)

    def explore(
        self,
        params: Params,
        memory: MemoryState,
        observation: jax.Array,
        previous_action: jax.Array,
        epsilon: jax.Array,
        key: jax.Array,
    ) -> tuple[MemoryState, jax.Array]:
        """As `act`, but each action is uniformly random with probability `epsilon`."""
        memory, greedy = self.act(params, memory, observation, previous_action)
        key_gate, key_action = jax.random.split(key)
        random = jax.random.randint(key_action, greedy.shape, 0, self.network.top.num_actions, jnp.int32)
        return memory, jnp.where(jax.random.uniform(key_gate, greedy.shape) < epsilon, random, greedy)

    def loss(
        self, params: Params, target: Params, tokens: Tokens, representation: Representation | None, key: jax.Array
    ) -> tuple[jax.Array, Metrics]:
        """The sum of the TD loss, the weighted auxiliary loss and f's own loss; () and its parts."""
        key_agent, key_f = jax.random.split(key)
        q, predicted = self._apply(self.network, params["agent"], tokens, key_agent)
        q_select = q if self._exact else self._clean(self.network, params["agent"], tokens)[0]
        q_target, _ = self._clean(self.network, target, tokens)
        bonus, loss, metrics = jnp.zeros_like(tokens.reward), jnp.zeros(()), {}
        if predicted is not None:
            scale = cast(Representation, representation)
            loss_k, parts = info.prediction_mse(
                scale.destandardise(predicted), cast(jax.Array, tokens.z_s), tokens.segment > 0, scale.z_s_variance)
            loss += self.config.information.auxiliary_weight * loss_k
            metrics |= {"loss/auxiliary": loss_k, "auxiliary/explained": parts["explained"]}
        if self.information_model is not None:
            loss_f, bonus, parts = self._information(params["f"], tokens, representation, key_f)
            loss += loss_f
            metrics |= parts
        loss_td, parts = self._td(q, q_select, q_target, bonus, tokens)
        return loss + loss_td, metrics | parts

    def update(
        self, state: AgentState, tokens: Tokens, representation: Representation | None, key: jax.Array
    ) -> tuple[AgentState, Metrics]:
        """One gradient step, then one soft step of the target network."""
        (_, metrics), grads = jax.value_and_grad(self.loss, has_aux=True)(
            state.params, state.target, tokens, representation, key
        )
        steps, optimizer = self.optimizer.update(grads, state.optimizer, state.params)
        params = cast(Params, optax.apply_updates(state.params, steps))
        target = optax.incremental_update(params["agent"], state.target, self.config.dqn.target_rate)
        return AgentState(params, target, optimizer, state.updates + 1), metrics

    def _step(self, params: Params, *arguments: Any) -> tuple[MemoryState, jax.Array]:
        return cast(Any, self.network.apply({"params": params}, *arguments, method=TwoBranchQ.step))

    @property
    def _exact(self) -> bool:
        """Whether gradient passes are free of dropout, so that their outputs serve targets and bonus too."""
        return self.config.network.dropout == 0

    def _apply(self, module: Any, params: Params, tokens: Tokens, key: jax.Array) -> Any:
        return module.apply({"params": params}, tokens, self._exact, rngs={"dropout": key})

    def _clean(self, module: Any, params: Params, tokens: Tokens) -> Any:
        return module.apply({"params": params}, tokens)

    def _information(
        self, params: Params, tokens: Tokens, representation: Any, key: jax.Array
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """f's loss, and (R, L) the weighted bonus for arriving at each token.

        Two models f, each trained on one fold of the episodes; the bonus of an episode comes from the one that never
        saw it. A single f learns the episodes of the replay by heart: at step 45 of episodes without any information it
        explained 0.83 of z_s (measured, Heaven-Hell, 12 000 steps), and the bonus then pays for wandering about.
        The bonus of an episode's first token is meaningless; no target uses it.
        """
        options, variance, z_s = self.config.information, representation.z_s_variance, cast(jax.Array, tokens.z_s)
        real = tokens.segment > 0
        folds = tokens.folds() if len(params) == 2 else (tokens,)
        keys = jax.random.split(key, len(params))
        f = representation.destandardise(jnp.concatenate([
            self._apply(self.information_model, *arguments) for arguments in zip(params, folds, keys, strict=True)]))
        loss_f, parts_f = info.prediction_mse(f, z_s, real, variance)
        f_t = jnp.concatenate([
            self._clean(self.information_model, *arguments) for arguments in zip(params[::-1], folds, strict=True)])
        f_t = jax.lax.stop_gradient(representation.destandardise(f_t))
        _, parts_t = info.prediction_mse(f_t, z_s, real, variance)
        f_tm1 = jnp.roll(f_t, 1, axis=1)
        if options.intrinsic_form == "cosine":
            bonus = info.cosine_bonus(z_s, f_t, f_tm1)
        else:
            bonus = info.explained_variance_bonus(z_s, f_t, f_tm1, variance)
        metrics = {"loss/f": loss_f, "f/explained": parts_f["explained"], "f/explained_unseen": parts_t["explained"]}
        return loss_f, options.intrinsic_weight * bonus, metrics

    def _td(
        self, q: jax.Array, q_select: jax.Array, q_target: jax.Array, bonus: jax.Array, tokens: Tokens
    ) -> tuple[jax.Array, Metrics]:
        """TD loss over the transitions token l -> l + 1 of the same segment; `q_select` chooses the greedy actions."""
        dqn = self.config.dqn
        valid = (tokens.segment[:, :-1] == tokens.segment[:, 1:]) & (tokens.segment[:, 1:] > 0)
        action = tokens.previous_action[:, 1:]
        ended = tokens.terminated if dqn.bootstrap_at_time_limit else tokens.terminated | tokens.truncated
        greedy = jnp.argmax(q_select, axis=-1)[:, :-1] == action
        follows = valid & greedy
        trace = dqn.trace_decay * jnp.pad(follows[:, 1:].astype(jnp.float32), ((0, 0), (0, 1)))
        target = td.watkins_returns(
            r_t=tokens.reward[:, 1:] + bonus[:, 1:],
            discount_t=dqn.discount * (1 - ended[:, 1:].astype(jnp.float32)),
            v_t=td.double_q_value(q_select[:, 1:], q_target[:, 1:]),
            trace_t=trace,
        )
        loss, parts = td.td_loss(q[:, :-1], action, target, valid)
        episodes = jnp.sum((tokens.position == 0) & (tokens.segment > 0), dtype=jnp.float32)
        episode_bonus = jnp.sum(jnp.where(valid, bonus[:, 1:], 0)) / jnp.maximum(episodes, 1)
        return loss, {"loss/td": loss, "q/mean": parts["q"], "q/error": parts["td_error"], "train/bonus": episode_bonus}


def make_agent(env: Environment, config: Config) -> DQN:
    """The agent that a configuration names, for an environment."""
    if not isinstance(env.action_spec, DiscreteActions):
        raise ConfigError(f"--domain: {env.name} has continuous actions, accepted by this agent: discrete actions")
    declaration = variant(config.agent)
    net = config.network
    width = net.action_embedding + net.observation_embedding
    require(config.memory != "gpt" or width % net.heads == 0, "network.heads", net.heads,
            f"a divisor of the transformer's width {width} (action-embedding + observation-embedding)")
    history = HistoryEncoder(env.action_spec.num, env.horizon + 1, config.memory, config.network)
    network = TwoBranchQ(
        history, env.observation_spec, config.stage1.features, bottom_psi=declaration.uses_z_s,
        predicts_state=declaration.uses_z_s)
    information_model = None
    if declaration.uses_z_s and config.information.intrinsic_weight > 0:
        information_model = InformationModel(history.clone(), config.stage1.features)
    dqn = config.dqn
    updates = max(1, round(config.steps * dqn.updates_per_step))
    rate = optax.linear_schedule(dqn.learning_rate, dqn.learning_rate * dqn.final_learning_rate, updates)
    return DQN(config, declaration, network, information_model, optax.adam(rate))


def _example_tokens(network: TwoBranchQ) -> Tokens:
    """One token of zeros, enough to shape the parameters."""
    zeros = jnp.zeros((1, 1), jnp.int32)
    spec = network.observation_spec
    return Tokens(
        frames=jnp.zeros((1, *spec.shape), spec.dtype), frame=None, z_s=None, previous_action=zeros,
        reward=jnp.zeros((1, 1)), terminated=zeros > 0, truncated=zeros > 0, segment=zeros + 1, position=zeros,
    )

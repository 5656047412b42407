"""Double DQN over whole episodes with a two-branch memory agent (paper Section 3.2, Appendix A)."""

import dataclasses
from typing import Any, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct

from envs_mjx.base import DiscreteActions, Environment
from mijax.agents.variants import Variant, memory_of, variant
from mijax.config import Config, ConfigError, require
from mijax.losses import information as info
from mijax.losses import td
from mijax.losses.belief import negative_elbo
from mijax.nets.belief import BeliefQ
from mijax.nets.privileged import PrivilegedQ
from mijax.nets.two_branch import HistoryEncoder, InformationModel, MemoryState, Outputs, TwoBranchQ
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

    env: Environment
    config: Config
    declaration: Variant
    network: TwoBranchQ | BeliefQ | PrivilegedQ
    information_model: InformationModel | None
    optimizer: optax.GradientTransformation

    def init(self, key: jax.Array, representation: Representation | None) -> AgentState:
        """Fresh parameters; the memoryless branch starts from psi when the agent uses a representation."""
        tokens = _example_tokens(self.env, self.config.stage1.features)
        key_agent, key_f = jax.random.split(key)
        agent = dict(self.network.init(key_agent, tokens)["params"])
        if self.declaration.sees_state:
            if self.config.mdp.sees != "state":
                rep = cast(Representation, representation)
                agent |= {"phi": rep.phi, "psi": rep.psi}
        elif self.declaration.uses_representation and self.config.information.start_from_psi:
            agent["bottom"] = cast(Representation, representation).psi
        params: dict[str, Params] = {"agent": agent}
        if self.information_model is not None:
            keys = jax.random.split(key_f, self.config.information.folds)
            params["f"] = [self.information_model.init(key, tokens)["params"] for key in keys]
        target = jax.tree.map(jnp.copy, params["agent"])
        return AgentState(params, target, self.optimizer.init(params), jnp.zeros((), jnp.int32))

    def initial_memory(self, batch: int) -> MemoryState:
        """What `batch` episodes that have not started remember."""
        return cast(MemoryState, self.network.apply({}, batch, method="initial_state"))

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
        number = cast(DiscreteActions, self.env.action_spec).num
        random = jax.random.randint(key_action, greedy.shape, 0, number, jnp.int32)
        return memory, jnp.where(jax.random.uniform(key_gate, greedy.shape) < epsilon, random, greedy)

    def loss(
        self, params: Params, target: Params, tokens: Tokens, representation: Representation | None, key: jax.Array
    ) -> tuple[jax.Array, Metrics]:
        """The sum of the TD losses, the weighted auxiliary losses and f's own loss; () and its parts."""
        key_agent, key_f = jax.random.split(key)
        if self.declaration.believes:
            scale = cast(Representation, representation)
            tokens = dataclasses.replace(tokens, z_s=scale.standardise(cast(jax.Array, tokens.z_s)))
        online: Outputs = self._apply(self.network, params["agent"], tokens, key_agent)
        q_select = online.q if self._exact else self._clean(self.network, params["agent"], tokens).q
        averaged: Outputs = self._clean(self.network, target, tokens)
        bonus = jnp.zeros_like(tokens.reward)
        loss, metrics = self._auxiliary(online, averaged, tokens, representation)
        if self.information_model is not None:
            loss_f, bonus, parts = self._information(params["f"], tokens, representation, key_f)
            loss, metrics = loss + loss_f, metrics | parts
        loss_td, parts = self._td(online, q_select, averaged, bonus, tokens)
        return loss + loss_td, metrics | parts

    def pretrain(
        self, state: AgentState, tokens: Tokens, representation: Representation, key: jax.Array
    ) -> tuple[AgentState, Metrics]:
        """One step of the auxiliary losses alone: Believer's second stage, on random episodes."""
        tokens = dataclasses.replace(tokens, z_s=representation.standardise(cast(jax.Array, tokens.z_s)))

        def loss(params: Params) -> tuple[jax.Array, Metrics]:
            online: Outputs = self._apply(self.network, params["agent"], tokens, key)
            return self._auxiliary(online, online, tokens, representation)

        grads, metrics = jax.grad(loss, has_aux=True)(state.params)
        steps, optimizer = self.optimizer.update(grads, state.optimizer, state.params)
        params = cast(Params, optax.apply_updates(state.params, steps))
        target = jax.tree.map(jnp.copy, params["agent"])
        return AgentState(params, target, optimizer, state.updates), metrics

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
        return cast(Any, self.network.apply({"params": params}, *arguments, method="step"))

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

    def _auxiliary(
        self, online: Outputs, averaged: Outputs, tokens: Tokens, representation: Representation | None
    ) -> tuple[jax.Array, Metrics]:
        """The weighted losses of the heads that the agent has besides its values; () and its parts."""
        loss, metrics = jnp.zeros(()), {}
        real = tokens.segment > 0
        if online.z_s is not None:
            scale = cast(Representation, representation)
            loss_k, parts = info.prediction_mse(
                scale.destandardise(online.z_s), cast(jax.Array, tokens.z_s), real, scale.z_s_variance)
            loss += self.config.information.auxiliary_weight * loss_k
            metrics |= {"loss/auxiliary": loss_k, "auxiliary/explained": parts["explained"]}
        if online.next_summary is not None:
            later = jax.lax.stop_gradient(cast(jax.Array, averaged.summary))[:, 1:]
            loss_z, _ = info.prediction_mse(online.next_summary[:, :-1], later, _transitions(tokens))
            loss += self.config.zp.weight * loss_z
            metrics |= {"loss/self_prediction": loss_z}
        if online.belief is not None:
            decoded, mean, log_variance, log_scale = online.belief
            loss_b, parts = negative_elbo(
                cast(jax.Array, tokens.z_s), decoded, log_scale, mean, log_variance, real)
            loss += self.config.believer.weight * loss_b
            metrics |= {"loss/belief": loss_b, "belief/error": parts["error"], "belief/kl": parts["kl"]}
        return loss, metrics

    def _td(
        self, online: Outputs, q_select: jax.Array, averaged: Outputs, bonus: jax.Array, tokens: Tokens
    ) -> tuple[jax.Array, Metrics]:
        """TD losses over the transitions token l -> l + 1 of the same segment, of Q(h, a) and of an asymmetric critic.

        `q_select` chooses the greedy actions. Both heads regress the same targets, which an asymmetric critic's average
        bootstraps where there is one.
        """
        dqn = self.config.dqn
        valid, action = _transitions(tokens), tokens.previous_action[:, 1:]
        ended = tokens.terminated if dqn.bootstrap_at_time_limit else tokens.terminated | tokens.truncated
        greedy = jnp.argmax(q_select, axis=-1)[:, :-1] == action
        follows = valid & greedy
        trace = dqn.trace_decay * jnp.pad(follows[:, 1:].astype(jnp.float32), ((0, 0), (0, 1)))
        q_target = averaged.q if averaged.critic is None else averaged.critic
        if dqn.value_bound > 0:
            q_target = jnp.clip(q_target, -dqn.value_bound, dqn.value_bound)
        target = td.watkins_returns(
            r_t=tokens.reward[:, 1:] + bonus[:, 1:],
            discount_t=dqn.discount * (1 - ended[:, 1:].astype(jnp.float32)),
            v_t=td.double_q_value(q_select[:, 1:], q_target[:, 1:]),
            trace_t=trace,
        )
        loss, parts = td.td_loss(online.q[:, :-1], action, target, valid)
        episodes = jnp.sum((tokens.position == 0) & (tokens.segment > 0), dtype=jnp.float32)
        episode_bonus = jnp.sum(jnp.where(valid, bonus[:, 1:], 0)) / jnp.maximum(episodes, 1)
        metrics = {"loss/td": loss, "q/mean": parts["q"], "q/error": parts["td_error"], "train/bonus": episode_bonus}
        if online.critic is not None:
            loss_critic, _ = td.td_loss(online.critic[:, :-1], action, target, valid)
            loss, metrics = loss + loss_critic, metrics | {"loss/critic": loss_critic}
        return loss, metrics


def _transitions(tokens: Tokens) -> jax.Array:
    """(R, L - 1) bool: whether tokens l and l + 1 belong to the same episode."""
    return (tokens.segment[:, :-1] == tokens.segment[:, 1:]) & (tokens.segment[:, 1:] > 0)


def _network(env: Environment, config: Config, declaration: Variant) -> TwoBranchQ | BeliefQ | PrivilegedQ:
    """The agent's network, by its declaration."""
    num_actions = cast(DiscreteActions, env.action_spec).num
    features, spec = config.stage1.features, env.observation_spec
    if declaration.sees_state:
        return PrivilegedQ(num_actions, env.state_spec, spec, features, config.mdp.sees, config.network)
    history = HistoryEncoder(num_actions, env.horizon + 1, memory_of(config), config.network)
    if declaration.believes:
        return BeliefQ(history, spec, features, config.believer)
    return TwoBranchQ(
        history, spec, features, bottom_psi=declaration.uses_representation, predicts_state=declaration.informed,
        predicts_itself=declaration.predicts_itself, critic=declaration.critic, state_spec=env.state_spec)


def make_agent(env: Environment, config: Config) -> DQN:
    """The agent that a configuration names, for an environment."""
    if not isinstance(env.action_spec, DiscreteActions):
        raise ConfigError(f"--domain: {env.name} has continuous actions, accepted by this agent: discrete actions")
    declaration, net = variant(config.agent), config.network
    width = net.action_embedding + net.observation_embedding
    require(memory_of(config) != "gpt" or width % net.heads == 0, "network.heads", net.heads,
            f"a divisor of the transformer's width {width} (action-embedding + observation-embedding)")
    network = _network(env, config, declaration)
    information_model = None
    if declaration.informed and config.information.intrinsic_weight > 0:
        information_model = InformationModel(cast(TwoBranchQ, network).top.clone(), config.stage1.features)
    dqn = config.dqn
    updates = max(1, round(config.steps * dqn.updates_per_step))
    rate = optax.linear_schedule(dqn.learning_rate, dqn.learning_rate * dqn.final_learning_rate, updates)
    return DQN(env, config, declaration, network, information_model, optax.adam(rate))


def _example_tokens(env: Environment, features: int) -> Tokens:
    """One token of zeros, enough to shape the parameters."""
    zeros = jnp.zeros((1, 1), jnp.int32)
    seen, state = (jnp.zeros((1, *spec.shape), spec.dtype) for spec in (env.observation_spec, env.state_spec))
    return Tokens(
        frames=seen, frame=None, z_s=jnp.zeros((1, 1, features)), previous_action=zeros, reward=jnp.zeros((1, 1)),
        terminated=zeros > 0, truncated=zeros > 0, segment=zeros + 1, position=zeros, states=state)

"""Double DQN over whole episodes with a two-branch memory agent (paper Section 3.2, Appendix A)."""

import dataclasses
from collections.abc import Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp

from envs_mjx.base import DiscreteActions, Environment
from mijax.agents.core import (
    Agent,
    AgentState,
    Heads,
    adam,
    episode_mean,
    make_information_model,
    may_follow,
    transitions,
)
from mijax.agents.variants import Variant, memory_of, pretrain_updates, variant
from mijax.config import Config, ConfigError, DQNConfig
from mijax.losses import td
from mijax.losses.returns import traced_returns
from mijax.nets.belief import BeliefQ
from mijax.nets.privileged import PrivilegedQ
from mijax.nets.two_branch import HistoryEncoder, MemoryState, Outputs, TwoBranchQ
from mijax.types import Metrics, Params, Representation, Tokens

__all__ = ["DQN", "AgentState", "make_dqn"]


@dataclasses.dataclass(frozen=True)
class DQN(Agent):
    """Acts on Q(h, a), epsilon-greedily while it learns."""

    network: TwoBranchQ | BeliefQ | PrivilegedQ

    @property
    def options(self) -> DQNConfig:
        """The group `dqn`."""
        return self.config.dqn

    @property
    def group(self) -> str:
        """dqn"""
        return "dqn"

    @property
    def copies(self) -> int:
        """None."""
        return 0

    @property
    def pretrain_updates(self) -> int:
        """On the random episodes of stage 1, where the agent has any."""
        return pretrain_updates(self.config)

    def start_from(self, agent: Params, representation: Representation) -> Params:
        """Frozen phi and psi for the agent that sees the state; psi in the memoryless branch of the others."""
        if self.declaration.sees_state:
            if self.config.mdp.sees != "state":
                return agent | {"phi": representation.phi, "psi": representation.psi}
        elif self.declaration.uses_representation and self.config.information.start_from_psi:
            return agent | {"bottom": representation.psi}
        return agent

    def epsilon(self, environment_steps: jax.Array) -> jax.Array:
        """() falls linearly; after updates on the episodes of stage 1 from the middle of its schedule on."""
        final = self.options.epsilon_final
        begun = (1 - self.options.pretrained_epsilon) / ((1 - final) or 1.0) if self.pretrain_updates else 0.0
        progress = jnp.minimum(environment_steps / self.options.epsilon_steps + begun, 1)
        return 1 + (final - 1) * progress

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
        memory, q = self.action_values(params, memory, observation, previous_action)
        return memory, jnp.argmax(q, axis=-1).astype(jnp.int32)

    def action_values(
        self, params: Params, memory: MemoryState, observation: jax.Array, previous_action: jax.Array
    ) -> tuple[MemoryState, jax.Array]:
        """The new memory and (B, A) float32 Q(h, a) after one more observation; arguments as for `act`."""
        variables = {"params": params}
        return cast(Any, self.network.apply(variables, memory, observation, previous_action, method="step"))

    def value(
        self, params: Params, memory: MemoryState, observation: jax.Array, previous_action: jax.Array
    ) -> jax.Array:
        """(B,) max_a Q(h, a) after one more observation; arguments as for `act`."""
        return jnp.max(self.action_values(params, memory, observation, previous_action)[1], axis=-1)

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
        self, params: Params, target: Params, tokens: Tokens, representation: Representation | None, updates: jax.Array,
        key: jax.Array,
    ) -> tuple[jax.Array, Metrics]:
        """The sum of the TD losses, the weighted auxiliary losses and f's own loss; () and its parts."""
        del updates
        key_agent, key_f = jax.random.split(key)
        tokens = self.labelled(tokens, representation)
        online: Outputs = self._apply(self.network, params["agent"], tokens, key_agent)
        q_select = online.q if self._exact else self._clean(self.network, params["agent"], tokens).q
        averaged: Outputs = self._clean(self.network, target, tokens)
        bonus = jnp.zeros_like(tokens.reward)
        loss, metrics = self._auxiliary([online], [averaged], tokens, representation)
        if self.information_model is not None:
            loss_f, bonus, parts = self._information(params["f"], tokens, representation, key_f)
            loss, metrics = loss + loss_f, metrics | parts
        loss_td, parts = self._td(online, q_select, averaged, bonus, tokens)
        return loss + loss_td, metrics | parts

    def heads(self, agent: Params, tokens: Tokens, key: jax.Array) -> Sequence[Heads]:
        """The one memory branch's."""
        return [self._apply(self.network, agent, tokens, key)]

    def _td(
        self, online: Outputs, q_select: jax.Array, averaged: Outputs, bonus: jax.Array, tokens: Tokens
    ) -> tuple[jax.Array, Metrics]:
        """TD losses over the transitions token l -> l + 1 of the same segment, of Q(h, a) and of an asymmetric critic.

        `q_select` chooses the greedy actions. Both heads regress the same targets, which an asymmetric critic's average
        bootstraps where there is one.
        """
        dqn = self.config.dqn
        valid, action = transitions(tokens), tokens.previous_action[:, 1:]
        greedy = td.is_greedy(q_select[:, :-1], action, dqn.trace_tolerance)
        q_target = averaged.q if averaged.critic is None else averaged.critic
        if dqn.value_bound > 0:
            q_target = jnp.clip(q_target, -dqn.value_bound, dqn.value_bound)
        target = traced_returns(
            r_t=tokens.reward[:, 1:] + bonus[:, 1:],
            discount_t=self._discounts(tokens),
            v_t=td.double_q_value(q_select[:, 1:], q_target[:, 1:]),
            trace_t=dqn.trace_decay * may_follow(valid & greedy),
        )
        loss, parts = td.td_loss(online.q[:, :-1], action, target, valid)
        metrics = {"loss/td": loss, "q/mean": parts["q"], "q/error": parts["td_error"],
                   "train/bonus": episode_mean(bonus[:, 1:], valid, tokens)}
        if online.critic is not None:
            loss_critic, _ = td.td_loss(online.critic[:, :-1], action, target, valid)
            loss, metrics = loss + loss_critic, metrics | {"loss/critic": loss_critic}
        return loss, metrics


def _network(env: Environment, config: Config, declaration: Variant) -> TwoBranchQ | BeliefQ | PrivilegedQ:
    """The agent's network, by its declaration."""
    num_actions = cast(DiscreteActions, env.action_spec).num
    features, spec = config.stage1.features, env.observation_spec
    if declaration.sees_state:
        return PrivilegedQ(env.state_spec, spec, features, config.mdp.sees, num_actions, config.network)
    history = HistoryEncoder(num_actions, env.horizon + 1, memory_of(config), config.network)
    if declaration.believes:
        return BeliefQ(config.network, spec, features, top=history, believer=config.believer)
    return TwoBranchQ(
        history, spec, features, bottom_psi=declaration.uses_representation, predicts_state=declaration.informed,
        predicts_itself=declaration.predicts_itself, critic=declaration.critic, state_spec=env.state_spec)


def make_dqn(env: Environment, config: Config) -> DQN:
    """The agent that a configuration names, for an environment with discrete actions."""
    if not isinstance(env.action_spec, DiscreteActions):
        raise ConfigError(f"--domain: {env.name} has continuous actions, accepted by this agent: discrete actions")
    declaration = variant(config.agent)
    network = _network(env, config, declaration)
    updates = pretrain_updates(config) + config.dqn.updates_in(config.steps)
    model = None
    if declaration.informed:
        model = make_information_model(config, cast(TwoBranchQ, network).top)
    return DQN(env, config, declaration, network, model, adam(config.dqn, updates))

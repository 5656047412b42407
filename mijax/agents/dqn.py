"""Double DQN over whole episodes with a two-branch memory agent (paper Section 3.2, Appendix A)."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from envs_mjx.base import DiscreteActions, Environment
from mijax.agents.variants import Variant, variant
from mijax.config import Config, ConfigError
from mijax.losses import information as info
from mijax.losses import td
from mijax.nets.two_branch import InformationModel, MemoryState, TwoBranchQ
from mijax.types import Metrics, Params, Representation, Tokens


@struct.dataclass
class AgentState:
    """Everything that learning changes."""

    params: Params  # {"agent": ..., "f": ...}
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
        agent = self.network.init(key_agent, tokens)["params"]
        if representation is not None and self.config.information.start_from_psi:
            agent = {**agent, "bottom": representation.psi}
        params = {"agent": agent}
        if self.information_model is not None:
            params["f"] = self.information_model.init(key_f, tokens)["params"]
        target = jax.tree.map(jnp.copy, params["agent"])
        return AgentState(params, target, self.optimizer.init(params), jnp.zeros((), jnp.int32))

    def initial_memory(self, batch: int) -> MemoryState:
        """What `batch` episodes that have not started remember."""
        return self.network.apply({}, batch, method=TwoBranchQ.initial_state)

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
        memory, q = self.network.apply(
            {"params": params}, memory, observation, previous_action, method=TwoBranchQ.step
        )
        return memory, jnp.argmax(q, axis=-1).astype(jnp.int32)

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
        random = jax.random.randint(key_action, greedy.shape, 0, self.network.num_actions, jnp.int32)
        return memory, jnp.where(jax.random.uniform(key_gate, greedy.shape) < epsilon, random, greedy)

    def loss(
        self, params: Params, target: Params, tokens: Tokens, representation: Representation | None, key: jax.Array
    ) -> tuple[jax.Array, Metrics]:
        """The sum of the TD loss, the weighted auxiliary loss and f's own loss; () and its parts."""
        key_agent, key_f = jax.random.split(key)
        real = tokens.segment > 0
        q, predicted = self._apply(self.network, params["agent"], tokens, key_agent)
        q_target, _ = self.network.apply({"params": target}, tokens)

        bonus = jnp.zeros_like(tokens.reward)
        loss, metrics = jnp.zeros(()), {}
        if self.information_model is not None:
            f = self._apply(self.information_model, params["f"], tokens, key_f)
            loss_f, parts_f = info.prediction_mse(f, tokens.z_s, real, representation.z_s_variance)
            loss_k, parts_k = info.prediction_mse(predicted, tokens.z_s, real, representation.z_s_variance)
            bonus = self._bonus(jax.lax.stop_gradient(f), tokens.z_s, representation)
            loss = loss_f + self.config.information.auxiliary_weight * loss_k
            metrics |= {"loss/f": loss_f, "loss/auxiliary": loss_k,
                        "f/explained": parts_f["explained"], "auxiliary/explained": parts_k["explained"]}

        loss_td, parts_td, episode_bonus = self._td(q, q_target, bonus, tokens)
        metrics |= {"loss/td": loss_td, "q/mean": parts_td["q"], "q/error": parts_td["td_error"],
                    "train/bonus": episode_bonus}
        return loss + loss_td, metrics

    def update(
        self, state: AgentState, tokens: Tokens, representation: Representation | None, key: jax.Array
    ) -> tuple[AgentState, Metrics]:
        """One gradient step, then one soft step of the target network."""
        (_, metrics), grads = jax.value_and_grad(self.loss, has_aux=True)(
            state.params, state.target, tokens, representation, key
        )
        steps, optimizer = self.optimizer.update(grads, state.optimizer, state.params)
        params = optax.apply_updates(state.params, steps)
        target = optax.incremental_update(params["agent"], state.target, self.config.dqn.target_rate)
        return AgentState(params, target, optimizer, state.updates + 1), metrics

    def _apply(self, module: Any, params: Params, tokens: Tokens, key: jax.Array) -> Any:
        return module.apply({"params": params}, tokens, self.config.network.dropout == 0, rngs={"dropout": key})

    def _bonus(self, f: jax.Array, z_s: jax.Array, representation: Representation) -> jax.Array:
        """(R, L) alpha times the bonus for arriving at each token; meaningless on first tokens, which no target uses."""
        f_tm1 = jnp.roll(f, 1, axis=1)
        if self.config.information.intrinsic_form == "cosine":
            bonus = info.cosine_bonus(z_s, f, f_tm1)
        else:
            bonus = info.explained_variance_bonus(z_s, f, f_tm1, representation.z_s_variance)
        return self.config.information.intrinsic_weight * bonus

    def _td(
        self, q: jax.Array, q_target: jax.Array, bonus: jax.Array, tokens: Tokens
    ) -> tuple[jax.Array, Metrics, jax.Array]:
        """TD loss over the transitions token l -> l + 1 of the same segment, and the mean bonus of an episode."""
        dqn = self.config.dqn
        valid = (tokens.segment[:, :-1] == tokens.segment[:, 1:]) & (tokens.segment[:, 1:] > 0)
        action = tokens.previous_action[:, 1:]
        ended = tokens.terminated[:, 1:]
        if not dqn.bootstrap_at_time_limit:
            ended |= tokens.truncated[:, 1:]
        greedy = jnp.argmax(q, axis=-1)[:, :-1] == action
        follows = valid & greedy
        trace = dqn.trace_decay * jnp.pad(follows[:, 1:], ((0, 0), (0, 1)))
        target = td.watkins_returns(
            r_t=tokens.reward[:, 1:] + bonus[:, 1:],
            discount_t=dqn.discount * (1 - ended.astype(jnp.float32)),
            v_t=td.double_q_value(q[:, 1:], q_target[:, 1:]),
            trace_t=trace.astype(jnp.float32),
        )
        loss, parts = td.td_loss(q[:, :-1], action, target, valid)
        episodes = jnp.sum((tokens.position == 0) & (tokens.segment > 0))
        episode_bonus = jnp.sum(jnp.where(valid, bonus[:, 1:], 0)) / jnp.maximum(episodes, 1)
        return loss, parts, episode_bonus


def make_agent(env: Environment, config: Config) -> DQN:
    """The agent that a configuration names, for an environment."""
    if not isinstance(env.action_spec, DiscreteActions):
        raise ConfigError(f"--domain: {env.name} has continuous actions, accepted by this agent: discrete actions")
    declaration = variant(config.agent)
    common = dict(
        num_actions=env.action_spec.num,
        max_length=env.horizon + 1,
        memory=config.memory,
        network=config.network,
        features=config.stage1.features,
    )
    network = TwoBranchQ(
        observation_spec=env.observation_spec,
        bottom_psi=declaration.uses_z_s,
        predicts_state=declaration.uses_z_s,
        **common,
    )
    information_model = InformationModel(**common) if declaration.uses_z_s else None
    dqn = config.dqn
    updates = max(1, round(config.steps * dqn.updates_per_step))
    rate = optax.linear_schedule(dqn.learning_rate, dqn.learning_rate * dqn.final_learning_rate, updates)
    return DQN(config, declaration, network, information_model, optax.adam(rate))


def _example_tokens(network: TwoBranchQ) -> Tokens:
    """One token of zeros, enough to shape the parameters."""
    zeros = jnp.zeros((1, 1), jnp.int32)
    spec = network.observation_spec
    return Tokens(
        frames=jnp.zeros((1, *spec.shape), spec.dtype), frame=None, previous_action=zeros,
        reward=jnp.zeros((1, 1)), terminated=zeros > 0, truncated=zeros > 0, segment=zeros + 1, position=zeros, z_s=None,
    )

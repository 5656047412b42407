"""What both algorithms share: the information model f and its bonus, the auxiliary losses, one step of learning."""

import abc
import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, Protocol, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct

from envs_mjx.base import ContinuousActions, Environment
from mijax.agents.variants import Variant, memory_of
from mijax.config import Config, DQNConfig, SACConfig
from mijax.losses import information as info
from mijax.losses.belief import negative_elbo
from mijax.nets.two_branch import HistoryEncoder, InformationModel, MemoryState, Prediction
from mijax.types import Metrics, Params, Representation, Tokens


@struct.dataclass
class AgentState:
    """Everything that learning changes."""

    params: Params  # {"agent": ..., "f": [one per fold]}, and SAC's "log_temperature"
    target: Params  # the agent's moving average: bootstraps and, being steadier, acts greedily in evaluations
    optimizer: Any  # Adam's moments
    updates: jax.Array  # () int32


class Heads(Protocol):
    """What a memory branch says of every token beside its values; None where it has no such head."""

    @property
    def summary(self) -> jax.Array | None:
        """(R, L, W) of the history."""
        ...

    @property
    def z_s(self) -> jax.Array | None:
        """(R, L, F) predicted from the history, standardised as `Representation.standardise` does."""
        ...

    @property
    def next_summary(self) -> jax.Array | None:
        """(R, L, W) predicted summary after the action that was taken next."""
        ...

    @property
    def belief(self) -> tuple[jax.Array, ...] | None:
        """Decoded (R, L, F), mean and log-variance (R, L, Z), log scale ()."""
        ...


@dataclasses.dataclass(frozen=True)
class Agent(abc.ABC):
    """The functions of one agent; all pure, all state in `AgentState` and `MemoryState`."""

    env: Environment
    config: Config
    declaration: Variant
    network: Any
    information_model: InformationModel | None
    optimizer: optax.GradientTransformation

    @property
    @abc.abstractmethod
    def options(self) -> DQNConfig | SACConfig:
        """The algorithm's own group of the configuration."""

    @property
    @abc.abstractmethod
    def group(self) -> str:
        """The name of that group."""

    @property
    @abc.abstractmethod
    def copies(self) -> int:
        """Copies of each episode, moved by a symmetry of the task, that are sampled beside the original."""

    @property
    @abc.abstractmethod
    def pretrain_updates(self) -> int:
        """Updates before the agent acts."""

    @property
    def looks_once(self) -> bool:
        """Whether what the agent sees of a frame never changes, so that the replay stores that."""
        return False

    def init_network(self, key: jax.Array) -> Params:
        """Fresh parameters of the network."""
        return self.network.init(key, self.example_tokens())["params"]

    @abc.abstractmethod
    def start_from(self, agent: Params, representation: Representation) -> Params:
        """The network's parameters with those that the representation has for it in their places."""

    @abc.abstractmethod
    def epsilon(self, environment_steps: jax.Array) -> jax.Array:
        """() the share of uniformly random actions after so many steps."""

    @abc.abstractmethod
    def act(
        self, params: Params, memory: MemoryState, observation: jax.Array, previous_action: jax.Array
    ) -> tuple[MemoryState, jax.Array]:
        """Greedy actions of (B,) episodes after one more observation; the state is no argument."""

    @abc.abstractmethod
    def value(
        self, params: Params, memory: MemoryState, observation: jax.Array, previous_action: jax.Array
    ) -> jax.Array:
        """(B,) what the agent promises itself of episodes after their first observation."""

    @abc.abstractmethod
    def explore(
        self, params: Params, memory: MemoryState, observation: jax.Array, previous_action: jax.Array,
        epsilon: jax.Array, key: jax.Array,
    ) -> tuple[MemoryState, jax.Array]:
        """As `act`, but as the agent acts while it learns: uniformly random with probability `epsilon`."""

    @abc.abstractmethod
    def loss(
        self, params: Params, target: Params, tokens: Tokens, representation: Representation | None, updates: jax.Array,
        key: jax.Array,
    ) -> tuple[jax.Array, Metrics]:
        """The sum of all losses after so many updates; () and its parts."""

    @abc.abstractmethod
    def heads(self, agent: Params, tokens: Tokens, key: jax.Array) -> Sequence[Heads]:
        """What each of the agent's memory branches says, in a gradient pass."""

    def init(self, key: jax.Array, representation: Representation | None) -> AgentState:
        """Fresh parameters; the memoryless branch starts from psi when the agent uses a representation."""
        key_agent, key_f = jax.random.split(key)
        agent = dict(self.init_network(key_agent))
        if representation is not None:
            agent = self.start_from(agent, representation)
        params: dict[str, Params] = {"agent": agent} | self.further_parameters()
        if self.information_model is not None:
            tokens, keys = self.example_of_f(agent), jax.random.split(key_f, self.config.information.folds)
            params["f"] = [self.information_model.init(key, tokens)["params"] for key in keys]
        target = jax.tree.map(jnp.copy, params["agent"])
        return AgentState(params, target, self.optimizer.init(params), jnp.zeros((), jnp.int32))

    def further_parameters(self) -> dict[str, Params]:
        """What is learnt beside the network and f."""
        return {}

    def example_of_f(self, agent: Params) -> Tokens:
        """A token of zeros as the information model sees it."""
        del agent
        return self.example_tokens()

    def initial_memory(self, batch: int) -> MemoryState:
        """What `batch` episodes that have not started remember."""
        return cast(MemoryState, self.network.apply({}, batch, method="initial_state"))

    def no_action(self, batch: int) -> jax.Array:
        """The previous action of (batch,) episodes that have not started: -1, or zeros where actions are vectors."""
        spec = self.env.action_spec
        if isinstance(spec, ContinuousActions):
            return jnp.zeros((batch, spec.size))
        return jnp.full((batch,), -1, jnp.int32)

    def example_tokens(self) -> Tokens:
        """One token of zeros, enough to shape the parameters."""
        zeros, env = jnp.zeros((1, 1), jnp.int32), self.env
        seen, state = (jnp.zeros((1, *spec.shape), spec.dtype) for spec in (env.observation_spec, env.state_spec))
        none = self.no_action(1)
        return Tokens(
            frames=seen, frame=None, z_s=jnp.zeros((1, 1, self.config.stage1.features)),
            previous_action=jnp.zeros((1, 1, *none.shape[1:]), none.dtype), reward=jnp.zeros((1, 1)),
            terminated=zeros > 0, truncated=zeros > 0, segment=zeros + 1, position=zeros, states=state)

    def fit_belief(
        self, state: AgentState, tokens: Tokens, representation: Representation, key: jax.Array
    ) -> tuple[AgentState, Metrics]:
        """One step of the auxiliary losses alone: Believer's second stage, before learning the task."""
        tokens = self.labelled(tokens, representation)

        def loss(params: Params) -> tuple[jax.Array, Metrics]:
            online = self.heads(params["agent"], tokens, key)
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
            state.params, state.target, tokens, representation, state.updates, key
        )
        steps, optimizer = self.optimizer.update(grads, state.optimizer, state.params)
        params = cast(Params, optax.apply_updates(state.params, steps))
        target = optax.incremental_update(params["agent"], state.target, self.options.target_rate)
        return AgentState(params, target, optimizer, state.updates + 1), metrics

    def labelled(self, tokens: Tokens, representation: Representation | None) -> Tokens:
        """The tokens with z_s as the agent's network wants it: Believer's standardised."""
        if not self.declaration.believes:
            return tokens
        scale = cast(Representation, representation)
        return dataclasses.replace(tokens, z_s=scale.standardise(cast(jax.Array, tokens.z_s)))

    @property
    def _exact(self) -> bool:
        """Whether gradient passes draw nothing, neither dropout nor Believer's latents, so that their outputs serve
        targets and bonus too."""
        drops = self.config.network.dropout > 0 and memory_of(self.config) not in ("gru", "mlp")
        return not drops and not self.declaration.believes

    def _apply(self, module: Any, params: Params, tokens: Tokens, key: jax.Array) -> Any:
        return module.apply({"params": params}, tokens, self._exact, rngs={"dropout": key})

    def _clean(self, module: Any, params: Params, tokens: Tokens) -> Any:
        return module.apply({"params": params}, tokens)

    def _information(
        self, params: Params, tokens: Tokens, representation: Any, key: jax.Array
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """f's loss, and (R, L) the weighted bonus for arriving at each token.

        With `--information.folds 2` two models f, each trained on one fold of the episodes; the bonus of an episode
        comes from the one that never saw it. A single f learns the episodes of the replay by heart: at step 45 of
        episodes without any information it explained 0.83 of z_s (measured, Heaven-Hell, 12 000 steps), and the bonus
        then pays for wandering about. The bonus of an episode's first token is meaningless; no target uses it.
        """
        variance, z_s = representation.z_s_variance, cast(jax.Array, tokens.z_s)
        real = tokens.segment > 0
        folds = tokens.folds() if len(params) == 2 else (tokens,)
        keys = jax.random.split(key, len(params))
        f = _concatenate(
            self._apply(self.information_model, *arguments) for arguments in zip(params, folds, keys, strict=True))
        loss_f, parts_f = info.prediction_mse(representation.destandardise(f.mean), z_s, real, variance)
        metrics = {"loss/f": loss_f, "f/explained": parts_f["explained"]}
        f_t = f
        if not self._exact or len(params) == 2:
            f_t = _concatenate(
                self._clean(self.information_model, *arguments) for arguments in zip(params[::-1], folds, strict=True))
        f_t = jax.lax.stop_gradient(f_t)
        if len(params) == 2:
            unseen = info.prediction_mse(representation.destandardise(f_t.mean), z_s, real, variance)
            metrics["f/explained_unseen"] = unseen[1]["explained"]
        if f.log_variance is not None:
            nll = info.variance_nll(representation.destandardise(f.mean), f.log_variance, z_s, real, variance)
            loss_f, metrics = loss_f + nll, metrics | {"loss/f_variance": nll}
        return loss_f, self.config.information.intrinsic_weight * self.bonus(f_t, z_s, representation), metrics

    def bonus(self, f: Prediction, z_s: jax.Array, representation: Representation) -> jax.Array:
        """(R, L) information gained about z_s (R, L, F) on arriving at each token; of a first token meaningless."""
        options, variance = self.config.information, representation.z_s_variance
        f_t = representation.destandardise(f.mean)
        f_tm1 = jnp.roll(f_t, 1, axis=1)
        z_s_tm1 = jnp.roll(z_s, 1, axis=1) if options.intrinsic_telescopes else None
        if options.intrinsic_form == "cosine":
            return info.cosine_bonus(z_s, f_t, f_tm1, z_s_tm1)
        if options.intrinsic_form == "explained_variance":
            return info.explained_variance_bonus(z_s, f_t, f_tm1, variance, z_s_tm1)
        log_variance = cast(jax.Array, f.log_variance)
        return info.log_likelihood_bonus(
            z_s, f_t, f_tm1, log_variance, jnp.roll(log_variance, 1, axis=1), variance, z_s_tm1)

    def _auxiliary(
        self, online: Sequence[Heads], averaged: Sequence[Heads], tokens: Tokens, representation: Representation | None
    ) -> tuple[jax.Array, Metrics]:
        """The weighted losses of the heads of every memory branch, added up; () and their means by kind."""
        loss, found = jnp.zeros(()), []
        for branch, average in zip(online, averaged, strict=True):
            loss_branch, parts = self._auxiliary_of_branch(branch, average, tokens, representation)
            loss += loss_branch
            found.append(parts)
        return loss, jax.tree.map(lambda *values: jnp.mean(jnp.stack(values)), *found) if found else {}

    def _auxiliary_of_branch(
        self, online: Heads, averaged: Heads, tokens: Tokens, representation: Representation | None
    ) -> tuple[jax.Array, Metrics]:
        loss, metrics = jnp.zeros(()), {}
        real = tokens.segment > 0
        if online.z_s is not None:
            scale = cast(Representation, representation)
            loss_k, parts = info.prediction_mse(
                scale.destandardise(online.z_s), cast(jax.Array, tokens.z_s), real, scale.z_s_variance)
            unit = 1.0 if self.config.information.auxiliary_in_variances else scale.z_s_variance
            loss += self.config.information.auxiliary_weight * loss_k * unit
            metrics |= {"loss/auxiliary": loss_k, "auxiliary/explained": parts["explained"]}
        if online.next_summary is not None:
            later = jax.lax.stop_gradient(cast(jax.Array, averaged.summary))[:, 1:]
            loss_z, _ = info.prediction_mse(online.next_summary[:, :-1], later, transitions(tokens))
            loss += self.config.zp.weight * loss_z
            metrics |= {"loss/self_prediction": loss_z}
        if online.belief is not None:
            decoded, mean, log_variance, log_scale = online.belief
            loss_b, parts = negative_elbo(
                cast(jax.Array, tokens.z_s), decoded, log_scale, mean, log_variance, real)
            loss += self.config.believer.weight * loss_b
            metrics |= {"loss/belief": loss_b, "belief/error": parts["error"], "belief/kl": parts["kl"]}
        return loss, metrics

    def _discounts(self, tokens: Tokens) -> jax.Array:
        """(R, L - 1) gamma, or 0 where a transition ends its episode."""
        options = self.options
        ended = tokens.terminated if options.bootstrap_at_time_limit else tokens.terminated | tokens.truncated
        return options.discount * (1 - ended[:, 1:].astype(jnp.float32))


def transitions(tokens: Tokens) -> jax.Array:
    """(R, L - 1) bool: whether tokens l and l + 1 belong to the same episode."""
    return (tokens.segment[:, :-1] == tokens.segment[:, 1:]) & (tokens.segment[:, 1:] > 0)


def may_follow(followed: jax.Array) -> jax.Array:
    """(R, L - 1) float32: 1 where the return of a transition may go on through the next one, which is `followed`."""
    return jnp.pad(followed[:, 1:].astype(jnp.float32), ((0, 0), (0, 1)))


def episode_mean(x: jax.Array, valid: jax.Array, tokens: Tokens) -> jax.Array:
    """() the sum of `x` over the `valid` transitions of an episode, both (R, L - 1), on average."""
    episodes = jnp.sum((tokens.position == 0) & (tokens.segment > 0), dtype=jnp.float32)
    return jnp.sum(jnp.where(valid, x, 0)) / jnp.maximum(episodes, 1)


def adam(options: DQNConfig | SACConfig, updates: int) -> optax.GradientTransformation:
    """Adam, whose step size falls linearly over the updates of a run."""
    rate = optax.linear_schedule(
        options.learning_rate, options.learning_rate * options.final_learning_rate, updates)
    return optax.adam(rate)


def _concatenate(predictions: Iterable[Prediction]) -> Prediction:
    """Of all folds, along their rows."""
    return cast(Prediction, jax.tree.map(lambda *rows: jnp.concatenate(rows), *predictions))


def make_information_model(config: Config, top: HistoryEncoder) -> InformationModel | None:
    """f for an informed agent whose memory branch is `top`; None where there is no bonus."""
    if config.information.intrinsic_weight == 0:
        return None
    return InformationModel(
        top.clone(), config.stage1.features, has_variance=config.information.intrinsic_form == "log_likelihood")

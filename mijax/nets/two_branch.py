"""The two-branch agent and the information model f (paper Fig. 1)."""

from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from envs_mjx.base import ArraySpec
from mijax.config import CriticInput, MemoryKind, NetworkConfig
from mijax.frames import FrameTable, keep_present, take
from mijax.losses.information import LEAST_LOG_VARIANCE
from mijax.nets.encoders import Encoder, encoder_for
from mijax.nets.gpt import GPT
from mijax.nets.gru import GRU
from mijax.nets.heads import MLP, ActionEmbedder, ObservationEmbedder, action_vector
from mijax.types import Tokens

LONG_LIST = 256
"""From so many observations on it is worth looking whether a batch shows but a quarter of them."""


@struct.dataclass
class MemoryState:
    """What an agent carries through an episode while acting."""

    position: jax.Array  # (B,) int32, tokens seen so far
    recurrent: Any  # keys and values of the GPT, or the hidden state of the GRU


def flat(x: jax.Array) -> jax.Array:
    """(R, L, ...) -> (R L, ...)"""
    return x.reshape(-1, *x.shape[2:])


def frame_features(encoder: ObservationEmbedder | Encoder, tokens: Tokens) -> jax.Array:
    """What the encoder says of the observation of every token: (R L, F)."""
    if not isinstance(tokens.frames, FrameTable):
        return encoder(tokens.frames)
    index = cast(jax.Array, tokens.frame).reshape(-1)
    shape, count = tokens.frames.frames.shape[1:], len(tokens.frames)
    layers = encoder.layers_on(shape) if isinstance(encoder, ObservationEmbedder) else encoder.layers
    every = tokens.frames.prepared(layers)
    if count < LONG_LIST:
        return encoder(every)[index]
    few, present, place = keep_present(index, count, count // 4)
    return nn.cond(
        few, lambda module: module(take(every, present))[place], lambda module: module(every)[index], encoder)


@struct.dataclass
class Outputs:
    """What a network says of every token; None where the agent has no such head."""

    q: jax.Array  # (R, L, A)  action values, by which the agent acts
    summary: jax.Array | None = None  # (R, L, W)  of the history
    z_s: jax.Array | None = None  # (R, L, F)  predicted from the history, standardised (`Representation.standardise`)
    critic: jax.Array | None = None  # (R, L, A)  the asymmetric critic's values
    next_summary: jax.Array | None = None  # (R, L, W)  predicted summary after the action that was taken next
    belief: tuple[jax.Array, ...] | None = None  # decoded (R, L, F), mean and log-variance (R, L, Z), log scale ()


class HistoryEncoder(nn.Module):
    """The memory branch: embedded previous action and observation, then a sequence model.

    Without memory (`mlp`) it is the embedded observation of the moment.
    """

    num_actions: int  # kinds of discrete actions, or the size of continuous ones
    max_length: int
    memory: MemoryKind
    network: NetworkConfig

    def setup(self) -> None:
        net, dtype = self.network, jnp.dtype(self.network.dtype)
        self.embed_action = ActionEmbedder(self.num_actions, net.action_embedding, dtype)
        self.embed_observation = ObservationEmbedder(net.observation_embedding, dtype)
        width = net.action_embedding + net.observation_embedding
        if self.memory == "gpt":
            self.sequence = GPT(width, self.max_length, net.layers, net.heads, net.dropout, dtype)
        elif self.memory == "gru":
            self.sequence = GRU(net.gru_width, dtype)
        else:
            self.present = nn.Dense(width, dtype=dtype)

    def __call__(self, tokens: Tokens, deterministic: bool = True) -> jax.Array:
        """(R L, W) a summary of the history at every token."""
        observation = frame_features(self.embed_observation, tokens)
        if self.memory == "mlp":
            return nn.relu(self.present(observation))
        x = jnp.concatenate([self.embed_action(flat(tokens.previous_action)), observation], axis=-1)
        return self.sequence(x, tokens.segment, tokens.position, deterministic)

    def initial_state(self, batch: int) -> MemoryState:
        """The memory of `batch` episodes that have not started."""
        recurrent = () if self.memory == "mlp" else self.sequence.initial_state(batch)
        return MemoryState(jnp.zeros((batch,), jnp.int32), recurrent)

    def step(
        self, state: MemoryState, observation: jax.Array, previous_action: jax.Array
    ) -> tuple[MemoryState, jax.Array]:
        """One token for each of (B,) episodes -> new memory, (B, W) history summaries."""
        seen = self.embed_observation(observation)
        if self.memory == "mlp":
            return MemoryState(state.position + 1, ()), nn.relu(self.present(seen))
        x = jnp.concatenate([self.embed_action(previous_action), seen], axis=-1)
        recurrent, summary = self.sequence.step(state.recurrent, x, state.position)
        return MemoryState(state.position + 1, recurrent), summary


def _state_head(network: NetworkConfig, features: int) -> MLP:
    """A head that predicts z_s, starting from its mean.

    With random last weights f never explained more than -0.03 of z_s on Sphinx in 73 000 steps; from zero 0.34 after
    36 000 (one run each, otherwise alike).
    """
    return MLP(network.auxiliary_hidden, features, jnp.dtype(network.dtype), start_at_zero=True)


@struct.dataclass
class Branches:
    """What both branches say of N = R L tokens; None where there is no such head."""

    both: jax.Array  # (N, W + F)  the memory branch beside the memoryless one
    summary: jax.Array  # (N, W)  of the history
    z_s: jax.Array | None  # (N, F)  predicted from the history, standardised
    next_summary: jax.Array | None  # (N, W)  predicted summary after the action that was taken next


class TwoBranch(nn.Module):
    """A memory branch over the history beside a memoryless branch over the observation, and the heads of both."""

    top: HistoryEncoder
    observation_spec: ArraySpec
    features: int
    bottom_psi: bool  # the memoryless branch has psi's architecture, so that it can start from it
    predicts_state: bool = False  # the memory branch has a head that predicts z_s (the auxiliary task)
    predicts_itself: bool = False  # and one that predicts its own next summary (Eq. 6)
    after_trunk: bool = False  # observations come as features of a trunk: only a layer is left to do

    def setup(self) -> None:
        net, dtype = self.top.network, jnp.dtype(self.top.network.dtype)
        self.bottom = self.make_bottom()
        if self.predicts_state:
            self.state_head = _state_head(net, self.features)
        if self.predicts_itself:
            width = net.gru_width
            self.next_head = MLP((width,), width, dtype)

    def make_bottom(self) -> Any:
        """The encoder of the memoryless branch: psi's, or one of the agent's own."""
        if self.bottom_psi and self.after_trunk:
            return nn.Dense(self.features, dtype=jnp.dtype(self.top.network.dtype))
        if self.bottom_psi:
            return encoder_for(self.observation_spec, self.features)
        return own_encoder(self.observation_spec, jnp.dtype(self.top.network.dtype))

    def branches(self, tokens: Tokens, deterministic: bool = True) -> Branches:
        """Both branches, and what the heads of the memory branch say."""
        summary = self.top(tokens, deterministic)
        z_o = frame_features(self.bottom, tokens)
        both = jnp.concatenate([summary, z_o.astype(summary.dtype)], axis=-1)
        z_s = next_summary = None
        if self.predicts_state:
            z_s = self.state_head(summary)
        if self.predicts_itself:
            taken = flat(jnp.roll(tokens.previous_action, -1, axis=1))
            action = action_vector(taken, self.top.num_actions, summary.dtype)
            next_summary = self.next_head(jnp.concatenate([summary, action], axis=-1))
        return Branches(both, summary, z_s, next_summary)

    def initial_state(self, batch: int) -> MemoryState:
        """The memory of `batch` episodes that have not started."""
        return self.top.initial_state(batch)

    def step_branches(
        self, state: MemoryState, observation: jax.Array, previous_action: jax.Array
    ) -> tuple[MemoryState, jax.Array]:
        """One token for each of (B,) episodes -> new memory, (B, W + F) both branches."""
        state, summary = self.top.step(state, observation, previous_action)
        return state, jnp.concatenate([summary, self.bottom(observation).astype(summary.dtype)], axis=-1)


class TwoBranchQ(TwoBranch):
    """Q(h, a) from both branches."""

    critic: CriticInput | None = None  # an asymmetric critic of s, or of h, o and s
    state_spec: ArraySpec | None = None  # what the critic sees

    def setup(self) -> None:
        super().setup()
        net, dtype = self.top.network, jnp.dtype(self.top.network.dtype)
        self.q_head = MLP(net.critic_hidden, self.top.num_actions, dtype)
        if self.critic is not None:
            assert self.state_spec is not None
            self.state_encoder = own_encoder(self.state_spec, dtype)
            self.critic_head = MLP(net.critic_hidden, self.top.num_actions, dtype)

    def __call__(self, tokens: Tokens, deterministic: bool = True) -> Outputs:
        """Action values, and what the other heads say."""
        seen, critic = self.branches(tokens, deterministic), None
        if self.critic is not None:
            state = self.state_encoder(cast(jax.Array, tokens.states))
            critic = self.critic_head(
                state if self.critic == "state" else jnp.concatenate([seen.both, state], axis=-1))

        def of_tokens(x: jax.Array) -> jax.Array:
            return x.astype(jnp.float32).reshape(*tokens.segment.shape, -1)

        return jax.tree.map(
            of_tokens, Outputs(self.q_head(seen.both), seen.summary, seen.z_s, critic, seen.next_summary))

    def step(
        self, state: MemoryState, observation: jax.Array, previous_action: jax.Array
    ) -> tuple[MemoryState, jax.Array]:
        """One token for each of (B,) episodes -> new memory, (B, A) action values."""
        state, both = self.step_branches(state, observation, previous_action)
        return state, self.q_head(both).astype(jnp.float32)


def own_encoder(spec: ArraySpec, dtype: jnp.dtype) -> ObservationEmbedder:
    """The memoryless branch of an agent that does not start from psi, and the state's of an asymmetric critic."""
    return ObservationEmbedder(100 if spec.is_image else 128, dtype)


@struct.dataclass
class Prediction:
    """A Gaussian over z_s, standardised, at every token."""

    mean: jax.Array  # (R, L, F)
    log_variance: jax.Array | None = None  # (R, L) log of E|z_s - mean|^2, at most 0; None where it is not modelled


class InformationModel(nn.Module):
    """f(h): a Gaussian over z_s given the history (paper Eq. 4, 5). A network of its own."""

    history: HistoryEncoder
    features: int
    has_variance: bool = False
    """Whether the variance is learnt too, which the bonus `log_likelihood` needs."""

    def setup(self) -> None:
        self.head = _state_head(self.history.network, self.features)
        if self.has_variance:
            self.variance_head = _state_head(self.history.network, 1)

    def __call__(self, tokens: Tokens, deterministic: bool = True) -> Prediction:
        """What is known about z_s at every token. The variance has no gradient on the history's encoder."""
        summary = self.history(tokens, deterministic)
        mean = self.head(summary).astype(jnp.float32).reshape(*tokens.segment.shape, self.features)
        if not self.has_variance:
            return Prediction(mean)
        x = self.variance_head(jax.lax.stop_gradient(summary)).astype(jnp.float32).reshape(tokens.segment.shape)
        return Prediction(mean, LEAST_LOG_VARIANCE * jax.nn.sigmoid(x - 3))  # begins near that of a guess, 0

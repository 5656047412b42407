"""The agent of Believer: its history reaches Q only through samples of a belief p(z_s | h) (paper Appendix A.5)."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from envs_mjx.base import ArraySpec
from mijax.config import BelieverConfig, NetworkConfig
from mijax.nets.encoders import encoder_for
from mijax.nets.heads import MLP
from mijax.nets.two_branch import HistoryEncoder, MemoryState, Outputs, frame_features
from mijax.types import Tokens

NOISE_SEED = 20
"""Of the fixed latent samples with which the agent acts and bootstraps: the same in every call."""


class _Scalar(nn.Module):
    """One learned number."""

    initial: float

    @nn.compact
    def __call__(self) -> jax.Array:
        return self.param("value", nn.initializers.constant(self.initial), ())


@struct.dataclass
class Belief:
    """What the history model says of N = R L tokens."""

    both: jax.Array  # (N, W + F)  the embedded belief beside the features of the observation
    samples: tuple[jax.Array, ...]  # (N, F) each, of z_s
    terms: tuple[jax.Array, ...] | None  # of the VAE's loss: see `Outputs.belief`


class BeliefReader(nn.Module):
    """b beside psi(o), b a function of the mean over samples z_s ~ p(z_s | h) of a learned embedding of each."""

    network: NetworkConfig
    observation_spec: ArraySpec
    features: int
    after_trunk: bool = False  # as in `TwoBranch`

    def setup(self) -> None:
        width, dtype = self.network.auxiliary_hidden[-1], jnp.dtype(self.network.dtype)
        # One layer for each sample, the rest after the mean: samples times tokens are most of the agent's arithmetic.
        self.embed_sample, self.embed_belief = nn.Dense(width, dtype=dtype), nn.Dense(width, dtype=dtype)
        self.bottom = self.make_bottom()

    def make_bottom(self) -> Any:
        """The encoder of the memoryless branch, of psi's architecture, or its output layer."""
        if self.after_trunk:
            return nn.Dense(self.features, dtype=jnp.dtype(self.network.dtype))
        return encoder_for(self.observation_spec, self.features)

    def read(self, samples: Sequence[jax.Array], z_o: jax.Array) -> jax.Array:
        """(N, F) each, and (N, F) features of the observations -> (N, W + F)."""
        embedded = sum(nn.relu(self.embed_sample(z_s)) for z_s in samples)
        belief = nn.relu(self.embed_belief(embedded / len(samples)))
        return jnp.concatenate([belief, z_o.astype(belief.dtype)], axis=-1)

    def read_tokens(self, samples: Sequence[jax.Array], tokens: Tokens) -> jax.Array:
        """(N, W + F) of N = R L tokens."""
        return self.read(samples, frame_features(self.bottom, tokens))

    def read_observation(self, samples: Sequence[jax.Array], observation: jax.Array) -> jax.Array:
        """(N, W + F) of N observations."""
        return self.read(samples, self.bottom(observation))


class BeliefBranches(BeliefReader, kw_only=True):
    """The belief p(z_s | h), and a reader of it that is trained with it.

    p(z_s | h) is a variational autoencoder: a summary x of the history (Table 2: 16 wide) and a standard normal latent
    (Table 2: 16) decode to z_s, standardised. In gradient passes latents are drawn afresh.

    The decoder's standard deviation starts at that of a feature of z_s, whose F variances add up to 1. From 1, Adam
    takes 1 700 updates to get there; until then a latent costs more than it tells, and on Heaven-Hell the decoder had
    by then no unit left that was ever on, in three seeds of three: the belief said nothing of z_s for good.
    """

    top: HistoryEncoder
    believer: BelieverConfig

    def setup(self) -> None:
        super().setup()
        net, dtype = self.network, jnp.dtype(self.network.dtype)
        self.summarise = nn.Dense(self.believer.history_width, dtype=dtype)
        self.posterior = MLP(net.auxiliary_hidden, 2 * self.believer.latent_width, dtype)
        self.decoder = MLP(net.auxiliary_hidden, self.features, dtype)
        self.log_scale = _Scalar(-0.5 * math.log(self.features))

    def branches(self, tokens: Tokens, deterministic: bool = True) -> Belief:
        """The belief and, where `tokens.z_s` is given, standardised, the terms of the VAE."""
        x = self.summarise(self.top(tokens, deterministic))
        noise = self._fixed()
        if not deterministic:
            noise = jax.random.normal(self.make_rng("dropout"), (x.shape[0], *noise.shape[1:]))
        samples = tuple(self._samples(x, noise))
        both, shape = self.read_tokens(samples, tokens), tokens.segment.shape
        if tokens.z_s is None:
            return Belief(both, samples, None)
        mean, log_variance = jnp.split(
            self.posterior(jnp.concatenate([x, tokens.z_s.reshape(x.shape[0], -1)], axis=-1)), 2, axis=-1)
        latent = mean + jnp.exp(0.5 * log_variance) * noise[:, 0]
        decoded = self.decoder(jnp.concatenate([x, latent], axis=-1))
        terms = tuple(term.astype(jnp.float32).reshape(*shape, -1) for term in (decoded, mean, log_variance))
        return Belief(both, samples, (*terms, self.log_scale()))

    def initial_state(self, batch: int) -> MemoryState:
        """The memory of `batch` episodes that have not started."""
        return self.top.initial_state(batch)

    def step_samples(
        self, state: MemoryState, observation: jax.Array, previous_action: jax.Array
    ) -> tuple[MemoryState, tuple[jax.Array, ...]]:
        """One token for each of (B,) episodes -> new memory, samples of z_s, (B, F) each."""
        state, summary = self.top.step(state, observation, previous_action)
        return state, tuple(self._samples(self.summarise(summary), self._fixed()))

    def _fixed(self) -> jax.Array:
        """(1, K, Z)"""
        return jax.random.normal(
            jax.random.key(NOISE_SEED), (self.believer.samples, self.believer.latent_width))[None]

    def _samples(self, x: jax.Array, noise: jax.Array) -> Iterator[jax.Array]:
        """(N, X) summaries, (N or 1, K, Z) latents -> (N, F) samples of z_s, one after the other for all tokens: in one
        array they took 1.4 times as long (results/bench.md)."""
        noise = jnp.broadcast_to(noise, (x.shape[0], *noise.shape[1:])).astype(x.dtype)
        for k in range(noise.shape[1]):
            yield self.decoder(jnp.concatenate([x, noise[:, k]], axis=-1))


class BeliefQ(BeliefBranches):
    """Q(b, o, a)."""

    def setup(self) -> None:
        super().setup()
        net = self.network
        self.q_head = MLP(net.critic_hidden, self.top.num_actions, jnp.dtype(net.dtype))

    def __call__(self, tokens: Tokens, deterministic: bool = True) -> Outputs:
        """Action values, and the terms of the VAE."""
        belief = self.branches(tokens, deterministic)
        q = self.q_head(belief.both).astype(jnp.float32)
        return Outputs(q.reshape(*tokens.segment.shape, -1), belief=belief.terms)

    def step(
        self, state: MemoryState, observation: jax.Array, previous_action: jax.Array
    ) -> tuple[MemoryState, jax.Array]:
        """One token for each of (B,) episodes -> new memory, (B, A) action values."""
        state, samples = self.step_samples(state, observation, previous_action)
        return state, self.q_head(self.read_observation(samples, observation)).astype(jnp.float32)

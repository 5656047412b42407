"""Actors and critics of the memory-based SAC agents (paper Appendix A, Figs. 9, 11, 13, 14).

One convolutional trunk may look at the frames for all of them: then each branch begins with a layer of its own on the
trunk's features, and psi is the trunk with the last layer of every memoryless branch, or the trunk alone.
"""

import abc
import dataclasses
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from envs_mjx.base import ArraySpec
from mijax.config import CriticInput, NetworkConfig
from mijax.nets.belief import BeliefBranches, BeliefReader
from mijax.nets.encoders import Encoder
from mijax.nets.heads import MLP
from mijax.nets.privileged import PrivilegedFeatures
from mijax.nets.two_branch import MemoryState, TwoBranch, own_encoder
from mijax.types import Tokens

LOG_SCALE_LOW, LOG_SCALE_HIGH = -5.0, 2.0
"""Bounds of the log standard deviation of an action before squashing."""
CRITICS = 2


def without_blank(frames: jax.Array, spec: ArraySpec) -> jax.Array:
    """(N, *shape) frames without the channels that are always 0."""
    return frames[..., : spec.shape[-1] - spec.blank] if spec.blank else frames


@struct.dataclass
class BranchHeads:
    """What one memory branch says beside its values: see `mijax.agents.core.Heads`."""

    summary: jax.Array | None = None  # (R, L, W)
    z_s: jax.Array | None = None  # (R, L, F)
    next_summary: jax.Array | None = None  # (R, L, W)
    belief: tuple[jax.Array, ...] | None = None


@struct.dataclass
class Encoded:
    """N = R L tokens as the actor's and the critics' last layers see them."""

    actor: jax.Array  # (N, W)
    critic: jax.Array  # (N, W')
    heads: tuple[BranchHeads, ...]  # of every memory branch


class ActorCritic(nn.Module, abc.ABC):
    """The heads of the actor and of two critics; what they see is up to the subclasses.

    `look` comes first, once for all that follows, then `encode`, then `policy` and `values`.
    """

    action_size: int
    network: NetworkConfig
    observation_spec: ArraySpec
    critic_norm: bool  # whether the critics' hidden layers are normalised

    def setup(self) -> None:
        dtype = jnp.dtype(self.network.dtype)
        self.policy_head = MLP(self.network.actor_hidden, 2 * self.action_size, dtype)
        self.value_heads = [
            MLP(self.network.critic_hidden, 1, dtype, norm=self.critic_norm) for _ in range(CRITICS)]

    def look(self, tokens: Tokens) -> Tokens:
        """The tokens with what `encode` wants in the place of the frames."""
        frames = tokens.frames
        if not isinstance(frames, jax.Array):
            frames = jnp.asarray(frames.frames)[cast(jax.Array, tokens.frame).reshape(-1)]
        return dataclasses.replace(tokens, frames=self.look_at(frames), frame=None)

    def look_at(self, frames: jax.Array) -> jax.Array:
        """(N, *observation_shape) -> what the branches see of them."""
        return without_blank(frames, self.observation_spec)

    @abc.abstractmethod
    def encode(self, tokens: Tokens, deterministic: bool = True) -> Encoded:
        """What the heads see of tokens that `look` has prepared."""

    def policy(self, seen: jax.Array) -> tuple[jax.Array, jax.Array]:
        """(N, W) -> (N, A) mean and log standard deviation of the action before squashing."""
        mean, raw = jnp.split(self.policy_head(seen).astype(jnp.float32), 2, axis=-1)
        return mean, LOG_SCALE_LOW + 0.5 * (LOG_SCALE_HIGH - LOG_SCALE_LOW) * (jnp.tanh(raw) + 1)

    def values(self, seen: jax.Array, action: jax.Array) -> jax.Array:
        """(N, W') and (N, A) -> (2, N) values by both critics."""
        x = jnp.concatenate([seen, action.astype(seen.dtype)], axis=-1)
        return jnp.stack([head(x)[:, 0] for head in self.value_heads]).astype(jnp.float32)

    def __call__(self, tokens: Tokens) -> tuple[Any, ...]:
        """Everything at once, to make parameters."""
        encoded = self.encode(self.look(tokens))
        mean, log_scale = self.policy(encoded.actor)
        return encoded, mean, log_scale, self.values(encoded.critic, mean)

    @abc.abstractmethod
    def initial_state(self, batch: int) -> MemoryState:
        """The memory of `batch` episodes that have not started."""

    @abc.abstractmethod
    def step(
        self, state: MemoryState, observation: jax.Array, previous_action: jax.Array
    ) -> tuple[MemoryState, jax.Array, jax.Array]:
        """One token for each of (B,) episodes -> new memory, and the policy there: (B, A) twice."""


class _WithTrunk(ActorCritic):
    """Looks through a trunk, if it has one."""

    trunk: Encoder | None
    whole: bool  # whether its output layer belongs to the trunk too

    def look_at(self, frames: jax.Array) -> jax.Array:
        """(N, *observation_shape) -> (N, D) the trunk's features, or the frames."""
        seen = without_blank(frames, self.observation_spec)
        if self.trunk is None:
            return seen
        return self.trunk(seen) if self.whole else self.trunk.body(seen)


class TwoBranchActorCritic(_WithTrunk):
    """An actor on two branches over the history, and critics of Q(h, a), Q(s, a) or Q(h, s, a)."""

    actor: TwoBranch
    critic: TwoBranch | None  # None: the critics see the state alone
    critic_sees: CriticInput | None
    state_spec: ArraySpec
    actor_moves_trunk: bool  # whether the actor's losses train the trunk too

    def setup(self) -> None:
        super().setup()
        if self.critic_sees is not None:
            self.state_encoder = own_encoder(self.state_spec, jnp.dtype(self.network.dtype))

    def encode(self, tokens: Tokens, deterministic: bool = True) -> Encoded:
        """Both agents' branches; the actor's losses do not reach the trunk where the critics see what it sees."""
        looked = jnp.asarray(tokens.frames)
        kept = self.trunk is None or self.actor_moves_trunk
        own = looked if kept else jax.lax.stop_gradient(looked)
        actor = self.actor.branches(dataclasses.replace(tokens, frames=own), deterministic)
        branches, parts = [actor], []
        if self.critic is not None:
            critic = self.critic.branches(tokens, deterministic)
            branches, parts = [actor, critic], [critic.both]
        if self.critic_sees is not None:
            state = self.state_encoder(cast(jax.Array, tokens.states))
            parts.append(state.astype(actor.both.dtype))

        def of_tokens(x: jax.Array | None) -> jax.Array | None:
            return None if x is None else x.astype(jnp.float32).reshape(*tokens.segment.shape, -1)

        heads = tuple(
            BranchHeads(of_tokens(b.summary), of_tokens(b.z_s), of_tokens(b.next_summary)) for b in branches)
        return Encoded(actor.both, jnp.concatenate(parts, axis=-1), heads)

    def initial_state(self, batch: int) -> MemoryState:
        """The actor's memory."""
        return self.actor.initial_state(batch)

    def step(
        self, state: MemoryState, observation: jax.Array, previous_action: jax.Array
    ) -> tuple[MemoryState, jax.Array, jax.Array]:
        """As the base class says."""
        state, both = self.actor.step_branches(state, self.look_at(observation), previous_action)
        return state, *self.policy(both)


class BeliefActorCritic(_WithTrunk):
    """Actor and critics on samples of one belief p(z_s | h), each with a reader of their own.

    The belief is trained by the critics' loss and its own, the actor's reader by the actor's.
    """

    actor: BeliefReader
    history: BeliefBranches  # with the critics' reader

    def encode(self, tokens: Tokens, deterministic: bool = True) -> Encoded:
        """The belief, from which, as from the trunk, the actor's gradient is kept."""
        belief = self.history.branches(tokens, deterministic)
        seen, samples = jax.lax.stop_gradient((tokens.frames, belief.samples))
        own = self.actor.read_tokens(samples, dataclasses.replace(tokens, frames=seen))
        return Encoded(own, belief.both, (BranchHeads(belief=belief.terms),))

    def initial_state(self, batch: int) -> MemoryState:
        """The shared memory."""
        return self.history.initial_state(batch)

    def step(
        self, state: MemoryState, observation: jax.Array, previous_action: jax.Array
    ) -> tuple[MemoryState, jax.Array, jax.Array]:
        """As the base class says."""
        looked = self.look_at(observation)
        state, samples = self.history.step_samples(state, looked, previous_action)
        return state, *self.policy(self.actor.read_observation(samples, looked))


class PrivilegedActorCritic(ActorCritic):
    """Actor and critics on z_s, z_s + z_o or s, without a memory: the overlap test (Fig. 29)."""

    features: PrivilegedFeatures

    def encode(self, tokens: Tokens, deterministic: bool = True) -> Encoded:
        """Features of the state; those of an encoder of its own are trained by the critics."""
        del deterministic
        seen = self.features.see(jnp.asarray(tokens.frames))
        return Encoded(jax.lax.stop_gradient(seen), seen, ())

    def initial_state(self, batch: int) -> MemoryState:
        """No memory but the time."""
        return MemoryState(jnp.zeros((batch,), jnp.int32), ())

    def step(
        self, state: MemoryState, observation: jax.Array, previous_action: jax.Array
    ) -> tuple[MemoryState, jax.Array, jax.Array]:
        """As the base class says."""
        del previous_action
        return MemoryState(state.position + 1, ()), *self.policy(self.features.see(self.look_at(observation)))

"""Networks of the memoryless agent that sees the state: of z_s, z_s + z_o, or s (paper Fig. 4, Fig. 29)."""

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from envs_mjx.base import ArraySpec
from mijax.config import NetworkConfig, PrivilegedInput
from mijax.nets.encoders import encoder_for
from mijax.nets.heads import MLP
from mijax.nets.two_branch import MemoryState, Outputs
from mijax.types import Tokens


class PrivilegedFeatures(nn.Module):
    """z_s, z_s + z_o (frozen features of stage 1) or features of s (an encoder of its own)."""

    state_spec: ArraySpec
    observation_spec: ArraySpec  # the state's entries, then the observation's, along the last axis
    features: int
    sees: PrivilegedInput

    def setup(self) -> None:
        self.phi = encoder_for(self.state_spec, self.features)
        own = (*self.observation_spec.shape[:-1], self.observation_spec.shape[-1] - self.state_spec.shape[-1])
        self.psi = encoder_for(dataclasses.replace(self.observation_spec, shape=own), self.features)

    def see(self, both: jax.Array) -> jax.Array:
        """(N, *observation_shape) -> (N, F) or (N, 2 F)"""
        state, observation = jnp.split(both, [self.state_spec.shape[-1]], axis=-1)
        z_s, z_o = self.phi(state), self.psi(observation)
        if self.sees == "state":
            return z_s
        return jax.lax.stop_gradient(z_s if self.sees == "z_s" else jnp.concatenate([z_s, z_o], axis=-1))


class PrivilegedQ(PrivilegedFeatures):
    """Q(x, a) of those features."""

    num_actions: int
    network: NetworkConfig

    def setup(self) -> None:
        super().setup()
        self.q_head = MLP(self.network.critic_hidden, self.num_actions, jnp.dtype(self.network.dtype))

    def _values(self, both: jax.Array) -> jax.Array:
        return self.q_head(self.see(both)).astype(jnp.float32)

    def __call__(self, tokens: Tokens, deterministic: bool = True) -> Outputs:
        """Action values at every token."""
        del deterministic
        q = self._values(jnp.asarray(tokens.frames))
        return Outputs(q.reshape(*tokens.segment.shape, self.num_actions))

    def initial_state(self, batch: int) -> MemoryState:
        """No memory but the time."""
        return MemoryState(jnp.zeros((batch,), jnp.int32), ())

    def step(self, state: MemoryState, observation: jax.Array, previous_action: Any) -> tuple[MemoryState, jax.Array]:
        """(B, A) action values of (B,) states."""
        del previous_action
        return MemoryState(state.position + 1, ()), self._values(observation)

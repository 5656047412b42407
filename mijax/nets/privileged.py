"""The memoryless agent that sees the state: what can be done with z_s, z_s + z_o, or s (paper Fig. 4, Fig. 29)."""

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from envs_mjx.base import ArraySpec, Demonstrations, Environment, EnvState, TimeStep
from mijax.config import ConfigError, NetworkConfig, PrivilegedInput
from mijax.nets.encoders import encoder_for
from mijax.nets.heads import MLP
from mijax.nets.two_branch import MemoryState, Outputs
from mijax.types import Tokens


class StateShown(Environment):
    """An environment whose observation is the true state beside the observation, along the last axis."""

    def __init__(self, env: Environment) -> None:
        state, observation = env.state_spec, env.observation_spec
        if state.shape[:-1] != observation.shape[:-1] or state.dtype != observation.dtype:
            raise ConfigError(f"--agent: got 'mdp', accepted: any other, as {env.name}'s states {state.shape} and "
                              f"observations {observation.shape} cannot be laid side by side")
        self._env = env
        self.name, self.horizon, self.action_spec = env.name, env.horizon, env.action_spec
        self.state_spec, self.variables = state, env.variables
        self.observation_spec = dataclasses.replace(
            observation, shape=(*state.shape[:-1], state.shape[-1] + observation.shape[-1]))

    def reset(self, key: jax.Array) -> tuple[EnvState, TimeStep]:
        """As the environment does."""
        return self._show(*self._env.reset(key))

    def step(self, key: jax.Array, env_state: EnvState, action: jax.Array) -> tuple[EnvState, TimeStep]:
        """As the environment does."""
        return self._show(*self._env.step(key, env_state, action))

    def success(self, timestep: TimeStep) -> jax.Array:
        """As the environment does."""
        return self._env.success(timestep)

    def ground_truth(self, env_state: EnvState) -> jax.Array:
        """As the environment does."""
        return self._env.ground_truth(env_state)

    def reveals(self, env_state: EnvState) -> jax.Array:
        """As the environment does."""
        return self._env.reveals(env_state)

    def show(self, env_state: EnvState) -> TimeStep:
        """As the environment does."""
        return self._show(env_state, self._env.show(env_state))[1]

    def demonstrations(self, key: jax.Array, number: int) -> Demonstrations | None:
        """As the environment does."""
        return self._env.demonstrations(key, number)

    def augment(self, key: jax.Array, env_state: EnvState, action: jax.Array) -> tuple[EnvState, jax.Array]:
        """As the environment does."""
        return self._env.augment(key, env_state, action)

    @staticmethod
    def _show(env_state: EnvState, timestep: TimeStep) -> tuple[EnvState, TimeStep]:
        both = jnp.concatenate([timestep.state, timestep.observation], axis=-1)
        return env_state, timestep.replace(observation=both)  # pyright: ignore[reportAttributeAccessIssue]


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

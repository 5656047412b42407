"""What the memoryless agent `mdp` acts in: a domain that shows its state (paper Fig. 4, Fig. 29)."""

import dataclasses

import jax
import jax.numpy as jnp

from envs_mjx.base import Demonstrations, Environment, EnvState, TimeStep
from mijax.config import ConfigError


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
        """The environment's, with the state shown; so is every method below."""
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

"""Does an agent need what it remembers? It is played with its memory cut to the last steps."""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from mijax.agents.core import Agent
from mijax.nets.two_branch import MemoryState
from mijax.types import Params


@struct.dataclass
class Window:
    """The last K steps of (B,) episodes that run side by side, the newest at the end."""

    observation: jax.Array  # (B, K, *observation_shape)
    previous_action: jax.Array  # (B, K) or (B, K, A)
    count: jax.Array  # () int32, steps so far


@dataclasses.dataclass(frozen=True)
class Forgetful:
    """Acts as an agent does, at every step as if the episode had begun `steps` steps ago."""

    agent: Agent
    steps: int

    def no_action(self, batch: int) -> jax.Array:
        """The agent's."""
        return self.agent.no_action(batch)

    def initial_memory(self, batch: int) -> Window:
        """Nothing seen yet."""
        spec, none = self.agent.env.observation_spec, self.agent.no_action(batch)
        return Window(
            jnp.zeros((batch, self.steps, *spec.shape), spec.dtype), jnp.stack([none] * self.steps, axis=1),
            jnp.zeros((), jnp.int32))

    def act(
        self, params: Params, memory: Window, observation: jax.Array, previous_action: jax.Array
    ) -> tuple[Window, jax.Array]:
        """As `Agent.act`, from an empty memory that reads the window anew."""

        def shift(old: jax.Array, new: jax.Array) -> jax.Array:
            return jnp.concatenate([old[:, 1:], new[:, None]], axis=1)

        window = Window(shift(memory.observation, observation), shift(memory.previous_action, previous_action),
                        memory.count + 1)
        first, fresh = self.steps - jnp.minimum(window.count, self.steps), self.agent.initial_memory(len(observation))
        action, state, none = previous_action, fresh, self.agent.no_action(len(observation))
        for step in range(self.steps):
            state = jax.tree.map(lambda new, old, step=step: jnp.where(step <= first, new, old), fresh, state)
            previous = jnp.where(step <= first, none, window.previous_action[:, step])
            state, action = self.agent.act(params, state, window.observation[:, step], previous)
        return window, action

    def value(
        self, params: Params, memory: Window, observation: jax.Array, previous_action: jax.Array
    ) -> jax.Array:
        """The agent's, which has seen nothing before the first observation either."""
        del memory
        fresh: MemoryState = self.agent.initial_memory(len(observation))
        return self.agent.value(params, fresh, observation, previous_action)

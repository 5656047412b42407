"""A task with continuous actions, a memory, a symmetry and an expert, small enough to be learnt in a test."""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from envs_mjx.base import ArraySpec, ContinuousActions, Demonstrations, Environment, TimeStep


@struct.dataclass
class CompassState:
    """A moment of `Compass`."""

    cue: jax.Array  # (2,) of length 1
    time: jax.Array  # () int32
    rewarded: jax.Array  # () bool


class Compass(Environment):
    """A direction is seen at the start; after two empty steps the action must point there: +1 if it does, else 0.

    Observation (4,): the direction at time 0 and zeros later, the time, and whether the episode is over. State (3,):
    the direction and the time. Without memory nothing beats a guess: the action must be within 45 degrees, so 0.25.
    Turning the world changes nothing.
    """

    name, horizon, choice = "compass", 4, 2
    observation_spec, state_spec, action_spec = ArraySpec((4,)), ArraySpec((3,)), ContinuousActions(2)

    def reset(self, key: jax.Array) -> tuple[CompassState, TimeStep]:
        angle = jax.random.uniform(key, (), jnp.float32, 0.0, 2 * jnp.pi)
        cue = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        env_state = CompassState(cue, jnp.zeros((), jnp.int32), jnp.zeros((), bool))
        return env_state, self.show(env_state)

    def step(self, key: jax.Array, env_state: CompassState, action: jax.Array) -> tuple[CompassState, TimeStep]:
        del key
        length = jnp.maximum(jnp.linalg.norm(action), 1e-6)
        pointed = (env_state.time == self.choice) & (jnp.dot(action, env_state.cue) > 0.7071 * length)
        env_state = CompassState(env_state.cue, env_state.time + 1, pointed)
        return env_state, self.show(env_state)

    def show(self, env_state: CompassState) -> TimeStep:
        time, over = env_state.time.astype(jnp.float32), env_state.time > self.choice
        seen = jnp.where(env_state.time == 0, env_state.cue, 0)
        return TimeStep(
            observation=jnp.concatenate([seen, time[None] / self.horizon, over.astype(jnp.float32)[None]]),
            state=jnp.concatenate([env_state.cue, time[None]]), reward=env_state.rewarded.astype(jnp.float32),
            terminated=over, truncated=jnp.zeros((), bool))

    def demonstrations(self, key: jax.Array, number: int) -> Demonstrations:
        def play(key: jax.Array) -> Demonstrations:
            first, _ = self.reset(key)

            def step(env_state: CompassState, _: None) -> tuple[CompassState, CompassState]:
                later = self.step(key, env_state, 0.8 * first.cue)[0]
                return later, later

            _, later = jax.lax.scan(step, first, None, self.horizon)
            states = jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), first, later)
            action = jnp.broadcast_to(0.8 * first.cue[None], (self.horizon, 2))
            return Demonstrations(states, action, jnp.int32(self.choice + 1), jnp.ones((), bool))

        return jax.vmap(play)(jax.random.split(key, number))

    def augment(self, key: jax.Array, env_state: CompassState, action: jax.Array) -> tuple[CompassState, jax.Array]:
        angle = jax.random.uniform(key, (), jnp.float32, 0.0, 2 * jnp.pi)
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        turn = jnp.stack([jnp.stack([cos, -sin]), jnp.stack([sin, cos])])
        return dataclasses.replace(env_state, cue=turn @ env_state.cue), turn @ action

"""A gymnax environment as one of ours.

gymnax resets within `step` and has one observation; here episodes end without a reset, and the environment's own state
is the privileged one.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments import spaces
from gymnax.environments.environment import Environment as GymnaxEnvironment
from gymnax.environments.environment import EnvParams

from envs_mjx.base import ActionSpec, ArraySpec, ContinuousActions, DiscreteActions, Environment, TimeStep, Variable


class FromGymnax(Environment):
    """A gymnax environment, bare, whose observation is an array.

    The state is what gymnax' state holds, flattened: (n,) float32, its fields in order. An observation that is neither
    a vector nor an image is flattened, too. Continuous actions in [-1, 1] are stretched to the environment's own
    bounds.
    """

    def __init__(
        self, env: GymnaxEnvironment, params: EnvParams | None = None, *, horizon: int | None = None,
        fields: Sequence[str] | None = None, hidden: Sequence[str] = (),
    ) -> None:
        """Args:
            env: as `gymnax.make` returns it, first part.
            params: its second part; None: the environment's defaults.
            horizon: time limit in steps; None: the one of `params`.
            fields: of gymnax' state that make up ours, e.g. without counters for logs; None: all of them.
            hidden: those of them that an observation usually does not show: what stage 1's probe looks for in z_s.

        Raises:
            ValueError: a wrapper, no such field, an observation that is no array, no time limit, or actions of another
                kind.
        """
        if not isinstance(env, GymnaxEnvironment):  # wrappers change `reset` and `step` alone, which are not used here
            raise ValueError(f"env: {type(env).__name__} is no environment of gymnax but may wrap one, accepted: what "
                             "gymnax.make returns; what a wrapper changes belongs in a subclass of FromGymnax")
        self._gymnax, self._params = env, env.default_params if params is None else params
        limit = getattr(self._params, "max_steps_in_episode", None) if horizon is None else horizon
        if limit is None:
            raise ValueError(f"horizon: {env.name} has no time limit of its own, accepted: a number of steps")
        self.name, self.horizon = env.name, int(limit)
        shown, inner = jax.eval_shape(env.reset_env, jax.random.key(0), self._params)
        if not isinstance(shown, jax.ShapeDtypeStruct):
            raise ValueError(f"{env.name}: its observation is a tree of arrays, accepted: one array")
        names = tuple(field.name for field in dataclasses.fields(inner))
        self._fields = names if fields is None else tuple(fields)
        unknown = [name for name in (*self._fields, *hidden) if name not in names]
        if unknown:
            raise ValueError(f"{env.name}: its state has no field {unknown[0]!r}, accepted: {', '.join(names)}")
        sizes = {name: int(np.prod(getattr(inner, name).shape)) for name in self._fields}
        shape = shown.shape if len(shown.shape) in (1, 3) else (int(np.prod(shown.shape)),)
        self.observation_spec = ArraySpec(shape, shown.dtype)
        self.state_spec = ArraySpec((sum(sizes.values()),))
        self.action_spec = self._actions(env.action_space(self._params))
        self.variables = tuple(
            Variable(name if size == 1 else f"{name}[{i}]", hidden=name in hidden)
            for name, size in sizes.items() for i in range(size))

    def _actions(self, space: Any) -> ActionSpec:
        self._low, self._high = np.float32(-1), np.float32(1)
        if isinstance(space, spaces.Discrete):
            return DiscreteActions(int(space.n))
        if isinstance(space, spaces.Box) and len(space.shape) == 1:
            self._low, self._high = (np.broadcast_to(np.asarray(x, np.float32), space.shape)
                                     for x in (space.low, space.high))
            if np.isfinite([self._low, self._high]).all():
                return ContinuousActions(int(space.shape[0]))
        raise ValueError(f"{self.name}: its actions are {type(space).__name__}, accepted: Discrete, or a flat Box with "
                         "bounds")

    def reset(self, key: jax.Array) -> tuple[Any, TimeStep]:
        """As gymnax resets."""
        observation, state = self._gymnax.reset_env(key, self._params)
        start = (jax.tree.map(jnp.asarray, state), jnp.zeros((), jnp.int32))
        return start, self._show(start, observation, jnp.zeros(()), jnp.zeros((), bool))

    def step(self, key: jax.Array, env_state: Any, action: jax.Array) -> tuple[Any, TimeStep]:
        """As gymnax steps, without its reset."""
        before, time = env_state
        if isinstance(self.action_spec, ContinuousActions):
            action = jnp.asarray(self._low + 0.5 * (action + 1) * (self._high - self._low))
        observation, state, reward, terminated, _ = self._gymnax.step_env(key, before, action, self._params)
        state = jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), state, before)
        after = (state, time + 1)
        return after, self._show(after, observation, jnp.float32(reward), jnp.asarray(terminated, bool))

    def ground_truth(self, env_state: Any) -> jax.Array:
        """(n,) float32: the state's fields, flattened."""
        state = env_state[0]
        return jnp.concatenate([jnp.ravel(getattr(state, name)).astype(jnp.float32) for name in self._fields])

    def _show(self, env_state: Any, observation: jax.Array, reward: jax.Array, terminated: jax.Array) -> TimeStep:
        state, time = env_state
        out_of_time = (time >= self.horizon) | self._gymnax.is_truncated(state, self._params)
        return TimeStep(
            observation=jnp.asarray(observation, self.observation_spec.dtype).reshape(self.observation_spec.shape),
            state=self.ground_truth(env_state), reward=reward, terminated=terminated,
            truncated=out_of_time & ~terminated)

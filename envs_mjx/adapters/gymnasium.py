"""Any of our environments as a Gymnasium one: `AsGymnasium("heaven_hell")`."""

from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium import spaces

from envs_mjx import registry
from envs_mjx.base import ArraySpec, DiscreteActions, Environment


class AsGymnasium(gymnasium.Env):
    """One environment, stepped from the host; its compiled functions are shared by all instances of a domain.

    `info` holds the privileged `state`, and `success` once an episode has ended. The time limit is reported as
    `truncated`, so no wrapper is needed. For speed step our environments inside `jax.vmap` instead: here every step
    is a call from the host.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  (Gymnasium's own convention)

    def __init__(self, domain: str | Environment) -> None:
        """Args:
            domain: a registered name, `package.module:EnvClass`, or an environment.
        """
        self._env = registry.make(domain) if isinstance(domain, str) else domain
        self.observation_space = _space(self._env.observation_spec)
        spec = self._env.action_spec
        self.action_space = (spaces.Discrete(spec.num) if isinstance(spec, DiscreteActions)
                             else spaces.Box(-1.0, 1.0, (spec.size,), np.float32))
        self.state_space = _space(self._env.state_spec)
        self._reset, self._step, self._success = (
            jax.jit(function) for function in (self._env.reset, self._env.step, self._env.success))
        self._key = jax.random.key(0)
        self._state: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Start an episode; the same seed starts the same sequence of episodes."""
        super().reset(seed=seed)
        if seed is not None or self._state is None:
            self._key = jax.random.key(self.np_random.integers(2**31) if seed is None else seed)
        self._state, timestep = self._reset(self._next_key())
        return np.asarray(timestep.observation), {"state": np.asarray(timestep.state)}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        """One step."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("step: call reset first")
        self._state, timestep = self._step(self._next_key(), self._state, np.asarray(action, self.action_space.dtype))
        info: dict[str, Any] = {"state": np.asarray(timestep.state)}
        terminated, truncated = bool(timestep.terminated), bool(timestep.truncated)
        if terminated or truncated:
            info["success"] = bool(self._success(timestep))
        return np.asarray(timestep.observation), float(timestep.reward), terminated, truncated, info

    def _next_key(self) -> jax.Array:
        self._key, key = jax.random.split(self._key)
        return key


def _space(spec: ArraySpec) -> spaces.Box:
    """All that an array of this shape and type can hold."""
    dtype = np.dtype(spec.dtype)
    if np.issubdtype(dtype, np.integer):
        return spaces.Box(np.iinfo(dtype).min, np.iinfo(dtype).max, spec.shape, dtype.type)
    return spaces.Box(-np.inf, np.inf, spec.shape, dtype.type)

"""Demonstrations by an environment's expert, all of them successful."""

import functools

import jax
import numpy as np

from envs_mjx.base import Demonstrations, Environment
from mijax.config import ConfigError


def demonstrate(env: Environment, key: jax.Array, number: int) -> Demonstrations:
    """`number` successful episodes, N = `number` in the shapes of `Demonstrations`.

    Raises:
        ConfigError: the environment has no expert, or its expert fails too often.
    """
    episodes = _play(env, key, number)
    if episodes is None:
        raise ConfigError(f"--domain: {env.name} has no expert to demonstrate it")
    failures = int(np.sum(~np.asarray(episodes.success)))
    if failures:
        raise ConfigError(f"--domain: the expert of {env.name} solved {number - failures} of {number} episodes; each "
                          "demonstration has to be a success")
    return episodes


@functools.partial(jax.jit, static_argnums=(0, 2))
def _play(env: Environment, key: jax.Array, number: int) -> Demonstrations | None:
    return env.demonstrations(key, number)

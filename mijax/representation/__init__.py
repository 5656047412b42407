"""Stage 1: features of the state and of the observation that do not overlap (paper Section 3.1)."""

import jax

from envs_mjx.base import Environment
from mijax.representation.model import evaluate, networks_for
from mijax.representation.train import DivergenceError, History, learn_representation
from mijax.types import Representation

__all__ = ["DivergenceError", "History", "encode_observation", "encode_state", "learn_representation"]


def encode_state(representation: Representation, env: Environment, states: jax.Array) -> jax.Array:
    """z_s = phi(s): (..., *state_shape) -> (..., F)."""
    encoder = networks_for(env, representation.z_s_mean.shape[-1]).phi
    return evaluate(encoder, representation.phi, states)


def encode_observation(representation: Representation, env: Environment, observations: jax.Array) -> jax.Array:
    """z_o = psi(o): (..., *observation_shape) -> (..., F)."""
    encoder = networks_for(env, representation.z_s_mean.shape[-1]).psi
    return evaluate(encoder, representation.psi, observations)

"""The networks of stage 1 (paper Figs. 23 to 28): phi, psi, the dynamics model, the discriminators and CLUB's q."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from envs_mjx.base import ActionSpec, ArraySpec, DiscreteActions, Environment
from mijax.config import LowerBound
from mijax.frames import Frames
from mijax.nets.encoders import Encoder, about_mean, encoder_for
from mijax.types import Params

ACTION_WIDTH = 16
DYNAMICS_HIDDEN = (256, 256, 256)
ESTIMATOR_HIDDEN = 32
DECODER_HIDDEN = (256, 256)
DRAWN_CELLS = 24
"""A decoder draws at most so many rows of cells, each the mean of its pixels: 21 of an image of 84 rows."""


class Dynamics(nn.Module):
    """g(z_s, z_o, a) -> reward, next z_s, next z_o (Fig. 23): features and embedded action are concatenated."""

    features: int

    @nn.compact
    def __call__(self, z_s: jax.Array, z_o: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        h = jnp.concatenate([z_s, z_o, nn.Dense(ACTION_WIDTH, name="action_encoder")(action)], axis=-1)
        for width in DYNAMICS_HIDDEN:
            h = nn.relu(nn.Dense(width)(h))
        reward = nn.Dense(1, name="reward")(h)[..., 0]
        return reward, nn.Dense(self.features, name="next_z_s")(h), nn.Dense(self.features, name="next_z_o")(h)


class Estimator(nn.Module):
    """CLUB's q(z_o | z_s): mean and log-variance of a diagonal Gaussian (Appendix C.3.1)."""

    features: int

    @nn.compact
    def __call__(self, z_s: jax.Array) -> tuple[jax.Array, jax.Array]:
        mean = nn.Dense(self.features)(nn.relu(nn.Dense(ESTIMATOR_HIDDEN)(z_s)))
        log_variance = nn.tanh(nn.Dense(self.features)(nn.relu(nn.Dense(ESTIMATOR_HIDDEN)(z_s))))
        return mean, log_variance


class Decoder(nn.Module):
    """(B, F) features -> (B, D): a frame as `drawn` has it."""

    size: int

    @nn.compact
    def __call__(self, z: jax.Array) -> jax.Array:
        for width in DECODER_HIDDEN:
            z = nn.relu(nn.Dense(width)(z))
        return nn.Dense(self.size)(z)


def drawn(frames: jax.Array, spec: ArraySpec) -> jax.Array:
    """(B, D) float32, what a decoder is to draw of (B, *shape) frames.

    Vectors as they are. Images without their blank channels, as an encoder sees them, in cells of equally many pixels.
    """
    x = frames.astype(jnp.float32)
    if not spec.is_image:
        return x
    rows, columns, channels = spec.shape
    side = -(-max(rows, columns) // DRAWN_CELLS)
    x = x[:, : rows // side * side, : columns // side * side, : channels - spec.blank]
    x = about_mean(x, spec.contrast) if spec.contrast > 0 else x
    return jnp.mean(x.reshape(-1, rows // side, side, columns // side, side, x.shape[-1]), axis=(2, 4)).reshape(
        x.shape[0], -1)


@dataclasses.dataclass(frozen=True)
class Networks:
    """All modules of stage 1 for one environment."""

    phi: Encoder
    psi: Encoder
    dynamics: Dynamics
    estimator: Estimator
    action_spec: ActionSpec
    observation_spec: ArraySpec

    def draw(self, decoder: Params, z_o: jax.Array, observations: jax.Array) -> tuple[jax.Array, jax.Array]:
        """(B, D) what a decoder draws of (B, F) features, and what it should have drawn of (B, *shape) observations."""
        target = drawn(observations, self.observation_spec)
        return evaluate(Decoder(target.shape[1]), decoder, z_o), target

    def encode_action(self, action: jax.Array) -> jax.Array:
        """(..., A) float32: discrete actions one-hot, continuous ones as they are."""
        if isinstance(self.action_spec, DiscreteActions):
            return jax.nn.one_hot(action, self.action_spec.num, dtype=jnp.float32)
        return action

    def action_like(self, size: int) -> jax.Array:
        """(size, A) float32 zeros, in the shape of encoded actions."""
        spec = self.action_spec
        return jnp.zeros((size, spec.num if isinstance(spec, DiscreteActions) else spec.size), jnp.float32)


def evaluate(module: nn.Module, parameters: Params, *inputs: Frames, method: str | None = None) -> Any:
    """What the module gives; Flax types it as possibly a tuple with mutated variables, which these never return."""
    return module.apply({"params": parameters}, *inputs, method=method)


def local_features(encoder: Encoder, parameters: Params, discriminator: Params, x: Frames) -> jax.Array:
    """z^l of Fig. 28, (..., F): the discriminator's own layers on top of the encoder's first block."""
    return evaluate(encoder, discriminator, evaluate(encoder, parameters, x, method="first_block"), method="finish")


def networks_for(env: Environment, features: int) -> Networks:
    """The modules whose shapes follow from an environment's specs."""
    return Networks(
        phi=encoder_for(env.state_spec, features), psi=encoder_for(env.observation_spec, features),
        dynamics=Dynamics(features), estimator=Estimator(features), action_spec=env.action_spec,
        observation_spec=env.observation_spec)


def init_parameters(
    networks: Networks, key: jax.Array, state: jax.Array, observation: jax.Array, *,
    lower_bound: LowerBound = "jensen_shannon"
) -> dict[str, Params]:
    """Fresh parameters of all networks, by the names that `train` uses; both arrays have a leading axis.

    Under `lower_bound` "reconstruction" a decoder is in the place of the observations' discriminator.
    """
    keys = jax.random.split(key, 6)
    z = jnp.zeros((1, networks.phi.features), jnp.float32)

    def discriminator(encoder: Encoder, parameters: Params, init_key: jax.Array, x: jax.Array) -> Params:
        h = evaluate(encoder, parameters, x, method="first_block")
        return encoder.init(init_key, h, method="finish")["params"]

    phi = networks.phi.init(keys[0], state)["params"]
    psi = networks.psi.init(keys[1], observation)["params"]
    if lower_bound == "reconstruction":
        of_o = Decoder(drawn(observation, networks.observation_spec).shape[1]).init(keys[3], z)["params"]
    else:
        of_o = discriminator(networks.psi, psi, keys[3], observation)
    return {
        "phi": phi,
        "psi": psi,
        "discriminator_s": discriminator(networks.phi, phi, keys[2], state),
        "discriminator_o": of_o,
        "dynamics": networks.dynamics.init(keys[4], z, z, networks.action_like(1))["params"],
        "estimator": networks.estimator.init(keys[5], z)["params"],
    }

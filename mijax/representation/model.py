"""The networks of stage 1 (paper Figs. 23 to 28): phi, psi, the dynamics model, the discriminators and CLUB's q."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from envs_mjx.base import ActionSpec, DiscreteActions, Environment, Variable
from mijax.config import LowerBound
from mijax.frames import Frames
from mijax.nets.encoders import Encoder, encoder_for
from mijax.types import Params

ACTION_WIDTH = 16
DYNAMICS_HIDDEN = (256, 256, 256)
ESTIMATOR_HIDDEN = 32


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


@dataclasses.dataclass(frozen=True)
class Networks:
    """All modules of stage 1 for one environment."""

    phi: Encoder
    psi: Encoder
    dynamics: Dynamics
    estimator: Estimator
    action_spec: ActionSpec
    seen: tuple[Variable, ...]
    """The variables that are not hidden."""

    @property
    def told(self) -> nn.Dense:
        """(B, F) z_o -> (B, W) guesses of what can be seen of the variables, for `variables_loss`."""
        return nn.Dense(sum(variable.num_values or 1 for variable in self.seen))

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
        seen=tuple(variable for variable in env.variables if not variable.hidden))


def init_parameters(
    networks: Networks, key: jax.Array, state: jax.Array, observation: jax.Array, *,
    lower_bound: LowerBound = "jensen_shannon"
) -> dict[str, Params]:
    """Fresh parameters of all networks, by the names that `train` uses; both arrays have a leading axis.

    Under `lower_bound` "variables" what tells them is in the place of the observations' discriminator.
    """
    keys = jax.random.split(key, 6)
    z = jnp.zeros((1, networks.phi.features), jnp.float32)

    def discriminator(encoder: Encoder, parameters: Params, init_key: jax.Array, x: jax.Array) -> Params:
        h = evaluate(encoder, parameters, x, method="first_block")
        return encoder.init(init_key, h, method="finish")["params"]

    phi = networks.phi.init(keys[0], state)["params"]
    psi = networks.psi.init(keys[1], observation)["params"]
    if lower_bound == "variables":
        of_o = networks.told.init(keys[3], z)["params"]
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

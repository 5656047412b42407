"""Dropout from eight random bits an entry.

JAX hashes 32 of them for each. Four entries from one hash take a third of the time by themselves, but an update takes
as long (Heaven-Hell at the paper's sizes: 82 and 87 ms, against 85 and 85), so that the plain way stays.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp


class Dropout(nn.Module):
    """Zero each entry with probability `rate`, rounded to 1/256, and scale the others up."""

    rate: float

    @nn.compact
    def __call__(self, x: jax.Array, deterministic: bool) -> jax.Array:
        dropped = round(self.rate * 256)
        if deterministic or dropped == 0:
            return x
        keep = jax.random.bits(self.make_rng("dropout"), x.shape, jnp.uint8) >= dropped
        return jnp.where(keep, x * (256 / (256 - dropped)), 0)

"""A smallest environment of one's own: a corridor with a signpost at one end and a fork at the other.

    python -m mijax.train --domain examples.signpost:Signpost --steps 40000
"""

import jax
import jax.numpy as jnp
from flax import struct

from envs_mjx.base import ArraySpec, DiscreteActions, Environment, TimeStep, Variable

END = 6
START = 2


@struct.dataclass
class SignpostState:
    """Everything the corridor remembers."""

    place: jax.Array  # () int32, 0 is the signpost, END the fork
    side: jax.Array  # () int32, the hidden variable: 0 or 1, the branch with the reward
    time: jax.Array  # () int32, steps since the reset


class Signpost(Environment):
    """Walk left to read the sign, then right to the fork, and turn as it said: +1 if right, -1 if wrong.

    Actions: 0 left, 1 right, 2 and 3 the two branches, which only count at the fork and end the episode. Observation
    (2,): place / END, and the side as -1 or +1 at the signpost, 0 elsewhere. State (2,): the same with the side always.
    Best: 2 steps to the sign, 6 to the fork, 1 to turn.
    """

    name = "signpost"
    horizon = 30
    observation_spec = ArraySpec((2,))
    state_spec = ArraySpec((2,))
    action_spec = DiscreteActions(4, ("left", "right", "turn 0", "turn 1"))
    variables = (Variable("side", hidden=True, num_values=2), Variable("place", hidden=False))

    def reset(self, key: jax.Array) -> tuple[SignpostState, TimeStep]:
        """Draw the side; every episode starts at the same place."""
        side = jax.random.randint(key, (), 0, 2, jnp.int32)
        start = SignpostState(jnp.int32(START), side, jnp.int32(0))
        return start, self._show(start, jnp.float32(0), jnp.zeros((), bool))

    def step(self, key: jax.Array, env_state: SignpostState, action: jax.Array) -> tuple[SignpostState, TimeStep]:
        """Walk or turn; nothing is random, so the key is not used."""
        del key
        turns = (env_state.place == END) & (action >= 2)
        reward = jnp.where(action - 2 == env_state.side, 1.0, -1.0)
        move = jnp.array([-1, 1, 0, 0], jnp.int32)[action]
        place = jnp.clip(env_state.place + move, 0, END)
        after = SignpostState(place, env_state.side, env_state.time + 1)
        return after, self._show(after, jnp.where(turns, reward, 0.0), turns)

    def ground_truth(self, env_state: SignpostState) -> jax.Array:
        """(2,) float32: side and place, which the probe of stage 1 tries to decode."""
        return jnp.stack([env_state.side, env_state.place]).astype(jnp.float32)

    def reveals(self, env_state: SignpostState) -> jax.Array:
        """() bool: whether the sign can be read here."""
        return env_state.place == 0

    def _show(self, env_state: SignpostState, reward: jax.Array, terminated: jax.Array) -> TimeStep:
        place = env_state.place.astype(jnp.float32) / END
        side = jnp.where(env_state.side == 1, 1.0, -1.0)
        return TimeStep(
            observation=jnp.stack([place, jnp.where(self.reveals(env_state), side, 0.0)]),
            state=jnp.stack([place, side]),
            reward=reward,
            terminated=terminated,
            truncated=(env_state.time >= self.horizon) & ~terminated,
        )

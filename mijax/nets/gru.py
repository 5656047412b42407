"""A gated recurrent unit over packed episodes (paper Appendix A.7), behind the same interface as the GPT."""

import flax.linen as nn
import jax
import jax.numpy as jnp


class GRU(nn.Module):
    """Summary of a history: one recurrent layer, its hidden state set to zero where an episode starts."""

    width: int
    dtype: jnp.dtype = jnp.float32

    def setup(self) -> None:
        self.from_input = nn.Dense(3 * self.width, dtype=self.dtype)
        orthogonal = nn.initializers.orthogonal()
        self.from_hidden = nn.Dense(3 * self.width, kernel_init=orthogonal, dtype=self.dtype)

    def _cell(self, hidden: jax.Array, inputs: jax.Array) -> jax.Array:
        """(B, W) hidden and (B, 3 W) projected input -> (B, W)."""
        reset_x, update_x, new_x = jnp.split(inputs, 3, axis=-1)
        reset_h, update_h, new_h = jnp.split(self.from_hidden(hidden), 3, axis=-1)
        reset, update = nn.sigmoid(reset_x + reset_h), nn.sigmoid(update_x + update_h)
        return (1 - update) * jnp.tanh(new_x + reset * new_h) + update * hidden

    def __call__(
        self, x: jax.Array, segment: jax.Array, position: jax.Array, deterministic: bool = True
    ) -> jax.Array:
        """(R L, D) tokens with (R, L) segment and position -> (R L, W) history summaries."""
        del segment, deterministic
        inputs = self.from_input(x).reshape(*position.shape, -1)
        starts = (position == 0)[..., None]

        def advance(cell: "GRU", hidden: jax.Array, token: tuple[jax.Array, jax.Array]):
            projected, start = token
            hidden = cell._cell(jnp.where(start, 0, hidden), projected)
            return hidden, hidden

        scan = nn.scan(advance, variable_broadcast="params", split_rngs={"params": False}, in_axes=1, out_axes=1)
        _, out = scan(self, self.initial_state(position.shape[0]), (inputs, starts))
        return out.reshape(-1, self.width)

    def initial_state(self, batch: int) -> jax.Array:
        """(batch, W) the empty memory of `batch` new episodes."""
        return jnp.zeros((batch, self.width), self.dtype)

    def step(self, state: jax.Array, x: jax.Array, position: jax.Array) -> tuple[jax.Array, jax.Array]:
        """One token per episode: (B, D) -> new memory, (B, W) history summaries."""
        del position
        hidden = self._cell(state, self.from_input(x))
        return hidden, hidden

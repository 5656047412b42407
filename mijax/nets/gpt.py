"""A small GPT over packed episodes, with a cache of keys and values for acting (paper Appendix A.7)."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from mijax.nets.dropout import Dropout

KERNEL_INIT = nn.initializers.normal(0.02)


def sine_positions(length: int, width: int) -> np.ndarray:
    """(length, width) fixed sine and cosine position codes."""
    position = np.arange(length)[:, None]
    frequency = np.exp(-np.log(10_000.0) * np.arange(0, width, 2) / width)
    code = np.zeros((length, width), np.float32)
    code[:, 0::2] = np.sin(position * frequency)
    code[:, 1::2] = np.cos(position * frequency)[:, : width // 2]
    return code


@struct.dataclass
class KeyValueCache:
    """What the transformer remembers of an episode while acting."""

    keys: jax.Array  # (B, layers, max_length, width)
    values: jax.Array  # (B, layers, max_length, width)


class Block(nn.Module):
    """One pre-norm transformer block: attention, then a four times wider GELU layer."""

    width: int
    heads: int
    dropout: float
    dtype: jnp.dtype

    def setup(self) -> None:
        def dense(features: int) -> nn.Dense:
            return nn.Dense(features, kernel_init=KERNEL_INIT, dtype=self.dtype)

        self.norm_attention = nn.LayerNorm(dtype=self.dtype)
        self.queries_keys_values = dense(3 * self.width)
        self.project = dense(self.width)
        self.norm_mlp = nn.LayerNorm(dtype=self.dtype)
        self.expand = dense(4 * self.width)
        self.contract = dense(self.width)
        self.drop = Dropout(self.dropout)

    def _attend(self, query: jax.Array, key: jax.Array, value: jax.Array, visible: jax.Array) -> jax.Array:
        """(R Lq, W), (R Lk, W) twice and (R, Lq, Lk) bool -> (R Lq, W)."""
        num, width_head = visible.shape[0], self.width // self.heads

        def split(x: jax.Array) -> jax.Array:
            return x.reshape(num, -1, self.heads, width_head).transpose(0, 2, 1, 3)

        score = split(query) @ split(key).swapaxes(-1, -2) * width_head**-0.5
        score = jnp.where(visible[:, None], score.astype(jnp.float32), -1e9)
        weights = jax.nn.softmax(score)
        self.sow("intermediates", "attention", weights)  # (R, heads, Lq, Lk), kept for who asks, to be drawn
        out = weights.astype(self.dtype) @ split(value)
        return out.transpose(0, 2, 1, 3).reshape(-1, self.width)

    def _mlp(self, x: jax.Array, deterministic: bool) -> jax.Array:
        hidden = nn.gelu(self.expand(self.norm_mlp(x)))
        return x + self.drop(self.contract(hidden), deterministic=deterministic)

    def __call__(self, x: jax.Array, visible: jax.Array, deterministic: bool) -> jax.Array:
        """(R L, W) and (R, L, L) bool -> (R L, W)."""
        query, key, value = jnp.split(self.queries_keys_values(self.norm_attention(x)), 3, axis=-1)
        attended = self.project(self._attend(query, key, value, visible))
        x = x + self.drop(attended, deterministic=deterministic)
        return self._mlp(x, deterministic)

    def step(
        self, keys: jax.Array, values: jax.Array, x: jax.Array, position: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Attend from one new token: (B, max_length, W) twice, (B, W), (B,) -> new keys, new values, (B, W)."""
        query, key, value = jnp.split(self.queries_keys_values(self.norm_attention(x)), 3, axis=-1)
        slots = jnp.arange(keys.shape[1])[None]
        here = slots == position[:, None]
        keys = jnp.where(here[..., None], key[:, None], keys)
        values = jnp.where(here[..., None], value[:, None], values)
        visible = (slots <= position[:, None])[:, None]
        flat = (-1, self.width)
        x = x + self.project(self._attend(query, keys.reshape(flat), values.reshape(flat), visible))
        return keys, values, self._mlp(x, True)


class GPT(nn.Module):
    """Summary of a history: causal transformer blocks over embedded tokens, within each packed episode."""

    width: int
    max_length: int
    layers: int = 1
    heads: int = 2
    dropout: float = 0.0
    dtype: jnp.dtype = jnp.float32

    def setup(self) -> None:
        self.blocks = [Block(self.width, self.heads, self.dropout, self.dtype) for _ in range(self.layers)]
        self.norm = nn.LayerNorm(dtype=self.dtype)
        self.drop = Dropout(self.dropout)

    def __call__(
        self, x: jax.Array, segment: jax.Array, position: jax.Array, deterministic: bool = True
    ) -> jax.Array:
        """(R L, W) tokens with (R, L) segment and position -> (R L, W) history summaries.

        Tokens stay in one flat axis: XLA on a CPU takes twice as long for gradients of layers over two leading axes.
        """
        code = jnp.asarray(sine_positions(self.max_length, self.width), self.dtype)
        x = self.drop(x + code[position.reshape(-1)], deterministic=deterministic)
        causal = jnp.tril(jnp.ones((position.shape[1], position.shape[1]), bool))
        visible = causal[None] & (segment[:, :, None] == segment[:, None, :])
        for block in self.blocks:
            x = block(x, visible, deterministic)
        return self.norm(x)

    def initial_state(self, batch: int) -> KeyValueCache:
        """The empty memory of `batch` new episodes."""
        empty = jnp.zeros((batch, self.layers, self.max_length, self.width), self.dtype)
        return KeyValueCache(empty, empty)

    def step(self, state: KeyValueCache, x: jax.Array, position: jax.Array) -> tuple[KeyValueCache, jax.Array]:
        """One token per episode: (B, W) at (B,) positions -> new memory, (B, W) history summaries."""
        code = jnp.asarray(sine_positions(self.max_length, self.width), self.dtype)
        x = x + code[position]
        keys, values = [], []
        for i, block in enumerate(self.blocks):
            key, value, x = block.step(state.keys[:, i], state.values[:, i], x, position)
            keys.append(key)
            values.append(value)
        return KeyValueCache(jnp.stack(keys, 1), jnp.stack(values, 1)), self.norm(x)

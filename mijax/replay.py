"""A replay of whole episodes that lives on the device and is written in place.

Every environment owns one open slot and writes each step into it as it happens; when the episode ends its slot joins
the finished ones and the environment is given another. So an episode is never copied, only finished episodes can be
sampled, and the oldest finished one is overwritten first.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct


@struct.dataclass
class StepRecord:
    """What is stored of one step, for a token (a_{t-1}, o_t) and the transition that led to it."""

    observation: Any  # (E, *observation_shape) in the environment's own dtype; (E,) which of all there are; the
    # moment, an EnvState with leaves (E, ...), of an environment that shows it again; or, of an agent that looks once,
    # what it sees, (E, D) float16 or (E, 1 + copies, D) in each copy of the episode
    previous_action: jax.Array  # (E,) integer, -1 on the first step of an episode; or (E, A) float32, there 0; beside
    # features in each copy, it is (E, 1 + copies, A)
    reward: jax.Array  # (E,) float32, received on arriving
    terminated: jax.Array  # (E,) bool, on arriving
    truncated: jax.Array  # (E,) bool, on arriving
    z_s: jax.Array | None  # (E, F) phi(s_t), labelled once on collection, or (E, 1 + copies, F) in each copy of the
    # episode; None when the agent does not use it
    state: jax.Array | None = None  # (E, *state_shape), or features as of observations; None but for asymmetric critics
    intended: jax.Array | None = None  # as previous_action: what was meant in its place; None unless it is imitated
    symmetry: jax.Array | None = None  # (E, 2) uint32, the same in all steps of an episode: see `mijax.augmentation`


IN_EACH_COPY = ("observation", "previous_action", "z_s", "state", "intended")
"""What has an axis of copies where what every copy shows is stored."""


@struct.dataclass
class Replay:
    """S = capacity + E slots of L = horizon + 1 steps."""

    data: StepRecord  # every field (S, L, ...)
    length: jax.Array  # (S,) int32, steps stored in a finished slot, the first observation included
    finished: jax.Array  # (capacity,) int32, slots of finished episodes, a ring in order of completion
    open_slots: jax.Array  # (E,) int32, the slot each environment is writing
    count: jax.Array  # () int32, episodes ever finished
    kept: int = struct.field(pytree_node=False, default=0)  # first places of the ring, which are never overwritten

    @property
    def capacity(self) -> int:
        """How many finished episodes are kept."""
        return self.finished.shape[0]


def init_replay(example: StepRecord, capacity: int, horizon: int, kept: int = 0) -> Replay:
    """An empty replay for records shaped like `example`, whose leading axis is the environments'; the first `kept`
    episodes that finish (demonstrations) stay for ever."""
    num_envs = example.reward.shape[0]
    if capacity < num_envs + kept:
        raise ValueError(f"a replay of {capacity} episodes cannot serve {num_envs} environments that end at once"
                         + (f" beside {kept} that are kept" if kept else ""))
    slots = capacity + num_envs
    data = jax.tree.map(lambda x: jnp.zeros((slots, horizon + 1, *x.shape[1:]), x.dtype), example)
    return Replay(
        data=data,
        length=jnp.zeros((slots,), jnp.int32),
        finished=jnp.zeros((capacity,), jnp.int32),
        open_slots=jnp.arange(num_envs, dtype=jnp.int32),
        count=jnp.zeros((), jnp.int32),
        kept=kept,
    )


def write(replay: Replay, record: StepRecord, position: jax.Array, keep: jax.Array | bool = True) -> Replay:
    """Store one step of every environment at (E,) `position` of its open episode, where `keep`."""
    slots = jnp.where(keep, replay.open_slots, replay.length.shape[0])
    data = jax.tree.map(lambda x, y: x.at[slots, position].set(y.astype(x.dtype), mode="drop"), replay.data, record)
    return dataclasses.replace(replay, data=data)


def finish(replay: Replay, done: jax.Array, length: jax.Array) -> Replay:
    """Close the episodes of (E,) `done` environments, each (E,) `length` steps long, and open new slots for them."""
    num_envs = done.shape[0]
    order = replay.count + jnp.cumsum(done, dtype=jnp.int32) - done.astype(jnp.int32)
    ring = jnp.where(
        order < replay.capacity, order, replay.kept + (order - replay.kept) % (replay.capacity - replay.kept))
    oldest = replay.finished[ring]
    fresh = jnp.where(order < replay.capacity, num_envs + order, oldest).astype(jnp.int32)
    closed = jnp.where(done, replay.open_slots, replay.length.shape[0])
    return dataclasses.replace(
        replay,
        length=replay.length.at[closed].set(length, mode="drop"),
        finished=replay.finished.at[jnp.where(done, ring, replay.capacity)].set(replay.open_slots, mode="drop"),
        open_slots=jnp.where(done, fresh, replay.open_slots),
        count=replay.count + jnp.sum(done, dtype=jnp.int32),
    )


def fill(replay: Replay, records: StepRecord, length: jax.Array) -> Replay:
    """Put N whole episodes into a replay in which none has finished yet.

    Args:
        replay: of a capacity of at least N.
        records: every field (N, L, ...).
        length: (N,) int32, steps stored, the first observation included.
    """
    slots = replay.open_slots.shape[0] + jnp.arange(length.shape[0], dtype=jnp.int32)
    return dataclasses.replace(
        replay,
        data=jax.tree.map(lambda x, y: x.at[slots].set(y.astype(x.dtype)), replay.data, records),
        length=replay.length.at[slots].set(length),
        finished=replay.finished.at[: length.shape[0]].set(slots),
        count=jnp.int32(length.shape[0]),
    )


def read_steps(replay: Replay, slots: jax.Array, position: jax.Array, copy: jax.Array | None = None) -> StepRecord:
    """The steps at (N,) `position` of the episodes in (N,) `slots`, every field (N, ...); with a `copy`, (N,), of what
    is stored in each copy of an episode only what that one shows, so that the others are never moved."""
    read = jax.tree.map(lambda x: x[slots, position], dataclasses.replace(replay.data, **dict.fromkeys(IN_EACH_COPY)))
    here = (slots, position) if copy is None else (slots, position, copy)
    copied = {name: getattr(replay.data, name) for name in IN_EACH_COPY}
    return dataclasses.replace(read, **jax.tree.map(lambda x: x[here], copied))


def returns_of(replay: Replay, slots: jax.Array) -> jax.Array:
    """(B,) undiscounted returns of the finished episodes in (B,) `slots`."""
    reward = replay.data.reward[slots]
    taken = jnp.arange(reward.shape[1])[None] < replay.length[slots][:, None]
    return jnp.sum(reward, axis=1, where=taken)


def sample_episodes(replay: Replay, key: jax.Array, batch: int, share: float = 0.0) -> jax.Array:
    """(batch,) int32 slots of finished episodes, uniform with replacement whatever their length; with a `share`, each
    is uniform over the kept ones of its fold with that probability.

    The first half of the batch comes from episodes at even places of the ring and the second half from those at odd
    ones, for as long as an episode lives: two folds, so that a model fitted on one can be tried on the other.
    """
    number = jnp.minimum(replay.count, replay.capacity)
    fold = jnp.arange(batch) * 2 // batch

    def uniform(key: jax.Array, number: jax.Array | int) -> jax.Array:
        return 2 * jax.random.randint(key, (batch,), 0, jnp.maximum((number + 1 - fold) // 2, 1)) + fold

    place = uniform(key, number)
    if share > 0 and replay.kept:
        key_which, key_kept = jax.random.split(jax.random.fold_in(key, 1))
        kept = jnp.minimum(uniform(key_kept, replay.kept), replay.kept - 1)  # one alone is in both folds
        place = jnp.where(jax.random.bernoulli(key_which, share, (batch,)), kept, place)
    return replay.finished[jnp.minimum(place, number - 1)]

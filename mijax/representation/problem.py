"""What stays fixed in the training of stage 1, and the batches that are drawn from it.

A batch of B transitions is B draws from K distinct ones. Where K <= B, all K are computed once and weighted by how
often they were drawn: the same losses for a fraction of the work.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs_mjx.base import Environment
from mijax.config import ConfigError, Stage1Config
from mijax.frames import Frames, take_apart
from mijax.nets.encoders import Encoder
from mijax.representation.dataset import Transitions, TransitionTable, tabulate
from mijax.representation.model import Networks, networks_for


@struct.dataclass
class Shown:
    """Frames of a batch's own, one row each."""

    state: jax.Array  # (B', *state_shape)
    observation: jax.Array  # (B', *observation_shape)
    next_state: jax.Array  # (B', *state_shape)
    next_observation: jax.Array  # (B', *observation_shape)


@struct.dataclass
class Batch:
    """Distinct transitions of a batch, B' of them."""

    rows: TransitionTable  # (B',) each
    weight: jax.Array  # (B',) float32, probability of each row in the batch; sums to one
    reward_weight: jax.Array  # (B',) float32, the same for the reward loss
    shown: "Shown | None"  # augmented frames; None: those of the data set, at the rows' indices
    noise: jax.Array | None  # (B', F) standard normal, added to z_s; None but under the KL penalty


@dataclasses.dataclass(frozen=True)
class Problem:
    """A data set, the networks and the options: all that stays fixed in training.

    Of the loss weights, `config` has Believer's and tells which losses take part; `LossWeights` has the values.
    """

    env: Environment
    networks: Networks
    config: Stage1Config
    data: Transitions
    table: TransitionTable
    row: jax.Array  # (N,) int32, row of `table` of each transition
    states: Frames  # all distinct states, as phi reads them
    observations: Frames  # all distinct observations, as psi reads them
    rewarded: jax.Array  # (W,) int32, rows of `table` whose reward is not the most common one
    center: np.ndarray  # (V',) float32, mean of each variable that is not hidden; 0 of a category
    scale: np.ndarray  # (V',) float32, its standard deviation; 1 of a category

    @classmethod
    def of(cls, env: Environment, config: Stage1Config, data: Transitions) -> "Problem":
        """Everything about `data` that can be worked out before training; `ConfigError` if it fills no batch."""
        if config.lower_bound == "variables" and all(variable.hidden for variable in env.variables):
            raise ConfigError("--stage1.lower-bound: got 'variables', accepted: 'jensen_shannon', as "
                              f"{env.name} declares no variables that can be seen")
        if data.size < config.batch_size:
            raise ConfigError(f"--stage1.batch-size: got {config.batch_size}, accepted: at most the {data.size} "
                              f"transitions of --stage1.episodes {config.episodes}")

        def prepared(encoder: Encoder, frames: jax.Array) -> Frames:
            patches = take_apart(np.asarray(frames), encoder.layers, min(config.batch_size, frames.shape[0]))
            return frames if patches is None else patches

        networks, (table, row) = networks_for(env, config.features), tabulate(data)
        rewards, count = np.unique(data.reward, return_counts=True)
        rewarded = np.flatnonzero(table.reward != rewards[np.argmax(count)]).astype(np.int32)
        return cls(env, networks, config, data, table, row, prepared(networks.phi, data.states),
                   prepared(networks.psi, data.observations), jnp.asarray(rewarded), *_units(env, config, data))

    @property
    def size(self) -> int:
        """Transitions, copies included: number c N + i is copy c of transition i, copy 0 the original."""
        return self.data.size * (1 + self.config.copies)

    def seen(self, ground_truth: jax.Array) -> jax.Array:
        """(B, V) variables -> (B, V') float32: those that are not hidden, real ones in standard deviations."""
        columns = jnp.asarray(_seen_columns(self.env))
        return (ground_truth[:, columns] - self.center[None]) / self.scale[None]

    @property
    def updates_per_epoch(self) -> int:
        """Whole batches in the data set."""
        return self.size // self.config.batch_size

    def batch(self, chosen: jax.Array, key: jax.Array) -> Batch:
        """The batch of (B,) chosen transitions, with the rewarded ones and the noise that `key` draws."""
        rows, weight, reward_weight = self._rows(chosen % self.data.size, key)
        shown = noise = None
        if self.config.copies > 0:
            copy = jnp.pad(chosen >= self.data.size, (0, rows.size - chosen.size), constant_values=True)
            rows, shown = self._augment(rows, copy, jax.random.fold_in(key, 2))
        if self.config.lambda_kl > 0:
            noise = jax.random.normal(jax.random.fold_in(key, 3), (rows.size, self.config.features))
        return Batch(rows, weight, reward_weight, shown, noise)

    def _augment(self, rows: TransitionTable, copy: jax.Array, key: jax.Array) -> tuple[TransitionTable, Shown]:
        """Frames, actions and variables of (B',) rows, each moved by a symmetry of its own where `copy`."""

        def look(row: tuple) -> tuple[jax.Array, jax.Array, Shown]:
            now, after, action, copy, key = row
            moved = [self.env.augment(key, jax.tree.map(lambda x, i=i: x[i], self.data.moments), action)
                     for i in (now, after)]
            moments = [jax.tree.map(lambda x, m, i=i: jnp.where(copy, m, x[i]), self.data.moments, m)
                       for i, (m, _) in zip((now, after), moved, strict=True)]
            now, after = (self.env.show(moment) for moment in moments)
            return jnp.where(copy, moved[0][1], action), self.env.ground_truth(moments[0]), Shown(
                now.state, now.observation, after.state, after.observation)

        keys = jax.random.split(key, rows.size)
        action, truth, shown = jax.vmap(look)((rows.state, rows.next_state, rows.action, copy, keys))
        return dataclasses.replace(rows, action=action, ground_truth=truth), shown

    def _rows(self, chosen: jax.Array, key: jax.Array) -> tuple[TransitionTable, jax.Array, jax.Array]:
        rows, size = self.row[chosen], self.config.batch_size
        extra = self.config.rewarded if self.rewarded.size else 0
        added = self.rewarded[jax.random.randint(key, (extra,), 0, self.rewarded.size)] if extra else rows[:0]
        if self.table.size <= size and self.config.copies == 0:
            nothing = jnp.zeros(self.table.size, jnp.float32)
            table, weight, drawn = self.table, nothing.at[rows].add(1 / size), nothing.at[added].add(1.0)
        else:
            table = jax.tree.map(lambda column: column[jnp.concatenate([rows, added])], self.table)
            weight = jnp.asarray(np.repeat([1 / size, 0.0], [size, extra]), jnp.float32)
            drawn = (weight == 0).astype(jnp.float32)
        if not extra:
            return table, weight, weight
        rewarded = drawn > 0
        common = jnp.where(rewarded, 0.0, weight)
        return table, weight, 0.5 * drawn / extra + 0.5 * common / jnp.maximum(jnp.sum(common), 1 / size)


def _seen_columns(env: Environment) -> list[int]:
    """Which variables are not hidden."""
    return [i for i, variable in enumerate(env.variables) if not variable.hidden]


def _units(env: Environment, config: Stage1Config, data: Transitions) -> tuple[np.ndarray, np.ndarray]:
    """(V',) center and scale of the variables that are not hidden.

    Where there are augmented copies, of those: they are most of what is learnt from, and a variable may hardly differ
    without them (the yaw in demonstrations of Block-Pulling: up to 48 of its standard deviations in a turned copy).
    """
    truth = data.ground_truth
    if config.copies > 0:
        def moved(key: jax.Array, index: jax.Array, action: jax.Array) -> jax.Array:
            moment = jax.tree.map(lambda leaf: leaf[index], data.moments)
            return env.ground_truth(env.augment(key, moment, action)[0])

        truth = jax.jit(jax.vmap(moved))(jax.random.split(jax.random.key(0), data.size), data.state, data.action)
    columns = _seen_columns(env)
    known = np.asarray(truth)[:, columns]
    real = np.array([env.variables[i].num_values is None for i in columns], bool)
    center = np.where(real, known.mean(axis=0), 0.0).astype(np.float32)
    return center, np.where(real & (known.std(axis=0) > 0), known.std(axis=0), 1.0).astype(np.float32)

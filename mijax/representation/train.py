"""Training of stage 1 (paper Algorithm 1): phi, psi and the dynamics model against CLUB's estimator.

A batch of B transitions is B draws from K distinct ones. Where K <= B, all K are computed once and weighted by how often
they were drawn: the same losses for a fraction of the work. The same holds for the frames that have to be encoded.
"""

import dataclasses
import functools
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from envs_mjx.base import Environment
from mijax.config import Stage1Config
from mijax.losses.club import club_all_pairs, gaussian_fit
from mijax.losses.dim import dim_jensen_shannon
from mijax.losses.dynamics import next_feature_loss, reward_loss
from mijax.nets.encoders import Encoder
from mijax.representation.dataset import Transitions, TransitionTable, collect, tabulate
from mijax.representation.model import Networks, init_parameters, local_features, networks_for
from mijax.types import Metrics, Params, Representation

ENCODER_NETWORKS = ("phi", "psi", "dynamics", "discriminator_s", "discriminator_o")
STANDARDIZE_FLOOR = 1e-6
"""Added to the variance of a feature before dividing by it, as a fraction of the mean variance of all features."""
ProgressCallback = Callable[[int, dict[str, float]], None]
"""Called after each epoch with its number, from 1, and the metrics of its last batch."""


class DivergenceError(RuntimeError):
    """A loss became infinite or not a number; the message names it."""


@struct.dataclass
class TrainState:
    """All that changes in training."""

    parameters: dict[str, Params]  # phi, psi, dynamics, discriminator_s, discriminator_o
    estimator: Params  # CLUB's q(z_o | z_s)
    optimizer: optax.OptState
    estimator_optimizer: optax.OptState


@struct.dataclass
class Batch:
    """Distinct transitions of a batch."""

    rows: TransitionTable  # (K,) or (B,) each
    weight: jax.Array  # (K,) or (B,) float32, probability of each row in the batch; sums to one


@dataclasses.dataclass(frozen=True)
class History:
    """What training leaves besides the representation."""

    metrics: dict[str, np.ndarray]
    """(epochs,) each: metrics of the last batch of every epoch."""
    dynamics: Params
    """Parameters of the dynamics model, for the probe."""
    estimator: Params
    """Parameters of q(z_o | z_s), for the probe."""
    updates: int
    """Encoder updates made."""
    compile_seconds: float
    """Time until the first epoch was done."""
    seconds: float
    """Time of all the other epochs."""

    @property
    def updates_per_second(self) -> float:
        """Encoder updates per second, compilation left out; 0 when there was only one epoch."""
        epochs = len(next(iter(self.metrics.values())))
        return self.updates * (epochs - 1) / epochs / self.seconds if epochs > 1 else 0.0


@dataclasses.dataclass(frozen=True)
class Problem:
    """A data set, the networks and the options: all that stays fixed in training."""

    networks: Networks
    config: Stage1Config
    data: Transitions
    table: TransitionTable
    row: jax.Array  # (N,) int32, row of `table` of each transition

    @property
    def updates_per_epoch(self) -> int:
        """Whole batches in the data set."""
        return self.data.size // self.config.batch_size

    def batch(self, chosen: jax.Array) -> Batch:
        """The batch of (B,) chosen transitions."""
        rows, size = self.row[chosen], self.config.batch_size
        if self.table.size <= size:
            return Batch(self.table, jnp.zeros(self.table.size, jnp.float32).at[rows].add(1 / size))
        return Batch(jax.tree.map(lambda column: column[rows], self.table), jnp.full(size, 1 / size, jnp.float32))


def optimizers(config: Stage1Config, updates: int) -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
    """Adam for the encoders and the dynamics model, its step size falling to 0 as a half cosine, with the shrinkage of
    phi; and Adam at a constant step size for the estimator, which has to follow to the end.
    """
    step_size = optax.cosine_decay_schedule(config.learning_rate, updates)
    plain = optax.adam(step_size)
    names = {name: "phi" if name == "phi" else "others" for name in ENCODER_NETWORKS}
    optimizer = optax.partition({"phi": optax.chain(plain, shrink(config.phi_shrinkage, step_size)), "others": plain}, names)
    return optimizer, optax.adam(config.learning_rate)


def shrink(strength: float, step_size: optax.Schedule) -> optax.GradientTransformation:
    """Pull every weight (not the biases) towards 0 by `strength` x step size after each update, and stop it there.

    The proximal step of an L1 penalty, decoupled from Adam's normalisation as weight decay is in AdamW: a weight
    survives only if its gradient, in units of its own root mean square, keeps asking for it with more than `strength`.
    """

    def init(parameters: optax.Params) -> jax.Array:
        del parameters
        return jnp.zeros((), jnp.int32)

    def update(updates: optax.Updates, count: jax.Array, parameters: optax.Params | None = None) -> tuple:
        threshold = strength * step_size(count)

        def pull(update: jax.Array, weight: jax.Array) -> jax.Array:
            if weight.ndim < 2:
                return update
            moved = weight + update
            return jnp.sign(moved) * jnp.maximum(jnp.abs(moved) - threshold, 0.0) - weight

        return jax.tree.map(pull, updates, parameters), count + 1

    return optax.GradientTransformation(init, update)


def encode(
    encoder: Encoder, parameters: Params, frames: jax.Array, index: jax.Array, next_index: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Features (B, F) of the frames at `index`, and constant ones of those at `next_index`, both (B,) int32."""
    if frames.shape[0] <= index.shape[0]:
        z = encoder.apply({"params": parameters}, frames)
        return z[index], jax.lax.stop_gradient(z)[next_index]
    z = encoder.apply({"params": parameters}, frames[index])
    return z, jax.lax.stop_gradient(encoder.apply({"params": parameters}, frames[next_index]))


def standardize(z: jax.Array, weight: jax.Array) -> jax.Array:
    """(B, F) features with mean 0 and variance 1 under (B,) probabilities, so that q sees all of them alike.

    Mutual information does not change under it; the bound no longer depends on the scale of a feature.
    """
    centered = z - (weight @ z)[None]
    variance = weight @ jnp.square(centered)
    return centered * jax.lax.rsqrt(variance + STANDARDIZE_FLOOR * jnp.mean(variance) + 1e-12)[None]


def dim_loss(
    encoder: Encoder, parameters: Params, discriminator: Params, frames: jax.Array, index: jax.Array, z: jax.Array,
    weight: jax.Array
) -> jax.Array:
    """L_DIM (Eq. 8) of the features z (B, F) of the frames at (B,) `index`."""
    if frames.shape[0] <= index.shape[0]:
        local = local_features(encoder, parameters, discriminator, frames)[index]
    else:
        local = local_features(encoder, parameters, discriminator, frames[index])
    return dim_jensen_shannon(z @ local.T, index[:, None] == index[None, :], weight)[0]


def encoder_loss(
    parameters: dict[str, Params], estimator: Params, problem: Problem, batch: Batch
) -> tuple[jax.Array, Metrics]:
    """The weighted sum of Algorithm 1, line 8, and its terms."""
    config, networks, data = problem.config, problem.networks, problem.data
    rows, weight = batch.rows, batch.weight
    z_s, next_z_s = encode(networks.phi, parameters["phi"], data.states, rows.state, rows.next_state)
    z_o, next_z_o = encode(
        networks.psi, parameters["psi"], data.observations, rows.observation, rows.next_observation)
    reward, predicted_z_s, predicted_z_o = networks.dynamics.apply(
        {"params": parameters["dynamics"]}, z_s, z_o, networks.encode_action(rows.action))
    mean, log_variance = networks.estimator.apply({"params": estimator}, standardize(z_s, weight))
    terms = {
        "reward_loss": (config.lambda_r, reward_loss(reward, rows.reward, weight)[0]),
        "z_s_loss": (config.lambda_s, next_feature_loss(predicted_z_s, next_z_s, rows.terminal, weight)[0]),
        "z_o_loss": (config.lambda_o, next_feature_loss(predicted_z_o, next_z_o, rows.terminal, weight)[0]),
        "club": (config.lambda_club, club_all_pairs(standardize(z_o, weight), mean, log_variance, weight)[0]),
    }
    if config.lambda_dim_s > 0:
        terms["dim_s_loss"] = config.lambda_dim_s, dim_loss(
            networks.phi, parameters["phi"], parameters["discriminator_s"], data.states, rows.state, z_s, weight)
    if config.lambda_dim_o > 0:
        terms["dim_o_loss"] = config.lambda_dim_o, dim_loss(
            networks.psi, parameters["psi"], parameters["discriminator_o"], data.observations, rows.observation, z_o,
            weight)
    total = sum((scale * value for scale, value in terms.values()), jnp.zeros((), jnp.float32))
    return total, {"loss": total} | {name: value for name, (_, value) in terms.items()}


def fit_estimator(
    estimator: Params, state: optax.OptState, problem: Problem, parameters: dict[str, Params], batch: Batch,
    optimizer: optax.GradientTransformation
) -> tuple[Params, optax.OptState]:
    """Move q(z_o | z_s) towards the current features, `estimator_updates` times on this batch."""
    networks, data, rows = problem.networks, problem.data, batch.rows
    z_s, _ = encode(networks.phi, parameters["phi"], data.states, rows.state, rows.next_state)
    z_o, _ = encode(networks.psi, parameters["psi"], data.observations, rows.observation, rows.next_observation)
    z_s, z_o = standardize(z_s, batch.weight), standardize(z_o, batch.weight)

    def loss(estimator: Params) -> jax.Array:
        return gaussian_fit(z_o, *networks.estimator.apply({"params": estimator}, z_s), batch.weight)[0]

    def update(carry: tuple, _: None) -> tuple[tuple, None]:
        estimator, state = carry
        step, state = optimizer.update(jax.grad(loss)(estimator), state)
        return (optax.apply_updates(estimator, step), state), None

    (estimator, state), _ = jax.lax.scan(update, (estimator, state), None, length=problem.config.estimator_updates)
    return estimator, state


def initial_state(problem: Problem, key: jax.Array) -> TrainState:
    """Fresh parameters and optimisers."""
    parameters = init_parameters(problem.networks, key, problem.data.states[:1], problem.data.observations[:1])
    estimator = parameters.pop("estimator")
    optimizer, estimator_optimizer = optimizers(problem.config, 1)
    return TrainState(parameters, estimator, optimizer.init(parameters), estimator_optimizer.init(estimator))


def make_epoch(problem: Problem) -> Callable[[TrainState, jax.Array], tuple[TrainState, Metrics]]:
    """One pass over the data in a random order, compiled: (state, key) -> (state, metrics of the last batch)."""
    config = problem.config
    updates = problem.updates_per_epoch
    optimizer, estimator_optimizer = optimizers(config, config.epochs * updates)

    def update(state: TrainState, chosen: jax.Array) -> tuple[TrainState, Metrics]:
        batch = problem.batch(chosen)
        estimator, estimator_state = fit_estimator(
            state.estimator, state.estimator_optimizer, problem, state.parameters, batch, estimator_optimizer)
        gradients, metrics = jax.grad(encoder_loss, has_aux=True)(state.parameters, estimator, problem, batch)
        step, optimizer_state = optimizer.update(gradients, state.optimizer, state.parameters)
        parameters = optax.apply_updates(state.parameters, step)
        return TrainState(parameters, estimator, optimizer_state, estimator_state), metrics

    @jax.jit
    def epoch(state: TrainState, key: jax.Array) -> tuple[TrainState, Metrics]:
        order = jax.random.permutation(key, problem.data.size)[: updates * config.batch_size]
        state, metrics = jax.lax.scan(update, state, order.reshape(updates, config.batch_size))
        return state, jax.tree.map(lambda value: value[-1], metrics)

    return epoch


def learn_representation(
    env: Environment, config: Stage1Config, key: jax.Array, on_progress: ProgressCallback | None = None
) -> tuple[Representation, History]:
    """Stage 1 from end to end: collect transitions, train, keep the encoders and the scale of z_s.

    Everything follows from `key`, so that a seed does not depend on its neighbours.

    Raises:
        DivergenceError: a loss is no finite number.
        ValueError: the data set is smaller than one batch.
    """
    data_key, init_key, train_key = jax.random.split(key, 3)
    return train_on(collect(env, data_key, config.episodes), env, config, init_key, train_key, on_progress)


def train_on(
    data: Transitions, env: Environment, config: Stage1Config, init_key: jax.Array, train_key: jax.Array,
    on_progress: ProgressCallback | None = None
) -> tuple[Representation, History]:
    """Stage 1 on transitions that were collected elsewhere (demonstrations); see `learn_representation`."""
    if data.size < config.batch_size:
        raise ValueError(f"stage 1: {data.size} transitions are fewer than --stage1.batch-size {config.batch_size}")
    problem = Problem(networks_for(env, config.features), config, data, *tabulate(data))
    state, epoch = initial_state(problem, init_key), make_epoch(problem)
    seen: list[dict[str, float]] = []
    started = compiled = time.perf_counter()
    for number in range(1, config.epochs + 1):
        state, metrics = epoch(state, jax.random.fold_in(train_key, number))
        seen.append({name: float(value) for name, value in metrics.items()})
        compiled = time.perf_counter() if number == 1 else compiled
        _refuse_divergence(seen[-1], number, config)
        if on_progress is not None:
            on_progress(number, seen[-1])
    history = History(
        metrics={name: np.array([m[name] for m in seen]) for name in seen[-1]},
        dynamics=state.parameters["dynamics"], estimator=state.estimator,
        updates=config.epochs * problem.updates_per_epoch,
        compile_seconds=compiled - started, seconds=time.perf_counter() - compiled)
    return _representation(problem, state), history


def _refuse_divergence(metrics: dict[str, float], epoch: int, config: Stage1Config) -> None:
    bad = [name for name, value in metrics.items() if not np.isfinite(value) and name != "loss"]
    if bad:
        raise DivergenceError(f"stage 1: {bad[0]} is {metrics[bad[0]]} after epoch {epoch}; "
                              f"try a smaller --stage1.learning-rate than {config.learning_rate}")


def _representation(problem: Problem, state: TrainState) -> Representation:
    """The encoders, with the moments of z_s over all transitions."""
    data = problem.data
    phi = state.parameters["phi"]
    z = encode_frames(problem.networks.phi, phi, data.states)
    weight = jnp.zeros(data.states.shape[0], jnp.float32).at[data.state].add(1 / data.size)
    mean = weight @ z
    return Representation(
        phi=phi, psi=state.parameters["psi"], z_s_mean=mean,
        z_s_variance=jnp.sum(weight @ jnp.square(z - mean[None])))


@functools.partial(jax.jit, static_argnums=0)
def encode_frames(encoder: Encoder, parameters: Params, frames: jax.Array) -> jax.Array:
    """(M, F) features of (M, ...) frames."""
    return encoder.apply({"params": parameters}, frames)

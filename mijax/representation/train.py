"""Training of stage 1 (paper Algorithm 1): phi, psi and the dynamics model against CLUB's estimator.

A batch holds each of its distinct transitions once, with a weight (`mijax.representation.problem`); the frames to be
encoded are likewise encoded once.
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from envs_mjx.base import Environment
from envs_mjx.errors import UserError
from mijax.config import EstimatorView, Stage1Config
from mijax.frames import Frames, Patches, keep_present
from mijax.losses.belief import kl_standard_normal
from mijax.losses.club import club_all_pairs, gaussian_fit
from mijax.losses.dim import dim_jensen_shannon
from mijax.losses.dynamics import next_feature_loss, reward_loss
from mijax.losses.variables import variables_loss
from mijax.nets.encoders import Encoder
from mijax.representation.dataset import collect
from mijax.representation.model import evaluate, init_parameters, local_features
from mijax.representation.problem import Batch, Problem
from mijax.types import Metrics, Params, Representation

ENCODER_NETWORKS = ("phi", "psi", "dynamics", "discriminator_s", "discriminator_o")
DIRECTION_FLOOR = 1e-4
"""Added to the variance of a principal direction before dividing by it, as a fraction of the variance of all."""
STANDARDIZE_FLOOR = 1e-6
"""Added to the variance of a feature before dividing by it, as a fraction of the mean variance of all features."""
FrameFunction = Callable[[Frames], jax.Array]
"""M frames -> (M, F)."""
ProgressCallback = Callable[[int, dict[str, float]], None]
"""Called after each epoch with its number, from 1, and the metrics of its last batch."""


class DivergenceError(UserError):
    """A loss became infinite or not a number, which the message names, or z_s a constant."""


class ErasedError(DivergenceError):
    """phi's shrinkage has left nothing of z_s."""


STARTS = 3
"""First weights that are tried in turn while z_s ends up erased, which happened with the preset of Heaven-Hell in one
of 21 seeds."""
MANY_VALUES = 2**24
"""In frames that are encoded at once."""
CLUB_START = 0.01
"""Share of lambda_club that a ramp starts at."""
CONSTANT = 1e-10
"""A variance of z_s below this is the rounding of its mean."""
Weight = jax.Array | float


@struct.dataclass
class LossWeights:
    """The weights of Algorithm 1, line 8, and phi's pull: one compiled program can train with different ones.

    Named as in `Stage1Config`. Numbers that are compiled in, () float32 arguments of a program, or (M,) of M members.
    """

    lambda_r: Weight
    lambda_s: Weight
    lambda_o: Weight
    lambda_club: Weight
    lambda_dim_s: Weight
    lambda_dim_o: Weight
    phi_shrinkage: Weight

    @classmethod
    def of(cls, config: Stage1Config) -> "LossWeights":
        """Those of a configuration, as numbers."""
        return cls(**{f.name: getattr(config, f.name) for f in dataclasses.fields(cls)})


@struct.dataclass
class EstimatorState:
    """CLUB's q(z_o | z_s)."""

    parameters: Params
    optimizer: optax.OptState


@struct.dataclass
class Features:
    """Of the B rows of a batch."""

    z_s: jax.Array  # (B, F)
    z_o: jax.Array  # (B, F)
    next_z_s: jax.Array  # (B, F)  constant
    next_z_o: jax.Array  # (B, F)  constant
    local_s: jax.Array | None  # (B, F)  the discriminator's features of s (Fig. 28); None when its weight is 0
    local_o: jax.Array | None  # (B, F)  the same of o


@struct.dataclass
class TrainState:
    """All that changes in training."""

    parameters: dict[str, Params]  # phi, psi, dynamics, discriminator_s, discriminator_o
    optimizer: optax.OptState
    estimator: EstimatorState


@dataclasses.dataclass(frozen=True)
class History:
    """What training leaves besides the representation."""

    metrics: dict[str, np.ndarray]
    """(epochs,) each: metrics of the last batch of every epoch."""
    dynamics: Params
    """Parameters of the dynamics model, for the probe."""
    estimator: Params
    """Parameters of q(z_o | z_s), for the probe."""
    estimator_view: EstimatorView
    """How it sees z_s."""
    updates: int
    """Encoder updates made."""
    compile_seconds: float
    """Time until the first epoch was done."""
    seconds: float
    """Time of all the other epochs."""
    starts: int = 1
    """First weights that were tried: all but the last ended with z_s erased."""

    @property
    def updates_per_second(self) -> float:
        """Encoder updates per second, compilation left out; 0 when there was only one epoch."""
        epochs = len(next(iter(self.metrics.values())))
        return self.updates * (epochs - 1) / epochs / self.seconds if epochs > 1 else 0.0


def optimizers(
    config: Stage1Config, updates: int, phi_shrinkage: Weight
) -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
    """Adam for the encoders and the dynamics model, its step size falling as a half cosine, after a rise if there is a
    warm-up, with the shrinkage of phi; and Adam at a constant step size for the estimator, which has to follow to the
    end.
    """
    final = config.final_learning_rate
    step_size = optax.cosine_decay_schedule(config.learning_rate, updates, final)
    if rise := int(config.warmup * updates):  # fewer than all, which optax refuses
        step_size = optax.warmup_cosine_decay_schedule(
            0.0, config.learning_rate, rise, updates, final * config.learning_rate)
    plain = optax.adam(step_size)
    names = {name: "phi" if name == "phi" else "others" for name in ENCODER_NETWORKS}
    shrinking = optax.chain(plain, shrink(phi_shrinkage, step_size))
    return optax.partition({"phi": shrinking, "others": plain}, names), optax.adam(config.learning_rate)


def shrink(strength: Weight, step_size: optax.Schedule) -> optax.GradientTransformation:
    """Pull every weight (not the biases) towards 0 by `strength` x step size after each update, and stop it there.

    The proximal step of an L1 penalty, decoupled from Adam's normalisation as weight decay is in AdamW: a weight
    survives only if its gradient, in units of its own root mean square, keeps asking for it with more than `strength`.
    """

    def init(params: optax.Params) -> jax.Array:
        del params
        return jnp.zeros((), jnp.int32)

    def update(
        updates: optax.Updates, state: optax.OptState, params: optax.Params | None = None
    ) -> tuple[optax.Updates, optax.OptState]:
        count = cast(jax.Array, state)
        threshold = strength * step_size(count)

        def pull(update: jax.Array, weight: jax.Array) -> jax.Array:
            if weight.ndim < 2:
                return update
            moved = weight + update
            return jnp.sign(moved) * jnp.maximum(jnp.abs(moved) - threshold, 0.0) - weight

        return jax.tree.map(pull, updates, params), count + 1

    return optax.GradientTransformation(init, update)


def encode(function: FrameFunction, frames: Frames, index: jax.Array) -> jax.Array:
    """function(frames[index]), (B, F), for (B,) `index`, computed on as few frames as can be.

    Images that are taken apart cost little each; these are all computed.

    All distinct frames of the data are encoded when there are no more of them than rows. Otherwise the distinct ones of
    this batch, when they fill at most a quarter of the data's or, for a data set of mostly different frames, all rows.
    """
    if isinstance(frames, Patches):
        return function(frames.take(index))
    count, capacity = frames.shape[0], frames.shape[0] // 4
    if count <= index.shape[0]:
        return function(frames)[index]
    if capacity >= index.shape[0]:
        return function(frames[index])
    few, present, place = keep_present(index, count, capacity)
    return jax.lax.cond(few, lambda: function(frames[present])[place], lambda: function(frames[index]))


def standardize(z: jax.Array, weight: jax.Array) -> jax.Array:
    """(B, F) features with mean 0 and variance 1 under (B,) probabilities, so that q sees all of them alike.

    Mutual information does not change under it; the bound no longer depends on the scale of a feature.
    """
    centered = z - (weight @ z)[None]
    variance = weight @ jnp.square(centered)
    return centered * jax.lax.rsqrt(variance + STANDARDIZE_FLOOR * jnp.mean(variance) + 1e-12)[None]


def standardize_directions(z: jax.Array, weight: jax.Array) -> jax.Array:
    """(B, F) features with mean 0 and, in each of their principal directions, variance 1, or less where it has next to
    none of the variance of all. The map is symmetric, so that it changes little from batch to batch, and a constant:
    gradients pass through it as through any linear map."""
    centered = z - (weight @ z)[None]
    covariance = jax.lax.stop_gradient((centered * weight[:, None]).T @ centered)
    variance, directions = jnp.linalg.eigh(covariance)
    variance = jnp.maximum(variance, 0.0)
    scale = jax.lax.rsqrt(variance + DIRECTION_FLOOR * jnp.sum(variance) + 1e-12)
    return centered @ (directions * scale[None]) @ directions.T


def seen_by_estimator(
    view: EstimatorView, z_s: jax.Array, z_o: jax.Array, weight: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """(B, F) z_s and z_o as CLUB's q sees them, under (B,) probabilities; see `Stage1Config.estimator_view`."""
    if view == "raw":
        return z_s, z_o
    return (standardize_directions if view == "directions" else standardize)(z_s, weight), standardize(z_o, weight)


def features(problem: Problem, parameters: dict[str, Params], batch: Batch) -> Features:
    """z_s, z_o, their successors (constants), and what the discriminators say of the inputs: (B, F) each."""
    networks, config, rows, shown = problem.networks, problem.config, batch.rows, batch.shown
    each = jnp.arange(rows.size, dtype=jnp.int32)

    def both(encoder: Encoder, now: tuple[Frames, jax.Array], after: tuple[Frames, jax.Array], name: str,
             discriminator: str | None) -> tuple[jax.Array, jax.Array, jax.Array | None]:
        weights = parameters[name]
        frozen = jax.lax.stop_gradient(weights)

        def see(x: Frames) -> jax.Array:
            z = evaluate(encoder, weights, x)
            if discriminator is None:
                return z
            return jnp.concatenate([z, local_features(encoder, weights, parameters[discriminator], x)], axis=-1)

        z, *local = jnp.split(encode(see, *now), 1 if discriminator is None else 2, axis=-1)
        next_z = encode(lambda x: evaluate(encoder, frozen, x), *after)
        return z, next_z, local[0] if local else None

    if shown is None:
        s, next_s = (problem.states, rows.state), (problem.states, rows.next_state)
        o, next_o = (problem.observations, rows.observation), (problem.observations, rows.next_observation)
    else:
        s, next_s = (shown.state, each), (shown.next_state, each)
        o, next_o = (shown.observation, each), (shown.next_observation, each)
    z_s, next_z_s, local_s = both(
        networks.phi, s, next_s, "phi", "discriminator_s" if config.lambda_dim_s > 0 else None)
    tells_apart = config.lower_bound == "jensen_shannon" and config.lambda_dim_o > 0
    z_o, next_z_o, local_o = both(networks.psi, o, next_o, "psi", "discriminator_o" if tells_apart else None)
    return Features(z_s=z_s, z_o=z_o, next_z_s=next_z_s, next_z_o=next_z_o, local_s=local_s, local_o=local_o)


def dim_loss(
    z: jax.Array, local: jax.Array, index: jax.Array, weight: jax.Array, shown: jax.Array | None = None
) -> jax.Array:
    """L_DIM (Eq. 8) of features and discriminator outputs (B, F) of the frames at (B,) `index`; given the observations
    that each shows, (B,) `shown`, only those that show the same one have to be told apart."""
    same = index[:, None] == index[None, :]
    different = None if shown is None else ~same & (shown[:, None] == shown[None, :])
    return dim_jensen_shannon(z @ local.T, same, weight, different)[0]


def encoder_loss(
    parameters: dict[str, Params], fit: EstimatorState, problem: Problem, weights: LossWeights, batch: Batch,
    optimizer: optax.GradientTransformation
) -> tuple[jax.Array, tuple[EstimatorState, Metrics]]:
    """The weighted sum of Algorithm 1, line 8, with CLUB's estimator first fitted to the current features.

    Returns:
        The loss, and the estimator with the terms of the loss.
    """
    networks, rows, weight = problem.networks, batch.rows, batch.weight
    f = features(problem, parameters, batch)
    mean_z_s = f.z_s
    if batch.noise is not None:
        f = dataclasses.replace(f, z_s=mean_z_s + batch.noise)
    fit = fit_estimator(fit, problem, batch, f.z_s, f.z_o, optimizer)
    reward, predicted_z_s, predicted_z_o = evaluate(
        networks.dynamics, parameters["dynamics"], f.z_s, f.z_o, networks.encode_action(rows.action))
    given, guessed = seen_by_estimator(problem.config.estimator_view, f.z_s, f.z_o, weight)
    mean, log_variance = evaluate(networks.estimator, fit.parameters, given)
    terms = {
        "reward_loss": (weights.lambda_r, reward_loss(reward, rows.reward, batch.reward_weight)[0]),
        "z_s_loss": (weights.lambda_s, next_feature_loss(predicted_z_s, f.next_z_s, rows.terminal, weight)[0]),
        "z_o_loss": (weights.lambda_o, next_feature_loss(predicted_z_o, f.next_z_o, rows.terminal, weight)[0]),
        "club": (weights.lambda_club, club_all_pairs(guessed, mean, log_variance, weight)[0]),
    }
    if batch.noise is not None:
        terms["kl"] = problem.config.lambda_kl, weight @ kl_standard_normal(mean_z_s, jnp.zeros_like(mean_z_s))
    # Two turned copies never show the same: then only a frame itself is its positive.
    each = jnp.arange(rows.size, dtype=jnp.int32)
    s, o = (rows.state, rows.observation) if batch.shown is None else (each, each)
    if f.local_s is not None:
        alike = o if problem.config.state_bound == "conditional" else None
        terms["dim_s_loss"] = weights.lambda_dim_s, dim_loss(f.z_s, f.local_s, s, weight, alike)
    if f.local_o is not None:
        terms["dim_o_loss"] = weights.lambda_dim_o, dim_loss(f.z_o, f.local_o, o, weight)
    if problem.config.lower_bound == "variables" and problem.config.lambda_dim_o > 0:
        told = evaluate(networks.told, parameters["discriminator_o"], f.z_o)
        kinds = [variable.num_values for variable in networks.seen]
        terms["told_o_loss"] = weights.lambda_dim_o, variables_loss(
            told, problem.seen(rows.ground_truth), kinds, weight)[0]
    total = sum((scale * value for scale, value in terms.values()), jnp.zeros((), jnp.float32))
    return total, (fit, {"loss": total} | {name: value for name, (_, value) in terms.items()})


def fit_estimator(
    fit: EstimatorState, problem: Problem, batch: Batch, z_s: jax.Array, z_o: jax.Array,
    optimizer: optax.GradientTransformation
) -> EstimatorState:
    """Move q(z_o | z_s) towards the current features, which stay constant, `estimator_updates` times on this batch."""
    z_s, z_o = jax.lax.stop_gradient(seen_by_estimator(problem.config.estimator_view, z_s, z_o, batch.weight))

    def loss(parameters: Params) -> jax.Array:
        mean, log_variance = evaluate(problem.networks.estimator, parameters, z_s)
        return gaussian_fit(z_o, mean, log_variance, batch.weight)[0]

    def update(fit: EstimatorState, _: None) -> tuple[EstimatorState, None]:
        step, optimizer_state = optimizer.update(jax.grad(loss)(fit.parameters), fit.optimizer)
        return EstimatorState(optax.apply_updates(fit.parameters, step), optimizer_state), None

    return jax.lax.scan(update, fit, None, length=problem.config.estimator_updates)[0]


def initial_state(problem: Problem, key: jax.Array) -> TrainState:
    """Fresh parameters and optimisers."""
    parameters = init_parameters(
        problem.networks, key, problem.data.states[:1], problem.data.observations[:1],
        lower_bound=problem.config.lower_bound)
    estimator = parameters.pop("estimator")
    optimizer, estimator_optimizer = optimizers(problem.config, 1, 0.0)
    return TrainState(
        parameters, optimizer.init(parameters), EstimatorState(estimator, estimator_optimizer.init(estimator)))


def club_growth(config: Stage1Config, fit: EstimatorState, updates: int) -> jax.Array:
    """() the share of lambda_club that counts, when the estimator has been fitted so far of (whole training) `updates`
    of the encoders: from `CLUB_START` to 1 over the first `club_ramp` of them."""
    done = optax.tree.get(fit.optimizer, "count") / (config.estimator_updates * updates)
    return CLUB_START ** jnp.maximum(1 - done / config.club_ramp, 0.0)


Epoch = Callable[[LossWeights, TrainState, jax.Array], tuple[TrainState, Metrics]]
"""One pass over the data in a random order: (weights, state, key) -> (state, metrics of the last batch)."""


def make_epoch(problem: Problem) -> Epoch:
    """The pass over a data set, to be compiled; the loss weights are arguments, so that it compiles once for all."""
    config = problem.config
    updates = problem.updates_per_epoch

    def epoch(weights: LossWeights, state: TrainState, key: jax.Array) -> tuple[TrainState, Metrics]:
        optimizer, estimator_optimizer = optimizers(config, config.epochs * updates, weights.phi_shrinkage)

        def update(state: TrainState, draw: tuple[jax.Array, jax.Array]) -> tuple[TrainState, Metrics]:
            current = weights
            if config.club_ramp > 0:
                growth = club_growth(config, state.estimator, config.epochs * updates)
                current = dataclasses.replace(weights, lambda_club=weights.lambda_club * growth)
            gradients, (fit, metrics) = jax.grad(encoder_loss, has_aux=True)(
                state.parameters, state.estimator, problem, current, problem.batch(*draw), estimator_optimizer)
            step, optimizer_state = optimizer.update(gradients, state.optimizer, state.parameters)
            parameters = cast(dict[str, Params], optax.apply_updates(state.parameters, step))
            return TrainState(parameters, optimizer_state, fit), metrics

        order = jax.random.permutation(key, problem.size)[: updates * config.batch_size]
        draws = order.reshape(updates, config.batch_size), jax.random.split(jax.random.fold_in(key, 1), updates)
        state, metrics = jax.lax.scan(update, state, draws)
        return state, jax.tree.map(lambda value: value[-1], metrics)

    return epoch


def learn_representation(
    env: Environment, config: Stage1Config, key: jax.Array, on_progress: ProgressCallback | None = None,
    starts: int = STARTS
) -> tuple[Representation, History]:
    """Stage 1 from end to end: collect transitions, train, keep the encoders and the scale of z_s.

    Everything follows from `key`, so that a seed does not depend on its neighbours. Where training erases z_s it begins
    again on the same transitions, from other first weights.

    Raises:
        DivergenceError: a loss is no finite number, or z_s was erased from each of `starts` first weights.
        ConfigError: the data set is smaller than one batch.
    """
    data_key, init_key, train_key = jax.random.split(key, 3)
    problem = Problem.of(env, config, collect(env, data_key, config.episodes, config.data))
    start = 1
    while True:
        try:
            representation, history = train_on(problem, init_key, train_key, on_progress)
            return representation, dataclasses.replace(history, starts=start)
        except ErasedError:
            if start == starts:
                raise
        init_key, train_key = jax.random.split(jax.random.fold_in(key, 3 + start))  # 0 to 3 are taken
        start += 1


def train_on(
    problem: Problem, init_key: jax.Array, train_key: jax.Array, on_progress: ProgressCallback | None = None
) -> tuple[Representation, History]:
    """Stage 1 on transitions, from one set of first weights; see `learn_representation`."""
    config = problem.config
    state = initial_state(problem, init_key)
    # Weights are compiled in: as arguments they would round differently, and every known result would move a little.
    epoch = jax.jit(functools.partial(make_epoch(problem), LossWeights.of(config)))
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
        dynamics=state.parameters["dynamics"], estimator=state.estimator.parameters,
        estimator_view=config.estimator_view,
        updates=config.epochs * problem.updates_per_epoch,
        compile_seconds=compiled - started, seconds=time.perf_counter() - compiled)
    representation = representation_of(problem, state)
    variance = float(representation.z_s_variance)
    if not np.isfinite(variance):
        raise DivergenceError(_diverged("the variance of z_s", variance, config.epochs, config))
    if variance < CONSTANT:
        raise ErasedError(f"stage 1: z_s is the same in every state, nothing to be informed about; "
                          f"try a smaller --stage1.phi-shrinkage than {config.phi_shrinkage}, or, where rewards are "
                          f"rare, --stage1.rewarded {max(100, 2 * config.rewarded)}")
    return representation, history


def _refuse_divergence(metrics: dict[str, float], epoch: int, config: Stage1Config) -> None:
    bad = [name for name, value in metrics.items() if not np.isfinite(value) and name != "loss"]
    if bad:
        raise DivergenceError(_diverged(bad[0], metrics[bad[0]], epoch, config))


def _diverged(what: str, value: float, epoch: int, config: Stage1Config) -> str:
    return (f"stage 1: {what} is {value} after epoch {epoch}; "
            f"try a smaller --stage1.learning-rate than {config.learning_rate}")


def representation_of(problem: Problem, state: TrainState) -> Representation:
    """The encoders, with the moments of z_s over all transitions as they were, without their augmented copies."""
    data = problem.data
    phi = state.parameters["phi"]
    z = encode_frames(problem.networks.phi, phi, data.states)
    weight = jnp.zeros(data.states.shape[0], jnp.float32).at[data.state].add(1 / data.size)
    mean = weight @ z
    return Representation(
        phi=phi, psi=state.parameters["psi"], z_s_mean=mean,
        z_s_variance=jnp.sum(weight @ jnp.square(z - mean[None])), data_key=data.key)


@functools.partial(jax.jit, static_argnums=0)
def encode_frames(encoder: Encoder, parameters: Params, frames: jax.Array) -> jax.Array:
    """(M, F) features of (M, ...) frames; of large images only some at a time, since patches of all fill the memory."""
    if frames.size <= MANY_VALUES:
        return evaluate(encoder, parameters, frames)
    return jax.lax.map(lambda frame: evaluate(encoder, parameters, frame), frames, batch_size=64)

"""Stage 1: data, encoders, training, the probe, files and the command."""

import copy
import dataclasses
import json
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from envs_mjx import registry
from envs_mjx.base import ArraySpec
from mijax import represent
from mijax.config import ConfigError, Stage1Config
from mijax.nets.encoders import Convolution, encoder_for, image_plan
from mijax.representation import DivergenceError, encode_observation, encode_state, learn_representation
from mijax.representation import train as training
from mijax.representation.dataset import Transitions, collect, tabulate
from mijax.representation.model import evaluate
from mijax.representation.probe import ROUND_OFF, Decoding, format_report, probe, whiten
from mijax.representation.problem import Batch, Problem
from mijax.representation.storage import PARAMETERS_FILE, RepresentationError, load_representation, save_representation
from mijax.representation.train import (
    ENCODER_NETWORKS,
    EstimatorState,
    LossWeights,
    club_growth,
    dim_loss,
    encode,
    encoder_loss,
    features,
    initial_state,
    optimizers,
    representation_of,
    seen_by_estimator,
    shrink,
    standardize_directions,
)
from mijax.run_folder import RunFolder

SMALL = Stage1Config(episodes=20, heldout_episodes=20, epochs=2, batch_size=200, features=8, lambda_dim_s=0.1)


@pytest.fixture(scope="module")
def env():
    return registry.make("heaven_hell")


@pytest.fixture(scope="module")
def data(env) -> Transitions:
    return collect(env, jax.random.key(0), 20)


@pytest.fixture(scope="module")
def learnt(env):
    return learn_representation(env, SMALL, jax.random.key(1))


def test_transitions_follow_one_another_and_end_with_their_episode(data):
    episode, terminal = np.asarray(data.episode), np.asarray(data.terminal)
    same = episode[1:] == episode[:-1]
    np.testing.assert_array_equal(np.asarray(data.next_state)[:-1][same], np.asarray(data.state)[1:][same])
    np.testing.assert_array_equal(np.asarray(data.next_observation)[:-1][same], np.asarray(data.observation)[1:][same])
    assert not terminal[:-1][same].any()
    assert set(np.unique(episode)) == set(range(20))
    assert np.bincount(episode).max() <= 50
    np.testing.assert_array_equal(np.asarray(data.reward) != 0, terminal)
    assert len(np.unique(np.asarray(data.states), axis=0)) == len(data.states) <= 28


def test_the_table_of_distinct_transitions_gives_the_transitions_back(data):
    table, row = tabulate(data)
    assert table.size < data.size
    for name in ("state", "observation", "action", "reward", "next_state", "next_observation", "terminal"):
        np.testing.assert_array_equal(np.asarray(getattr(table, name))[row], getattr(data, name))


@pytest.mark.parametrize(("count", "rows"), [(10, 30), (60, 30), (60, 14), (200, 30)])
def test_encoding_the_distinct_frames_is_encoding_all(count, rows):
    frames = jax.random.normal(jax.random.key(0), (count, 3))
    for high in (count, 5):  # many and few distinct frames in the batch
        index = jax.random.randint(jax.random.key(1), (rows,), 0, high)
        encoded = encode(lambda x: jnp.sin(jnp.asarray(x)), frames, index)
        np.testing.assert_allclose(encoded, jnp.sin(frames[index]), rtol=1e-6)


@pytest.mark.parametrize(("size", "kernel", "stride"), [(6, 2, 1), (11, 3, 1), (21, 8, 4), (9, 4, 4)])
def test_convolutions_are_those_of_xla(size, kernel, stride):
    x = jax.random.normal(jax.random.key(0), (2, size, size, 3))
    module = Convolution(5, kernel, stride)
    params: Any = module.init(jax.random.key(1), x)["params"]
    expected = jax.lax.conv_general_dilated(
        x, params["kernel"], (stride, stride), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC"))
    np.testing.assert_allclose(evaluate(module, params, x), expected, atol=1e-5)


@pytest.mark.parametrize("shape", [(3,), (3, 3, 1), (6, 6, 2), (11, 11, 2), (30, 40, 3), (84, 84, 2)])
def test_every_shape_has_an_encoder_and_its_first_block_leads_to_it(shape):
    encoder = encoder_for(ArraySpec(shape), 32)
    x = jnp.ones((2, *shape), jnp.uint8)
    params = encoder.init(jax.random.key(0), x)["params"]
    z = evaluate(encoder, params, x)
    assert z.shape == (2, 32)
    assert z.dtype == jnp.float32
    h = evaluate(encoder, params, x, method="first_block")
    np.testing.assert_allclose(evaluate(encoder, params, h, method="finish"), z, atol=1e-6)
    np.testing.assert_allclose(evaluate(encoder, params, x[None]), z[None], atol=1e-6)


def test_blank_channels_are_not_looked_at():
    """With them or without, an encoder says the same: depths relative to their mean would fill them otherwise."""
    spec = ArraySpec((84, 84, 2), blank=1, contrast=0.05)
    encoder, x = encoder_for(spec, 8), jax.random.uniform(jax.random.key(1), (2, 84, 84, 2)).at[..., 1].set(0.0)
    params: Any = encoder.init(jax.random.key(0), x)["params"]
    whole, shown = (encoder.apply({"params": params}, images) for images in (x, x[..., :1]))
    np.testing.assert_array_equal(whole, shown)


def test_contrast_hides_the_level_of_an_image():
    shape = (52, 52, 2)
    x = jnp.asarray(np.random.default_rng(0).normal(size=(2, *shape)), jnp.float32)
    plain, relative = encoder_for(ArraySpec(shape), 8), encoder_for(ArraySpec(shape, contrast=0.05), 8)
    params = plain.init(jax.random.key(0), x)["params"]
    seen = evaluate(relative, params, x)
    np.testing.assert_allclose(evaluate(relative, params, x + 0.3), seen, rtol=1e-3, atol=1e-3)
    by_hand = (np.asarray(x) - np.asarray(x[..., 0]).mean((1, 2))[:, None, None, None]) / 0.05
    np.testing.assert_allclose(evaluate(plain, params, jnp.asarray(by_hand)), seen, rtol=1e-3, atol=1e-3)


def test_papers_networks_are_chosen_by_size():
    assert [(b.channels, b.kernel, b.pool) for b in image_plan(6)] == [(64, 2, 1), (128, 2, 2), (256, 2, 1)]
    assert [(b.channels, b.kernel, b.pool) for b in image_plan(11)] == [(64, 2, 2), (128, 2, 2), (256, 2, 1)]
    assert [(b.channels, b.kernel, b.stride) for b in image_plan(84)] == [(32, 8, 4), (64, 4, 4), (64, 3, 1)]
    with pytest.raises(ValueError, match="no encoder"):
        encoder_for(ArraySpec((2, 3)), 4)


def test_shrinking_stops_at_zero_and_spares_biases():
    transform = shrink(0.5, lambda count: jnp.float32(0.2))
    weights = {"kernel": jnp.array([[1.0, 0.05, -0.3]]), "bias": jnp.array([1.0])}
    still: Any = jax.tree.map(jnp.zeros_like, weights)
    updates: Any = transform.update(still, transform.init(weights), weights)[0]
    np.testing.assert_allclose(weights["kernel"] + updates["kernel"], [[0.9, 0.0, -0.2]], atol=1e-6)
    np.testing.assert_array_equal(updates["bias"], [0.0])


@pytest.mark.lenient
def test_the_step_size_rises_over_the_warm_up_and_falls_to_nothing():
    def steps(warmup: float) -> list[float]:
        config = Stage1Config(warmup=warmup, learning_rate=0.1)
        optimizer, _ = optimizers(config, 10, 0.0)
        params: Any = {name: jnp.zeros(()) for name in ENCODER_NETWORKS}
        state, taken = optimizer.init(params), []
        for _ in range(10):
            update, state = optimizer.update(jax.tree.map(jnp.ones_like, params), state, params)
            taken.append(-float(cast(dict, update)["psi"]))
        return taken

    np.testing.assert_allclose(steps(0.4)[:5], [0.0, 0.025, 0.05, 0.075, 0.1], atol=1e-6)
    assert 0 < steps(0.4)[-1] < 0.01
    np.testing.assert_allclose(steps(0.0)[0], 0.1, rtol=1e-5)
    optimizers(Stage1Config(warmup=0.9), 1, 0.0)  # a single update, which nothing can rise over


@pytest.mark.lenient
def test_clubs_weight_grows_to_its_full_value():
    config = Stage1Config(club_ramp=0.5, estimator_updates=5)
    optimizer = optax.adam(1e-3)
    fit = EstimatorState({}, optimizer.init({}))
    for done, expected in ((0, 0.01), (25, 0.1), (50, 1.0), (100, 1.0)):
        counted = optax.tree.set(fit.optimizer, count=jnp.int32(done * config.estimator_updates))
        growth = club_growth(config, dataclasses.replace(fit, optimizer=counted), 100)
        np.testing.assert_allclose(growth, expected, rtol=1e-5)


WEIGHTS = {"lambda_r": 2.0, "lambda_s": 3.0, "lambda_o": 5.0, "lambda_club": 7.0, "lambda_dim_s": 11.0,
           "lambda_dim_o": 13.0}
TERMS = {"lambda_r": "reward_loss", "lambda_s": "z_s_loss", "lambda_o": "z_o_loss", "lambda_club": "club",
         "lambda_dim_s": "dim_s_loss", "lambda_dim_o": "dim_o_loss"}


def objective(env, config: Stage1Config, weights: LossWeights) -> tuple[dict[str, float], dict[str, Any]]:
    """The terms of stage 1's loss on one batch of fresh networks, and its gradient."""
    problem = Problem.of(env, config, collect(env, jax.random.key(0), config.episodes))
    state = initial_state(problem, jax.random.key(1))
    batch = problem.batch(jnp.arange(config.batch_size), jax.random.key(2))
    _, estimator_optimizer = optimizers(config, 1, 0.0)

    @jax.jit
    def gradient(weights: LossWeights) -> Any:
        return jax.grad(encoder_loss, has_aux=True)(
            state.parameters, state.estimator, problem, weights, batch, estimator_optimizer)

    gradients, (_, metrics) = gradient(weights)
    return {name: float(value) for name, value in metrics.items()}, gradients


@pytest.mark.lenient
@pytest.mark.parametrize("kl", [0.0, 0.5])
def test_the_loss_is_the_weighted_sum_of_algorithm_1(env, kl):
    """Believer's penalty among its terms where it has a weight (Appendix A.5)."""
    config = dataclasses.replace(SMALL, **WEIGHTS, lambda_kl=kl)
    terms, _ = objective(env, config, LossWeights.of(config))
    expected = sum(WEIGHTS[weight] * terms[term] for weight, term in TERMS.items())
    assert (terms.get("kl", 0.0) > 0) is (kl > 0)
    np.testing.assert_allclose(terms["loss"], expected + kl * terms.get("kl", 0.0), rtol=1e-5)


@pytest.mark.lenient
@pytest.mark.parametrize(("weight", "reached"), [
    ("lambda_r", {"phi", "psi", "dynamics"}), ("lambda_s", {"phi", "psi", "dynamics"}),
    ("lambda_o", {"phi", "psi", "dynamics"}), ("lambda_club", {"phi", "psi"}),
    ("lambda_dim_s", {"phi", "discriminator_s"}), ("lambda_dim_o", {"psi", "discriminator_o"})])
def test_each_term_teaches_the_networks_it_is_about(env, weight, reached):
    alone = LossWeights.of(dataclasses.replace(SMALL, **dict.fromkeys(WEIGHTS, 0.0) | {weight: WEIGHTS[weight]}))
    _, gradients = objective(env, dataclasses.replace(SMALL, **WEIGHTS), alone)
    taught = {name for name, part in gradients.items() if any(np.any(leaf) for leaf in jax.tree.leaves(part))}
    assert taught == reached


@pytest.mark.lenient
def test_the_conditional_bound_asks_for_what_is_hidden_alone(env):
    """On Heaven-Hell: two states that show the same differ in the side; z_s that tells it has nothing left to gain."""
    config = dataclasses.replace(SMALL, **WEIGHTS, state_bound="conditional")
    problem = Problem.of(env, config, collect(env, jax.random.key(0), config.episodes))
    rows = problem.batch(jnp.arange(config.batch_size), jax.random.key(2)).rows
    states, observations = problem.data.states[rows.state], problem.data.observations[rows.observation]
    side = 50.0 * states[:, 2:]
    weight = jnp.full(rows.size, 1 / rows.size)
    assert float(dim_loss(side, side, rows.state, weight, rows.observation)) < 1e-3
    assert float(dim_loss(side, side, rows.state, weight)) > 1.0  # states that differ in place are negatives there
    assert len(np.unique(np.asarray(observations), axis=0)) < len(np.unique(np.asarray(states), axis=0))
    terms, _ = objective(env, config, LossWeights.of(config))
    plain, _ = objective(env, dataclasses.replace(config, state_bound="jensen_shannon"), LossWeights.of(config))
    assert terms["dim_s_loss"] != plain["dim_s_loss"]


@pytest.mark.lenient
def test_next_features_are_predicted_from_actions_and_none_after_the_end(env):
    config = dataclasses.replace(SMALL, episodes=60, batch_size=500)
    problem = Problem.of(env, config, collect(env, jax.random.key(0), config.episodes))
    state, weights = initial_state(problem, jax.random.key(1)), LossWeights.of(config)
    batch = problem.batch(jnp.arange(config.batch_size), jax.random.key(2))
    _, optimizer = optimizers(config, 1, 0.0)

    @jax.jit
    def terms(batch: Batch) -> dict[str, jax.Array]:
        return encoder_loss(state.parameters, state.estimator, problem, weights, batch, optimizer)[1][1]

    rows, f = jax.device_get(batch.rows), features(problem, state.parameters, batch)
    _, guess_s, guess_o = evaluate(problem.networks.dynamics, state.parameters["dynamics"], f.z_s, f.z_o,
                                   problem.networks.encode_action(batch.rows.action))
    goes_on = [i for i in range(rows.size) if not rows.terminal[i]]
    assert 0 < len(goes_on) < rows.size
    total = sum(float(batch.weight[i]) for i in goes_on)
    found = terms(batch)
    for name, guess, target in (("z_s_loss", guess_s, f.next_z_s), ("z_o_loss", guess_o, f.next_z_o)):
        error = sum(float(batch.weight[i]) * np.sum(np.square(guess[i] - target[i])) for i in goes_on) / total
        assert found[name] == pytest.approx(error, rel=1e-4)
    other = dataclasses.replace(batch, rows=dataclasses.replace(batch.rows, action=(batch.rows.action + 1) % 4))
    for name in ("reward_loss", "z_s_loss", "z_o_loss"):
        assert terms(other)[name] != pytest.approx(float(found[name]), rel=1e-4)


@pytest.mark.lenient
def test_the_paper_s_club_sees_features_as_they_are(env):
    config = dataclasses.replace(SMALL, estimator_updates=1)
    found = {view: objective(env, dataclasses.replace(config, estimator_view=view), LossWeights.of(config))[0]["club"]
             for view in ("features", "raw")}
    assert found["features"] != pytest.approx(found["raw"], rel=1e-3)
    z_s, z_o = jnp.arange(6.0).reshape(3, 2), -jnp.arange(6.0).reshape(3, 2)
    for got, given in zip(seen_by_estimator("raw", z_s, z_o, jnp.full(3, 1 / 3)), (z_s, z_o), strict=True):
        np.testing.assert_array_equal(got, given)


@pytest.mark.lenient
def test_step_sizes_fall_as_far_as_they_should():
    zeros = dict.fromkeys(ENCODER_NETWORKS, jnp.zeros(1))
    ones = jax.tree.map(jnp.ones_like, zeros)
    for final, expected in ((0.0, 0.0), (1.0, 0.01), (0.5, 0.005)):
        config = dataclasses.replace(SMALL, learning_rate=0.01, final_learning_rate=final)
        encoders, estimator = optimizers(config, 10, 0.0)
        state = encoders.init(zeros)
        for _ in range(11):
            step, state = encoders.update(ones, state, zeros)
        assert float(cast(Any, step)["psi"][0]) == pytest.approx(-expected, abs=1e-6)
        step, _ = estimator.update(ones, estimator.init(ones))
        assert float(cast(Any, step)["psi"][0]) == pytest.approx(-0.01, rel=1e-4)


def test_directions_of_little_variance_are_seen_as_well():
    generator = np.random.default_rng(0)
    mixed = generator.normal(size=(4000, 3)) * [1.0, 0.05, 1e-4] @ np.linalg.qr(generator.normal(size=(3, 3)))[0]
    weight = jnp.full(4000, 1 / 4000)
    seen = np.asarray(standardize_directions(jnp.asarray(mixed, jnp.float32), weight))
    variance = np.linalg.eigvalsh(np.cov(seen.T))
    np.testing.assert_allclose(variance[1:], [0.96, 1.0], atol=0.02)  # 0.05 squared beside the floor of 1e-4
    assert variance[0] < 1e-3
    np.testing.assert_allclose(seen.mean(0), 0, atol=1e-4)


@pytest.mark.lenient
def test_club_takes_information_out(env):
    ends = []
    for weight in (0.0, 10.0):
        config = dataclasses.replace(SMALL, epochs=40, learning_rate=3e-3, lambda_club=weight, club_ramp=0.0)
        _, history = learn_representation(env, config, jax.random.key(0))
        ends.append(history.metrics["club"][-1])
    assert ends[1] < 0.2 * ends[0]


@pytest.mark.lenient
def test_training_follows_its_key_alone_and_reports_progress(env, learnt):
    epochs = []
    again, history = learn_representation(env, SMALL, jax.random.key(1), lambda n, m: epochs.append((n, m["club"])))
    other, _ = learn_representation(env, SMALL, jax.random.key(2))
    assert [n for n, _ in epochs] == [1, 2]
    assert history.metrics["club"][-1] == epochs[-1][1]
    first = jax.tree.leaves(learnt[0])
    assert all(np.array_equal(a, b) for a, b in zip(first, jax.tree.leaves(again), strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(first, jax.tree.leaves(other), strict=True))


@pytest.mark.lenient
def test_training_tells_observations_apart_and_predicts(env):
    config = dataclasses.replace(SMALL, epochs=60, learning_rate=3e-3)  # the preset's step size
    _, history = learn_representation(env, config, jax.random.key(0))
    for name in ("dim_o_loss", "reward_loss"):
        first, last = history.metrics[name][[0, -1]]
        assert last < 0.5 * first, name


@pytest.mark.lenient
@pytest.mark.parametrize("name", ["heaven_hell", "sphinx"])
def test_training_tells_what_can_be_seen(name: str):
    """From vectors and from images that are taken apart; states are told apart as before."""
    config = dataclasses.replace(SMALL, lower_bound="variables", epochs=40, learning_rate=3e-3)
    _, history = learn_representation(registry.make(name), config, jax.random.key(0))
    first, last = history.metrics["told_o_loss"][[0, -1]]
    assert last < first - 0.5  # nats
    assert "dim_o_loss" not in history.metrics
    assert "dim_s_loss" in history.metrics


def test_variables_are_asked_for_where_there_are_some(env):
    config = dataclasses.replace(SMALL, lower_bound="variables")
    blind = copy.copy(env)
    blind.variables = tuple(variable for variable in env.variables if variable.hidden)
    data = collect(env, jax.random.key(0), config.episodes)
    with pytest.raises(ConfigError, match=r"--stage1\.lower-bound: got 'variables', accepted: 'jensen_shannon'"):
        Problem.of(blind, config, data)


@pytest.mark.lenient
def test_images_train_in_both_ways_of_batching():
    sphinx = registry.make("sphinx")
    for batch_size in (20, 250):  # fewer than the distinct transitions, and more
        config = Stage1Config(episodes=12, epochs=1, batch_size=batch_size, features=4)
        representation, history = learn_representation(sphinx, config, jax.random.key(0))
        assert history.updates >= 1
        frames = jnp.zeros((2, 3, *sphinx.observation_spec.shape), jnp.uint8)
        assert encode_observation(representation, sphinx, frames).shape == (2, 3, 4)


@pytest.mark.parametrize("batch_size", [40, 4000])  # fewer rows than distinct transitions, and more
def test_rewarded_transitions_weigh_in_the_reward_loss_alone(env, batch_size):
    config = dataclasses.replace(SMALL, episodes=100, batch_size=batch_size, rewarded=7)
    data = collect(env, jax.random.key(3), config.episodes)
    problem = Problem.of(env, config, data)
    reward = np.asarray(problem.table.reward)
    assert set(problem.rewarded.tolist()) == set(np.flatnonzero(reward))
    common = np.flatnonzero(np.asarray(data.reward) == 0)
    chosen = jnp.asarray(np.resize(common, batch_size))
    batch = jax.jit(problem.batch)(chosen, jax.random.key(0))
    rewarded = np.asarray(batch.rows.reward) != 0
    assert np.asarray(batch.weight)[rewarded].sum() == 0
    np.testing.assert_allclose([batch.weight.sum(), batch.reward_weight.sum()], 1, rtol=1e-5)
    np.testing.assert_allclose(np.asarray(batch.reward_weight)[rewarded].sum(), 0.5, rtol=1e-5)
    paper = dataclasses.replace(problem, config=dataclasses.replace(config, rewarded=0))
    plain = paper.batch(chosen, jax.random.key(0))
    np.testing.assert_array_equal(plain.weight, plain.reward_weight)


@pytest.mark.lenient
def test_divergence_is_one_line_that_names_the_loss(env):
    with pytest.raises(DivergenceError, match=r"^stage 1: \w+ is (nan|inf|-inf) after epoch \d+; try .*learning-rate"):
        learn_representation(env, dataclasses.replace(SMALL, learning_rate=1e30), jax.random.key(0))


@pytest.mark.lenient
def test_features_that_vanish_are_one_line_that_names_the_option(env):
    with pytest.raises(DivergenceError, match=r"z_s is the same in every state.* try a smaller --stage1.phi-shrinkage"):
        learn_representation(env, dataclasses.replace(SMALL, phi_shrinkage=1e4), jax.random.key(0))


def test_features_that_vanish_are_learnt_again_from_other_weights_and_the_same_data(env, learnt, monkeypatch):
    tried = []

    def data_of(key):
        return tuple(np.asarray(jax.random.key_data(key)))

    def train_on(problem, init_key, train_key, on_progress):
        del on_progress
        tried.append((problem, data_of(init_key), data_of(train_key)))
        if len(tried) < 3:
            raise training.ErasedError("stage 1: z_s is the same in every state")
        return learnt

    monkeypatch.setattr(training, "train_on", train_on)
    representation, history = learn_representation(env, SMALL, jax.random.key(1))
    assert representation is learnt[0]
    assert history.starts == 3
    assert learnt[1].starts == 1
    problems, *keys = zip(*tried, strict=True)
    assert all(problem is problems[0] for problem in problems)
    assert len({*keys[0], *keys[1]}) == 6
    data_key, init_key, train_key = jax.random.split(jax.random.key(1), 3)
    assert (keys[0][0], keys[1][0]) == (data_of(init_key), data_of(train_key))
    assert tuple(np.asarray(problems[0].data.key)) == data_of(data_key)
    tried.clear()
    with pytest.raises(training.ErasedError):
        learn_representation(env, SMALL, jax.random.key(1), starts=2)


@pytest.mark.lenient
def test_a_variance_that_is_not_finite_is_divergence(env, monkeypatch):
    def diverged(problem, state):
        return dataclasses.replace(representation_of(problem, state), z_s_variance=jnp.nan)

    monkeypatch.setattr(training, "representation_of", diverged)
    with pytest.raises(DivergenceError, match=r"variance of z_s is nan after epoch 1; try a smaller --stage1\.learning"
                       ) as error:
        learn_representation(env, dataclasses.replace(SMALL, epochs=1), jax.random.key(0))
    assert not isinstance(error.value, training.ErasedError)


@pytest.mark.lenient
def test_too_little_data_is_an_error(env):
    with pytest.raises(ConfigError, match=r"at most the \d+ transitions"):
        learn_representation(env, dataclasses.replace(SMALL, batch_size=100_000), jax.random.key(0))


def test_moments_of_z_s_are_those_of_the_data(env, learnt):
    representation = learnt[0]
    data = collect(env, jax.random.split(jax.random.key(1), 3)[0], SMALL.episodes)
    z = np.asarray(encode_state(representation, env, data.states), np.float64)[data.state]
    np.testing.assert_allclose(representation.z_s_mean, z.mean(0), atol=1e-5)
    np.testing.assert_allclose(representation.z_s_variance, z.var(0).sum(), rtol=1e-3)


@dataclasses.dataclass
class _Chosen:
    """Parameters of an encoder without hidden layers between: z = x @ matrix."""

    matrix: np.ndarray

    def parameters(self, like: dict) -> dict:
        """Passes (D,) inputs through two ReLU layers unharmed as x and -x."""
        params = jax.tree.map(lambda a: np.zeros(a.shape, np.float32), like)
        size = len(self.matrix)
        for i in range(size):
            params["blocks_0"]["kernel"][i, [2 * i, 2 * i + 1]] = 1, -1
            params["blocks_1"]["kernel"][[2 * i, 2 * i + 1], [2 * i, 2 * i + 1]] = 1
            params["output"]["kernel"][2 * i] = self.matrix[i]
            params["output"]["kernel"][2 * i + 1] = -self.matrix[i]
        return jax.tree.map(jnp.asarray, params)


def _hand_made(learnt, leak: float):
    """z_s = side + leak * x; z_o = (x, y)."""
    z_s, z_o = np.zeros((3, 8), np.float32), np.zeros((3, 8), np.float32)
    z_s[2, 0], z_s[0, 1] = 1, leak
    z_o[0, 0] = z_o[1, 1] = 1
    return learnt[0].replace(phi=_Chosen(z_s).parameters(learnt[0].phi), psi=_Chosen(z_o).parameters(learnt[0].psi),
                             z_s_mean=jnp.zeros(8).at[7].set(1.0))


@pytest.mark.lenient
@pytest.mark.parametrize(("leak", "clean"), [(0.0, True), (1e-7, True), (1e-3, False), (1.0, False)])
def test_probe_sees_a_leak_of_any_size_beyond_round_off(env, learnt, leak, clean):
    report = probe(_hand_made(learnt, leak), env, SMALL, jax.random.key(5))
    found = {(d.variable, d.source): d for d in report.decodings}
    assert found["side", "z_s"].linear == 1.0
    assert found["x", "z_o"].linear > 0.999
    assert report.p1
    assert report.p2 is clean, report.p2_failures
    assert any("x leaks into z_s" in reason for reason in report.p2_failures) is not clean
    assert ("P2 pass" in format_report(report)) is clean
    assert 0.1 * leak - 1e-7 < report.geometry["rest"] < 0.5 * leak + 1e-7  # x is in [0, 1], the side -1 or 1


@pytest.mark.lenient
def test_probe_reports_geometry_bonus_and_errors_as_plain_numbers(env, learnt):
    report = probe(*(_hand_made(learnt, 0.0), env, SMALL, jax.random.key(5)), history=learnt[1])
    np.testing.assert_allclose(report.geometry["cosine"], -1.0, atol=1e-5)
    np.testing.assert_allclose(report.bonus["explained_variance"], 1.0, atol=1e-5)
    assert report.bonus["log_likelihood"] == pytest.approx(1 + 1 / np.log(100), abs=0.02)  # a coin
    np.testing.assert_allclose(report.bonus["cosine"], 1.0, atol=1e-5)
    assert set(report.errors) == {"reward_r2", "next_z_s_error", "next_z_o_error", "club"}
    assert json.loads(json.dumps(report.as_dict()))["p1_failures"] == list(report.p1_failures)


def test_an_empty_or_constant_feature_space_has_no_directions():
    fitted = np.arange(10) < 5
    assert whiten(np.full((10, 3), 2.0, np.float32), fitted).shape == (10, 0)
    assert whiten(np.zeros((10, 3), np.float32), fitted).shape == (10, 0)
    z = np.stack([np.arange(10.0), 100 * ROUND_OFF * (np.arange(10) % 3)], axis=1)
    np.testing.assert_allclose(whiten(z, fitted)[fitted].var(0), 1.0)


def test_thresholds_of_presence_and_absence():
    base = Decoding("side", "z_o", True, "accuracy", linear=0.59, mlp=0.5, chance=0.5)
    assert base.is_absent
    assert not dataclasses.replace(base, mlp=0.62).is_absent
    assert dataclasses.replace(base, mlp=1.0).is_present


def test_a_representation_comes_back_from_its_folder(env, learnt, tmp_path):
    save_representation(learnt[0], env, tmp_path / "a")
    loaded = load_representation(tmp_path / "a", env)
    for a, b in zip(jax.tree.leaves(learnt[0]), jax.tree.leaves(loaded), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not list((tmp_path / "a").glob("*.part"))


def test_bad_folders_are_named_in_one_line(env, learnt, tmp_path):
    folder = tmp_path / "a"
    with pytest.raises(RepresentationError, match="no representation there"):
        load_representation(folder, env)
    save_representation(learnt[0], env, folder)
    with pytest.raises(RepresentationError, match="domain is heaven_hell"):
        load_representation(folder, registry.make("sphinx"))
    content = (folder / PARAMETERS_FILE).read_bytes()
    for damaged in (content[: len(content) // 2], b"", b"garbage"):
        (folder / PARAMETERS_FILE).write_bytes(damaged)
        with pytest.raises(RepresentationError, match=r"is damaged \(\w+\)$"):
            load_representation(folder, env)
    (folder / PARAMETERS_FILE).unlink()
    with pytest.raises(RepresentationError, match="is missing"):
        load_representation(folder, env)
    (folder / "representation.json").write_text("{")
    with pytest.raises(RepresentationError, match="damaged"):
        load_representation(folder, env)


@pytest.mark.lenient
def test_the_command_learns_probes_and_keeps(tmp_path, capsys):
    options = ["--out", str(tmp_path / "run"), "--seeds", "3,", "--stage1.epochs", "1", "--stage1.episodes", "20",
               "--stage1.heldout-episodes", "10", "--stage1.batch-size", "200"]
    assert represent.main(["--domain", "heaven_hell", *options]) == 0
    shown = capsys.readouterr().out
    assert "P1" in shown
    assert "of 1 representations pass" in shown
    folder = tmp_path / "run" / "seed_3" / "representation"
    assert json.loads((folder / "probe.json").read_text())["domain"] == "heaven_hell"
    load_representation(folder, registry.make("heaven_hell"))
    made = (folder / "representation.msgpack").stat().st_mtime_ns
    assert represent.main(["--domain", "heaven_hell", *options]) == 0  # goes on where it was: at the end
    assert "of 1 representations pass" in capsys.readouterr().out
    assert (folder / "representation.msgpack").stat().st_mtime_ns == made
    assert represent.main(["--domain", "heaven_hell", *options, "--seeds", "2,3"]) == 0  # one more
    assert "of 2 representations pass" in capsys.readouterr().out
    assert (folder / "representation.msgpack").stat().st_mtime_ns == made
    run = RunFolder.open(tmp_path / "run")
    assert run.seeds() == (2, 3)
    assert (run.config()["seed_list"], run.config()["seeds"]) == ([2, 3], "2,3,")
    assert represent.main(["--domain", "heaven_hell", *options, "--stage1.lambda-r", "2"]) == 1
    assert "was made with another --stage1.lambda-r; choose another --out" in capsys.readouterr().err
    assert represent.main(["--domain", "heaven_hell", *options, "--search", "2"]) == 1
    assert "choose another --out" in capsys.readouterr().err


@pytest.mark.lenient
def test_options_that_nothing_can_be_learnt_with_leave_no_folder(tmp_path, capsys):
    options = ["--stage1.epochs", "2", "--stage1.episodes", "20", "--stage1.learning-rate", "1e9"]
    assert represent.main(["--domain", "heaven_hell", *options, "--out", str(tmp_path / "run")]) == 1
    assert "try a smaller --stage1.learning-rate" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("options", [["--domain", "nowhere"], ["--seeds", "x"], ["--seeds", "0"]])
def test_the_command_refuses_in_one_line(options, tmp_path, capsys):
    assert represent.main([*options, "--out", str(tmp_path / "run")]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1

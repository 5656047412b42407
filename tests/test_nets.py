"""Memories and networks: acting step by step, packing and padding change nothing, and nobody sees the future."""

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tokens import DISCRETE, Shapes, random_like

from envs_mjx.base import ArraySpec
from mijax.agents.dqn import DQN, make_dqn
from mijax.config import Config, MemoryName, NetworkConfig, Stage1Config
from mijax.frames import FrameTable
from mijax.losses.information import LEAST_LOG_VARIANCE
from mijax.nets.dropout import Dropout
from mijax.nets.gpt import sine_positions
from mijax.packing import Layout, first_fit, gather_rows, one_per_row
from mijax.replay import Replay, StepRecord
from mijax.types import Params, Tokens

LENGTHS = (3, 8, 5, 2)
ROW = 8  # tokens of a full-length episode
FEATURES = 5
VECTOR, IMAGE = ArraySpec((2,)), ArraySpec((4, 4, 2), np.uint8)
TINY = NetworkConfig(layers=2, action_embedding=4, observation_embedding=4, gru_width=6, critic_hidden=(8,),
                     auxiliary_hidden=(8,))
MEMORIES: tuple[MemoryName, ...] = ("gpt", "gru")


def agent_of(memory: MemoryName, spec: ArraySpec = VECTOR, network: NetworkConfig = TINY) -> DQN:
    config = Config(agent="mi", memory=memory, network=network, stage1=Stage1Config(features=FEATURES))
    return make_dqn(Shapes(DISCRETE, spec, VECTOR, ROW - 1), config)


def stored_episodes(spec: ArraySpec = VECTOR) -> Replay:
    """A replay that holds one finished episode of each of `LENGTHS`; what follows an episode's end is garbage."""
    rng = np.random.default_rng(0)
    shape = (len(LENGTHS), ROW)
    observation = rng.integers(0, 2, (*shape, *spec.shape)) if spec.is_image else rng.normal(size=(*shape, *spec.shape))
    previous_action = rng.integers(0, DISCRETE.num, shape)
    previous_action[:, 0] = -1
    data = StepRecord(
        observation=jnp.asarray(observation, spec.dtype),
        previous_action=jnp.asarray(previous_action, jnp.int8),
        reward=jnp.asarray(rng.normal(size=shape), jnp.float32),
        terminated=jnp.asarray(np.arange(ROW) == np.array(LENGTHS)[:, None] - 1),
        truncated=jnp.zeros(shape, bool),
        z_s=jnp.asarray(rng.normal(size=(*shape, FEATURES)), jnp.float32),
    )
    slots = jnp.arange(len(LENGTHS), dtype=jnp.int32)
    return Replay(data, jnp.array(LENGTHS, jnp.int32), slots, slots[:0], jnp.int32(len(LENGTHS)))


def tokens_in(layout: Layout, rows: int, spec: ArraySpec = VECTOR) -> Tokens:
    return gather_rows(stored_episodes(spec), jnp.arange(len(LENGTHS), dtype=jnp.int32), layout, rows, None)


def listed(tokens: Tokens) -> Tokens:
    """The same observations as entries of a list of all there are."""
    frames, index = np.unique(np.asarray(tokens.frames), axis=0, return_inverse=True)
    frame = jnp.asarray(index.reshape(tokens.segment.shape), jnp.int32)
    return dataclasses.replace(tokens, frames=FrameTable(frames), frame=frame)


def packed(spec: ArraySpec = VECTOR) -> tuple[Layout, Tokens]:
    layout = first_fit(jnp.array(LENGTHS, jnp.int32), ROW)
    assert int(layout.num_rows) == 3  # 8 | 5 + 3 | 2 and padding
    return layout, tokens_in(layout, 3, spec)


def of_episodes(x: jax.Array, layout: Layout) -> np.ndarray:
    """(R, L, ...) packed -> (sum of LENGTHS, ...), episode after episode."""
    starts = zip(layout.row.tolist(), layout.offset.tolist(), LENGTHS, strict=True)
    return np.concatenate([np.asarray(x)[row, offset : offset + length] for row, offset, length in starts])


def some_parameters(module: nn.Module, tokens: Tokens) -> Params:
    """Parameters large enough that attention is not uniform."""
    return random_like(jax.eval_shape(module.init, jax.random.key(1), tokens)["params"], 0.4)


@pytest.fixture(scope="module", params=MEMORIES)
def memory(request: pytest.FixtureRequest) -> MemoryName:
    return request.param


class Case:
    """One network and its outputs on episodes in rows of their own."""

    def __init__(self, memory: MemoryName) -> None:
        self.memory: MemoryName = memory
        self.agent = agent_of(memory)
        self.module = self.agent.network
        self.layout = one_per_row(len(LENGTHS))
        self.tokens = tokens_in(self.layout, len(LENGTHS))
        self.params = some_parameters(self.module, self.tokens)

        def apply(params: Params, tokens: Tokens) -> tuple[jax.Array, jax.Array]:
            outputs: Any = self.module.apply({"params": params}, tokens)
            return outputs.q, outputs.z_s

        self.apply = jax.jit(apply)
        self.q, self.predicted = self.apply(self.params, self.tokens)

    def check_same(self, tokens: Tokens, layout: Layout) -> None:
        """The outputs on `tokens` equal those in rows of their own."""
        q, predicted = self.apply(self.params, tokens)
        for got, expected in ((q, self.q), (predicted, self.predicted)):
            np.testing.assert_allclose(of_episodes(got, layout), of_episodes(expected, self.layout), atol=1e-5)


@pytest.fixture(scope="module")
def case(memory: MemoryName) -> Case:
    return Case(memory)


def test_outputs_have_a_value_per_token(case: Case):
    assert case.q.shape == (len(LENGTHS), ROW, DISCRETE.num)
    assert case.predicted.shape == (len(LENGTHS), ROW, FEATURES)
    assert case.q.dtype == case.predicted.dtype == jnp.float32


def test_step_by_step_equals_the_full_pass(case: Case):
    step = jax.jit(lambda state, observation, action: case.module.apply(
        {"params": case.params}, state, observation, action, method="step"))
    state = case.agent.initial_memory(len(LENGTHS))
    observation = jnp.asarray(case.tokens.frames).reshape(len(LENGTHS), ROW, *VECTOR.shape)
    values = []
    for t in range(ROW):
        state, q = step(state, observation[:, t], case.tokens.previous_action[:, t])
        values.append(q)
    assert state.position.tolist() == [ROW] * len(LENGTHS)
    np.testing.assert_allclose(of_episodes(jnp.stack(values, 1), case.layout), of_episodes(case.q, case.layout),
                               atol=1e-5)


def test_packing_changes_nothing(case: Case):
    layout, tokens = packed()
    case.check_same(tokens, layout)


def test_encoding_listed_observations_once_changes_nothing(case: Case):
    layout, tokens = packed()
    case.check_same(listed(tokens), layout)


def change(tokens: Tokens, where: np.ndarray) -> Tokens:
    """Other observations, actions and features at the tokens (R, L) `where`; every frame is one token's."""
    mask = jnp.asarray(where)
    return tokens.replace(  # pyright: ignore[reportAttributeAccessIssue]
        frames=jnp.where(mask.reshape(-1, 1), 9.0, jnp.asarray(tokens.frames)),
        previous_action=jnp.where(mask, 2 - jnp.maximum(tokens.previous_action, 0), tokens.previous_action),
        z_s=None if tokens.z_s is None else jnp.where(mask[..., None], 7.0, tokens.z_s),
    )


def test_the_future_does_not_change_the_past(case: Case):
    for t in (1, 4):
        where = np.zeros((len(LENGTHS), ROW), bool)
        where[:, t:] = True
        q, predicted = case.apply(case.params, change(case.tokens, where))
        np.testing.assert_array_equal(q[:, :t], case.q[:, :t])
        np.testing.assert_array_equal(predicted[:, :t], case.predicted[:, :t])
        assert (np.abs(q[:, t] - case.q[:, t]).max(-1) > 1e-3).all()


def test_the_past_is_remembered(case: Case):
    where = np.zeros((len(LENGTHS), ROW), bool)
    where[:, 0] = True
    q, _ = case.apply(case.params, change(case.tokens, where))
    assert (np.abs(of_episodes(q - case.q, case.layout)).max(-1) > 1e-6).all()


def test_padding_changes_neither_results_nor_gradients(case: Case):
    layout, tokens = packed()
    padding = np.asarray(tokens.segment == 0)
    assert padding.any()
    other = change(tokens, padding)
    case.check_same(other, layout)

    @jax.jit
    @jax.grad
    def gradient(params: Params, tokens: Any) -> jax.Array:
        outputs: Any = case.module.apply({"params": params}, tokens)
        q, predicted = outputs.q, outputs.z_s
        real = (tokens.segment > 0).astype(jnp.float32)[..., None]
        return jnp.sum(jnp.square(q) * real) + jnp.sum(jnp.square(predicted - tokens.z_s) * real)

    of_packed = gradient(case.params, tokens)
    jax.tree.map(np.testing.assert_array_equal, of_packed, gradient(case.params, other))
    alone = gradient(case.params, case.tokens)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-4), of_packed, alone)


def test_information_model_packs(case: Case):
    assert case.agent.information_model is not None
    model = case.agent.information_model.clone(has_variance=True)
    layout, tokens = packed()
    params = some_parameters(model, tokens)
    apply = jax.jit(lambda tokens: model.apply({"params": params}, tokens))
    one, other = apply(tokens), apply(case.tokens)
    got, expected = of_episodes(one.mean, layout), of_episodes(other.mean, case.layout)
    assert got.shape == (sum(LENGTHS), FEATURES)
    np.testing.assert_allclose(got, expected, atol=1e-5)
    got, expected = of_episodes(one.log_variance, layout), of_episodes(other.log_variance, case.layout)
    assert got.shape == (sum(LENGTHS),)
    assert np.ptp(got) > 1e-4
    assert LEAST_LOG_VARIANCE <= got.min() <= got.max() <= 0
    np.testing.assert_allclose(got, expected, atol=1e-5)


@pytest.mark.lenient  # LayerNorm averages bfloat16 in float32
def test_images_in_half_precision(memory: MemoryName):
    layout, tokens = packed(IMAGE)
    exact = agent_of(memory, IMAGE)
    half = agent_of(memory, IMAGE, dataclasses.replace(TINY, dtype="bfloat16"))
    params = some_parameters(half.network, tokens)
    assert {x.dtype for x in jax.tree.leaves(params)} == {jnp.dtype(jnp.float32)}
    q, exact_q = (jax.jit(agent.network.apply)({"params": params}, tokens).q for agent in (half, exact))
    assert q.dtype == jnp.float32
    q, exact_q = of_episodes(q, layout), of_episodes(exact_q, layout)
    assert 0 < np.abs(q - exact_q).max() < 0.1 * np.abs(exact_q).max()
    state = half.initial_memory(2)
    state, action = jax.jit(half.act)(params, state, jnp.asarray(tokens.frames)[:2], jnp.array([-1, 0]))
    assert action.shape == (2,)
    assert {x.dtype for x in jax.tree.leaves(state.recurrent)} == {jnp.dtype(jnp.bfloat16)}


def test_dropout_is_off_unless_asked_for():
    network = agent_of("gpt", network=dataclasses.replace(TINY, layers=1, dropout=0.5)).network
    _, tokens = packed()
    params = {"params": some_parameters(network, tokens)}
    apply: Any = network.apply
    dropped = jax.jit(lambda key: apply(params, tokens, False, rngs={"dropout": key}).q)
    assert not np.allclose(dropped(jax.random.key(0)), dropped(jax.random.key(1)))
    network.apply(params, tokens)  # needs no key


@pytest.mark.parametrize("rate", [0.1, 0.5])
def test_dropout_zeroes_its_share_and_keeps_the_mean(rate: float):
    """And neighbours do not depend on one another."""
    x = jnp.ones((401, 127))
    y = np.asarray(Dropout(rate).apply({}, x, False, rngs={"dropout": jax.random.key(0)}))
    kept, share = y > 0, 1 - round(rate * 256) / 256
    noise = np.sqrt(share * (1 - share) / y.size)
    assert kept.mean() == pytest.approx(share, abs=4 * noise)
    np.testing.assert_allclose(y[kept], 1 / share, rtol=1e-6)
    flat = kept.reshape(-1)
    for apart in (1, 2, 3, 4, 127):
        assert np.mean(flat[:-apart] & flat[apart:]) == pytest.approx(share**2, abs=5 * noise)


def test_sine_positions():
    code = sine_positions(5, 7)
    assert code.shape == (5, 7)
    assert code[3, 0] == pytest.approx(np.sin(3))
    assert code[3, 1] == pytest.approx(np.cos(3))
    assert code[3, 6] == pytest.approx(np.sin(3 / 10_000 ** (6 / 7)), rel=1e-5)

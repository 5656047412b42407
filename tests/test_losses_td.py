"""Targets and the Double-DQN loss against plain loops."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mijax.losses import td
from mijax.losses.masks import masked_mean
from mijax.losses.returns import traced_returns

returns_of = jax.jit(traced_returns)


def backward_loop(reward: np.ndarray, discount: np.ndarray, value: np.ndarray, trace: np.ndarray) -> np.ndarray:
    """G_{t-1} = r_t + discount_t ((1 - trace_t) v_t + trace_t G_t), one row and one step at a time."""
    targets = np.zeros(reward.shape)
    for row in np.ndindex(reward.shape[:-1]):
        later = 0.0
        for t in reversed(range(reward.shape[-1])):
            mixed = (1 - trace[row][t]) * value[row][t] + trace[row][t] * later
            later = targets[row][t] = reward[row][t] + discount[row][t] * mixed
    return targets


def random_transitions(rng: np.random.Generator, shape: tuple[int, ...]) -> list[np.ndarray]:
    """Rewards, discounts with ends, values, and traces cut at random and at the end of each row."""
    reward, value = rng.normal(size=shape), rng.normal(size=shape)
    discount = 0.9 * (rng.random(shape) > 0.2)
    trace = rng.random(shape) * (rng.random(shape) > 0.3)
    trace[..., -1] = 0
    return [x.astype(np.float32) for x in (reward, discount, value, trace)]


def test_double_q_value_takes_the_target_of_the_online_choice():
    online = jnp.array([[1.0, 3.0, 2.0], [5.0, 0.0, 5.0]])  # the first of equals is chosen
    target = jnp.array([[10.0, 20.0, 30.0], [7.0, 8.0, 9.0]])
    assert td.double_q_value(online, target).tolist() == [20.0, 7.0]


def test_what_is_greedy_within_a_tolerance():
    q, action = jnp.array([[1.0, 3.0, 2.75], [5.0, 0.0, 5.0]]), jnp.array([2, 2])
    assert td.is_greedy(q, action).tolist() == [False, True]  # equals are as good
    assert td.is_greedy(q, action, 0.25).tolist() == [True, True]
    assert td.is_greedy(q, jnp.array([0, 1]), 1.5).tolist() == [False, False]


@pytest.mark.parametrize("shape", [(1,), (5, 13), (2, 3, 6)])
def test_returns_equal_a_backward_loop(shape: tuple[int, ...]):
    inputs = random_transitions(np.random.default_rng(0), shape)
    got = returns_of(*map(jnp.asarray, inputs))
    np.testing.assert_allclose(got, backward_loop(*inputs), rtol=1e-5, atol=1e-5)


def test_returns_of_packed_segments_do_not_mix():
    """Two episodes in one row: a trace of 0 on the last transition of the first keeps the second one out."""
    inputs = random_transitions(np.random.default_rng(1), (1, 8))
    inputs[3][:, 3] = 0
    whole = returns_of(*map(jnp.asarray, inputs))
    for part in (slice(0, 4), slice(4, 8)):
        alone = returns_of(*(jnp.asarray(x[:, part]) for x in inputs))
        np.testing.assert_allclose(whole[:, part], alone, rtol=1e-6)


def test_without_traces_the_return_is_the_one_step_target():
    reward, discount, value = jnp.array([1.0, 2.0]), jnp.array([0.5, 0.0]), jnp.array([8.0, 9.0])
    assert traced_returns(reward, discount, value, jnp.zeros(2)).tolist() == [5.0, 2.0]


def test_with_full_traces_the_return_is_the_discounted_sum():
    got = traced_returns(jnp.ones(3), jnp.array([0.5, 0.5, 0.0]), jnp.full(3, 99.0), jnp.array([1.0, 1.0, 0.0]))
    assert got.tolist() == [1.75, 1.5, 1.0]


def test_td_loss_counts_only_valid_transitions():
    q = jnp.array([[[1.0, 2.0], [3.0, 4.0], [50.0, 60.0]]])
    action = jnp.array([[1, 0, -1]])  # -1: the first token of the next episode
    target = jnp.array([[5.0, 1.0, 1e6]])
    loss, metrics = td.td_loss(q, action, target, jnp.array([[True, True, False]]))
    assert float(loss) == ((5 - 2) ** 2 + (1 - 3) ** 2) / 2
    assert float(metrics["q"]) == (2 + 3) / 2
    assert float(metrics["td_error"]) == (3 + 2) / 2
    nothing, _ = td.td_loss(q, action, target, jnp.zeros((1, 3), bool))
    assert float(nothing) == 0


def test_gradient_reaches_chosen_values_of_valid_transitions_only():
    q = jnp.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    action, mask = jnp.array([1, 0, 0]), jnp.array([True, True, False])
    target = jnp.array([5.0, 1.0, 7.0])
    of_q, of_target = jax.grad(lambda q, target: td.td_loss(q, action, target, mask)[0], (0, 1))(q, target)
    assert of_q.tolist() == [[0.0, -3.0], [2.0, 0.0], [0.0, 0.0]]  # -2 error / 2 transitions
    assert not of_target.any()


def test_shapes_that_would_broadcast_are_errors():
    row, column = jnp.zeros((1, 3)), jnp.zeros((3, 1))
    q, action, mask = jnp.zeros((1, 3, 2)), jnp.zeros((1, 3), int), jnp.ones((1, 3), bool)
    with pytest.raises(AssertionError):
        td.double_q_value(jnp.zeros((3, 2)), jnp.zeros((1, 2)))
    with pytest.raises(AssertionError):
        traced_returns(row, row, row, column)
    with pytest.raises(AssertionError):
        traced_returns(row, jnp.zeros((1, 1)), row, row)
    for arguments in ((q, action, column, mask), (q, action, row, mask.T), (q, action.T, row, mask),
                      (q[:, :1], action, row, mask), (q[0], action, row, mask)):
        with pytest.raises((AssertionError, ValueError)):
            td.td_loss(*arguments)


def test_masked_mean_is_zero_when_nothing_is_valid():
    x = jnp.array([1.0, 2.0, 30.0])
    assert float(masked_mean(x, jnp.array([True, True, False]))) == 1.5
    assert float(masked_mean(x.at[2].set(jnp.nan), jnp.array([True, True, False]))) == 1.5
    assert float(masked_mean(x, jnp.zeros(3, bool))) == 0


def test_losses_need_no_physics():
    code = ("import sys, importlib, pkgutil; from mijax import losses; "
            "[importlib.import_module(f'mijax.losses.{m.name}') for m in pkgutil.iter_modules(losses.__path__)]; "
            "assert not {'mujoco', 'brax', 'envs_mjx', 'mijax.nets'} & set(sys.modules)")
    subprocess.run([sys.executable, "-c", code], check=True)

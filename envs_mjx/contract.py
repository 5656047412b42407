"""The check that an environment keeps the contract of `envs_mjx.base`."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.base import (
    ArraySpec,
    ContinuousActions,
    Demonstrations,
    DiscreteActions,
    Environment,
    EnvState,
    TimeStep,
    shows_again,
)
from envs_mjx.errors import UserError, one_line

_EPISODES = 16
_MOST_STEPS = 1000
"""Longer episodes are not played to their end."""


class ContractError(UserError):
    """An environment breaks the contract of `envs_mjx.base`; the message tells where, and what is expected."""


def check_contract(env: Environment, num_steps: int = 3) -> None:
    """Check `env` by abstract evaluation, and by whole random episodes, mapped and compiled.

    Args:
        env: any environment.
        num_steps: after how many steps the numbers are looked at, too.

    Raises:
        ContractError: with one line that names what is wrong and what is expected.
    """
    _check_declarations(env)
    key = jax.random.key(0)
    action = env.action_spec.sample(key)
    env_state, first = _evaluate(env, "reset", lambda k: env.reset(k), key)
    next_state, later = _evaluate(env, "step", env.step, key, env_state, action)
    for place, timestep in (("reset", first), ("step", later)):
        _check_timestep(env, place, timestep)
    _check_same_structure(env, "step", env_state, next_state)
    for place, function, expected in (
        ("ground_truth", env.ground_truth, ArraySpec((len(env.variables),))),
        ("reveals", env.reveals, ArraySpec((), bool)),
    ):
        _check_array(env, place, _evaluate(env, place, function, env_state), expected)
    _check_array(env, "success", _evaluate(env, "success", env.success, later), ArraySpec((), bool))
    moved_state, moved_action = _evaluate(env, "augment", env.augment, key, env_state, action)
    _check_same_structure(env, "augment", env_state, moved_state)
    _check_array(env, "action of augment", moved_action, ArraySpec(action.shape, action.dtype))
    _check_demonstrations(env, key, env_state, action)
    listed = env.all_observations()
    if listed is not None:
        _check_list(env, listed)
    _check_episodes(env, num_steps, set() if listed is None else {_bits(seen) for seen in listed})


def _require(env: Environment, condition: bool, place: str, got: object, expected: str) -> None:
    if not condition:
        raise ContractError(f"environment {getattr(env, 'name', type(env).__name__)!r}: {place} is {got!r}, "
                            f"expected {expected}")


def _check_declarations(env: Environment) -> None:
    for attribute, kind in (
        ("name", str), ("horizon", int), ("observation_spec", ArraySpec), ("state_spec", ArraySpec),
        ("action_spec", (DiscreteActions, ContinuousActions)), ("variables", tuple),
    ):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        value = getattr(env, attribute, None)
        _require(env, isinstance(value, kinds), attribute, value, " or ".join(k.__name__ for k in kinds))
    try:
        hash(env)
    except TypeError:
        raise ContractError(f"environment {env.name!r}: cannot be hashed, as programs compiled for it are kept by it; "
                            "expected a plain class, or @dataclasses.dataclass(eq=False)") from None
    for name, spec in (("observation_spec", env.observation_spec), ("state_spec", env.state_spec)):
        _require(env, len(spec.shape) in (1, 3) and min(spec.shape) >= 1, f"the shape of {name}", spec.shape,
                 "a vector (D,) or an image (rows, columns, channels)")
    _require(env, env.horizon >= 1, "horizon", env.horizon, "at least 1 step")
    size = env.action_spec.num if isinstance(env.action_spec, DiscreteActions) else env.action_spec.size
    _require(env, size >= 1, "the number of actions", size, "at least 1")


_PAIRS = {"reset": (TimeStep, "(env_state, TimeStep)"), "step": (TimeStep, "(env_state, TimeStep)"),
          "augment": (jax.ShapeDtypeStruct, "(env_state, action)")}
"""Methods that return an `EnvState` and something else: what it is, in eyes of `jax.eval_shape` and of people."""


def _evaluate(env: Environment, place: str, function: Callable, *args: object) -> Any:
    """Shapes and types of what `function` returns."""
    try:
        result = jax.eval_shape(function, *args)
    except Exception as error:  # whatever tracing raises
        raise ContractError(f"environment {env.name!r}: {place} cannot be traced by JAX: {one_line(error)}") from error
    if place in _PAIRS:
        kind, expected = _PAIRS[place]
        good = isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], kind)
        _require(env, good, f"what {place} returns", type(result).__name__, expected)
    return result


def _check_array(env: Environment, place: str, array: object, expected: ArraySpec) -> None:
    """`array` is an abstract or a real array of `expected` shape and type."""
    shape, dtype = getattr(array, "shape", None), getattr(array, "dtype", None)
    got = f"{dtype}{list(shape)}" if shape is not None else type(array).__name__
    wanted = expected.dtype if jnp.issubdtype(expected.dtype, jax.dtypes.extended) else np.dtype(expected.dtype)
    _require(env, shape == tuple(expected.shape) and dtype == wanted, place, got, f"{wanted}{list(expected.shape)}")


def _check_timestep(env: Environment, place: str, timestep: TimeStep) -> None:
    for field, expected in (
        ("observation", env.observation_spec), ("state", env.state_spec), ("reward", ArraySpec(())),
        ("terminated", ArraySpec((), bool)), ("truncated", ArraySpec((), bool)),
    ):
        _check_array(env, f"{field} of {place}", getattr(timestep, field), expected)


def _check_same_structure(env: Environment, place: str, before: EnvState, after: EnvState, lead: tuple = ()) -> None:
    """`after` is an abstract EnvState like `before`, with leading axes `lead`."""
    structures = jax.tree.structure(before), jax.tree.structure(after)
    _require(env, structures[0] == structures[1], f"the EnvState of {place}", str(structures[1]),
             f"the structure that reset returns, {structures[0]}")
    for (path, leaf), other in zip(jax.tree.leaves_with_path(before), jax.tree.leaves(after), strict=True):
        _check_array(env, f"EnvState{jax.tree_util.keystr(path)} of {place}", other,
                     ArraySpec((*lead, *leaf.shape), leaf.dtype))


def _check_demonstrations(env: Environment, key: jax.Array, env_state: EnvState, action: jax.Array) -> None:
    """Abstractly: what an environment with an expert has to offer."""
    number = 2
    shown = _evaluate(env, "demonstrations", lambda key: env.demonstrations(key, number), key)
    if shown is None:
        return
    _require(env, isinstance(shown, Demonstrations), "what demonstrations returns", type(shown).__name__,
             "Demonstrations or None")
    _check_same_structure(env, "demonstrations", env_state, shown.env_state, (number, env.horizon + 1))
    actions = ArraySpec((number, env.horizon, *action.shape), action.dtype)
    for name, expected in (
        ("action", actions), ("length", ArraySpec((number,), np.int32)), ("success", ArraySpec((number,), bool)),
        *([] if shown.intended is None else [("intended", actions)]),
    ):
        _check_array(env, f"{name} of demonstrations", getattr(shown, name), expected)
    _check_timestep(env, "show", _evaluate(env, "show", env.show, env_state))


def _check_list(env: Environment, listed: object) -> None:
    _require(env, isinstance(listed, np.ndarray) and len(listed) > 0, "all_observations", type(listed).__name__,
             "an ndarray that is not empty, or None")
    listed = np.asarray(listed)
    _check_array(env, "an entry of all_observations", listed[0], env.observation_spec)
    different = len(np.unique(listed.reshape(len(listed), -1), axis=0))
    _require(env, different == len(listed), "the number of different observations in all_observations", different,
             f"{len(listed)}, each once")


def _check_episodes(env: Environment, num_values: int, listed: set[bytes]) -> None:
    """Random episodes, side by side, to their ends; values are looked at for some steps of the first."""
    reset = jax.jit(jax.vmap(env.reset))

    @jax.jit
    def step(key: jax.Array, env_state: EnvState) -> tuple[jax.Array, EnvState, TimeStep]:
        keys = jax.random.split(key, _EPISODES)
        return keys, *jax.vmap(env.step)(keys, env_state, jax.vmap(env.action_spec.sample)(keys))

    env_state, timestep = reset(jax.random.split(jax.random.key(1), _EPISODES))
    first, shown = jax.tree.map(lambda x: x[0], (env_state, timestep))
    _require(env, float(shown.reward) == 0, "reward of reset", float(shown.reward), "0")
    _require(env, not bool(shown.done), "terminated or truncated of reset", True, "False")
    _check_values(env, "reset", first, shown)
    _check_listed(env, "reset", timestep, np.ones(_EPISODES, bool), listed)
    running, ends = np.ones(_EPISODES, bool), []
    for time, key in enumerate(jax.random.split(jax.random.key(2), min(env.horizon, _MOST_STEPS))):
        keys, env_state, timestep = step(key, env_state)
        if time < num_values and running[0]:
            first, shown = jax.tree.map(lambda x: x[0], (env_state, timestep))
            _check_timestep(env, "step", shown)
            _check_values(env, "step", first, shown)
        if time == 0 and shows_again(env):
            _check_shown_again(env, env_state, timestep)
        _check_listed(env, "step", timestep, running, listed)
        ended = running & np.asarray(timestep.terminated | timestep.truncated)
        if ended.any():
            ends += _at_ends(reset, ended, keys, env_state)
        running &= ~ended
        if not running.any():
            break
    if running.any() and env.horizon <= _MOST_STEPS:
        raise ContractError(f"environment {env.name!r}: an episode is not over after its horizon of {env.horizon} "
                            "steps, expected terminated or truncated there at the latest")
    if _resets(ends):
        raise ContractError(f"environment {env.name!r}: step returns the first moment of a new episode where one ends, "
                            "expected the last moment of the old one: who runs the environment resets it")


def _at_ends(reset: Callable, ended: np.ndarray, keys: jax.Array, env_state: EnvState) -> list[list[bytes]]:
    """What each episode that ended remembers, and what `reset` does under the step's key or one split from that."""
    split = jax.vmap(jax.random.split)(keys)
    remembered = [env_state, *(reset(k)[0] for k in (keys, split[:, 0], split[:, 1]))]
    return [[_as_bytes(x, int(row)) for x in remembered] for row in np.flatnonzero(ended)]


def _as_bytes(env_state: EnvState, row: int) -> bytes:
    """What one of the environments remembers."""
    leaves = jax.tree.leaves(env_state)
    numbers = (jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x for x in leaves)
    return b"".join(np.asarray(x)[row].tobytes() for x in numbers)


def _resets(ends: list[list[bytes]]) -> bool:
    """Whether every episode ended where a new one starts: of all, and unless all start alike, as that may be chance."""
    if len(ends) < _EPISODES:
        return False
    actual, *starts = zip(*ends, strict=True)
    return any(actual == start and len(set(start)) > 1 for start in starts)


def _check_listed(env: Environment, place: str, timestep: TimeStep, running: np.ndarray, listed: set[bytes]) -> None:
    """Every observation of the `running` episodes is in the list: one that is not would be stored as another."""
    for seen in np.asarray(timestep.observation)[running] if listed else ():
        _require(env, _bits(seen) in listed, f"observation of {place}", _one_line_of(seen),
                 "one listed by all_observations")


def _bits(observation: np.ndarray) -> bytes:
    """The same for 0.0 and -0.0, which are one number."""
    return (observation + np.zeros((), observation.dtype)).tobytes()


def _check_shown_again(env: Environment, env_state: EnvState, timestep: TimeStep) -> None:
    """`show` shows what `step` did, but for rounding, as it stands in for it in the replay."""
    again = jax.jit(jax.vmap(env.show))(env_state)
    _check_timestep(env, "show", jax.tree.map(lambda x: x[0], again))
    for field in ("observation", "state"):
        first, second = (np.asarray(getattr(shown, field), np.float64) for shown in (timestep, again))
        _require(env, np.allclose(first, second, rtol=1e-3, atol=1e-3), f"the largest change of {field} by show",
                 float(np.max(np.abs(first - second))), "0, as it is to be what reset or step showed")


def _check_values(env: Environment, place: str, env_state: EnvState, timestep: TimeStep) -> None:
    for field in ("observation", "state", "reward"):
        value = np.asarray(getattr(timestep, field))
        if np.issubdtype(value.dtype, np.floating):
            _require(env, bool(np.isfinite(value).all()), f"{field} of {place}", "not finite", "finite numbers")
    for field, spec in (("observation", env.observation_spec), ("state", env.state_spec)):
        empty = np.asarray(getattr(timestep, field))[..., spec.shape[-1] - spec.blank :] if spec.blank else np.zeros(1)
        _require(env, not empty.any(), f"the blank channels of {field} of {place}", "not 0", "0, as the spec declares")
    truth = np.asarray(env.ground_truth(env_state))
    for variable, value in zip(env.variables, truth, strict=True):
        if variable.num_values is not None:
            _require(env, value in range(variable.num_values), f"ground truth {variable.name!r} after {place}",
                     float(value), f"a class in 0 .. {variable.num_values - 1}")


def _one_line_of(array: np.ndarray) -> str:
    return " ".join(np.array_str(array).split())[:100]

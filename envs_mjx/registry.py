"""Names of environments, and the check that an environment keeps the contract of `envs_mjx.base`.

An environment of your own needs no registration: `make("package.module:EnvClass")` imports it, also from the current
directory. `register` gives it a short name. Arguments of the environment follow its name:
`make("block_pulling,noise=0.007,stop_force=12.5")`.
"""

import ast
import importlib
import inspect
import os
import sys
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
)

Factory = Callable[..., Environment] | str
"""Makes an environment: a callable (a class, say), or "package.module:EnvClass", imported only when it is made."""


class UnknownDomain(ValueError):
    """No environment of that name can be made; the message tells which can."""


class ContractError(TypeError):
    """An environment breaks the contract of `envs_mjx.base`; the message tells where, and what is expected."""


_factories: dict[str, Factory] = {
    "heaven_hell": "envs_mjx.grid:HeavenHell",
    "sphinx": "envs_mjx.grid:Sphinx",
    "carflag_2d": "envs_mjx.grid:CarFlag2D",
    "block_pulling": "envs_mjx.robot:BlockPulling",
    "block_pushing": "envs_mjx.robot:BlockPushing",
    "drawer_opening": "envs_mjx.robot:DrawerOpening",
}


def register(name: str, factory: Factory) -> None:
    """Let `make(name)` return `factory()`. Registering a name again is an error unless the factory is the same."""
    if not name or ":" in name:
        raise ValueError(f"environment name {name!r}: expected a non-empty name without a colon")
    if _factories.setdefault(name, factory) != factory:
        raise ValueError(f"environment name {name!r} is taken by {_factories[name]!r}")


def names() -> tuple[str, ...]:
    """The registered names, in order of registration."""
    return tuple(_factories)


def plain_name(domain: str) -> str:
    """What stands before the arguments: "block_pulling" of "block_pulling,noise=0.007"."""
    return domain.partition(",")[0]


def file_name(domain: str) -> str:
    """The domain as part of a path."""
    return domain.replace(":", ".")


def make(domain: str) -> Environment:
    """The environment registered as `domain`, or `EnvClass()` when that is "package.module:EnvClass".

    Args:
        domain: a name, and what its factory is called with: "name,argument=value,..." with numbers, booleans or words.

    Raises:
        UnknownDomain: with one line that tells what is accepted.
    """
    name, arguments = plain_name(domain), _arguments(domain)
    known = _factories.get(name, name if ":" in name else None)
    if known is None:
        raise UnknownDomain(f"unknown domain {name!r}: accepted are {', '.join(names())}, or package.module:EnvClass")
    factory = _import(name, known) if isinstance(known, str) else known
    _check_arguments(name, factory, arguments)
    try:
        env = factory(**arguments)
    except Exception as error:
        without = "" if arguments else " without arguments"
        raise UnknownDomain(f"domain {domain!r} cannot be made{without}: {_one_line(error)}") from error
    if not isinstance(env, Environment):
        raise UnknownDomain(f"domain {name!r} makes a {type(env).__name__}, not an envs_mjx.base.Environment")
    return env


def _arguments(domain: str) -> dict[str, Any]:
    arguments = {}
    for part in domain.split(",")[1:]:
        argument, equals, value = part.partition("=")
        if not (argument.isidentifier() and equals and value):
            raise UnknownDomain(f"domain {domain!r}: got {part!r}, accepted: name,argument=value,...")
        try:
            arguments[argument] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            arguments[argument] = value  # a word
    return arguments


def _check_arguments(name: str, factory: Callable[..., object], arguments: dict[str, Any]) -> None:
    if not arguments:
        return
    try:
        accepted = inspect.signature(factory).parameters
    except ValueError:  # of a built-in, which says itself what it takes
        return
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in accepted.values()):
        return
    unknown = [argument for argument in arguments if argument not in accepted]
    if unknown:
        raise UnknownDomain(
            f"domain {name!r}: unknown argument {unknown[0]!r}, accepted: {', '.join(accepted) or 'none'}")


def _import(name: str, path: str) -> Callable[[], object]:
    module_name, _, attribute = path.partition(":")
    if os.getcwd() not in sys.path and "" not in sys.path:
        sys.path.append(os.getcwd())  # console scripts, unlike `python -m`, do not look there
    try:
        module = importlib.import_module(module_name)
        factory = getattr(module, attribute, None)  # some packages import only what is asked for
    except Exception as error:  # whatever a user's module raises while it is imported
        raise UnknownDomain(f"domain {name!r}: importing {module_name!r} failed: {_one_line(error)}") from error
    if not callable(factory):
        raise UnknownDomain(f"domain {name!r}: module {module_name!r} has no class {attribute!r}; "
                            f"accepted are {', '.join(names())}, or package.module:EnvClass")
    return factory


def _one_line_of(array: np.ndarray) -> str:
    return " ".join(np.array_str(array).split())[:100]


def _one_line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"


def check_contract(env: Environment, num_steps: int = 3) -> None:
    """Check `env` by abstract evaluation and by `num_steps` real random steps.

    Raises:
        ContractError: with one line that names what is wrong and what is expected.
    """
    _check_declarations(env)
    key = jax.random.key(0)
    action = sample_action(env, key)
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
    _check_rollout(env, num_steps, listed)


def sample_action(env: Environment, key: jax.Array) -> jax.Array:
    """A uniformly random action: () int32, or (size,) float32 in [-1, 1]."""
    spec = env.action_spec
    if isinstance(spec, DiscreteActions):
        return jax.random.randint(key, (), 0, spec.num, jnp.int32)
    return jax.random.uniform(key, (spec.size,), jnp.float32, -1.0, 1.0)


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
        raise ContractError(f"environment {env.name!r}: {place} cannot be traced by JAX: {_one_line(error)}") from error
    if place in _PAIRS:
        kind, expected = _PAIRS[place]
        good = isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], kind)
        _require(env, good, f"what {place} returns", type(result).__name__, expected)
    return result


def _check_array(env: Environment, place: str, array: object, expected: ArraySpec) -> None:
    """`array` is an abstract or a real array of `expected` shape and type."""
    shape, dtype = getattr(array, "shape", None), getattr(array, "dtype", None)
    got = f"{dtype}{list(shape)}" if shape is not None else type(array).__name__
    _require(env, shape == tuple(expected.shape) and dtype == np.dtype(expected.dtype), place, got,
             f"{np.dtype(expected.dtype)}{list(expected.shape)}")


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
    for name, expected in (
        ("action", ArraySpec((number, env.horizon, *action.shape), action.dtype)),
        ("length", ArraySpec((number,), np.int32)), ("success", ArraySpec((number,), bool)),
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


def _check_rollout(env: Environment, num_steps: int, listed: np.ndarray | None) -> None:
    keys = jax.random.split(jax.random.key(1), num_steps + 1)
    env_state, timestep = jax.jit(env.reset)(keys[0])
    _require(env, float(timestep.reward) == 0, "reward of reset", float(timestep.reward), "0")
    _require(env, not bool(timestep.done), "terminated or truncated of reset", True, "False")
    _check_values(env, "reset", env_state, timestep, listed)
    step = jax.jit(env.step)
    for key in keys[1:]:
        if timestep.done:
            break
        env_state, timestep = step(key, env_state, sample_action(env, key))
        _check_timestep(env, "step", timestep)
        _check_values(env, "step", env_state, timestep, listed)


def _check_values(
    env: Environment, place: str, env_state: EnvState, timestep: TimeStep, listed: np.ndarray | None
) -> None:
    for field in ("observation", "state", "reward"):
        value = np.asarray(getattr(timestep, field))
        if np.issubdtype(value.dtype, np.floating):
            _require(env, bool(np.isfinite(value).all()), f"{field} of {place}", "not finite", "finite numbers")
    for field, spec in (("observation", env.observation_spec), ("state", env.state_spec)):
        empty = np.asarray(getattr(timestep, field))[..., spec.shape[-1] - spec.blank :] if spec.blank else np.zeros(1)
        _require(env, not empty.any(), f"the blank channels of {field} of {place}", "not 0", "0, as the spec declares")
    if listed is not None:
        seen = np.asarray(timestep.observation)
        found = (listed == seen).reshape(len(listed), -1).all(axis=1).any()
        _require(env, bool(found), f"observation of {place}", _one_line_of(seen), "one listed by all_observations")
    truth = np.asarray(env.ground_truth(env_state))
    for variable, value in zip(env.variables, truth, strict=True):
        if variable.num_values is not None:
            _require(env, value in range(variable.num_values), f"ground truth {variable.name!r} after {place}",
                     float(value), f"a class in 0 .. {variable.num_values - 1}")

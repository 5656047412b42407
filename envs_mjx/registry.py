"""Names of environments.

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

from envs_mjx.base import (
    Environment,
)
from envs_mjx.errors import UserError, one_line

Factory = Callable[..., Environment] | str
"""Makes an environment: a callable (a class, say), or "package.module:EnvClass", imported only when it is made."""


class UnknownDomain(UserError):
    """No environment of that name can be made; the message tells which can."""


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
        raise UnknownDomain(f"domain {domain!r} cannot be made{without}: {one_line(error)}") from error
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
        raise UnknownDomain(f"domain {name!r}: importing {module_name!r} failed: {one_line(error)}") from error
    if not callable(factory):
        raise UnknownDomain(f"domain {name!r}: module {module_name!r} has no class {attribute!r}; "
                            f"accepted are {', '.join(names())}, or package.module:EnvClass")
    return factory

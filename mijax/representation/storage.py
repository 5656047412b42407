"""Representations on disk: one file of parameters and one of facts about them, written whole or not at all."""

import json
import os
import pathlib

import jax
import numpy as np
from flax import serialization

from envs_mjx.base import Environment
from envs_mjx.errors import UserError
from mijax.files import write_atomically
from mijax.representation.model import init_parameters, networks_for
from mijax.types import Representation

PARAMETERS_FILE = "representation.msgpack"
FACTS_FILE = "representation.json"
FORMAT = 2
"""Raised whenever folders of an earlier version cannot be read any more."""


class RepresentationError(UserError):
    """A folder holds no representation for this environment; the message names the folder and the reason."""


def save_representation(representation: Representation, env: Environment, folder: str | os.PathLike[str]) -> None:
    """Write `folder`/representation.msgpack and then representation.json, each by writing aside and renaming."""
    folder = pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    facts = {
        "format": FORMAT,
        "domain": env.name,
        "features": int(representation.z_s_mean.shape[-1]),
        "state_shape": list(env.state_spec.shape),
        "observation_shape": list(env.observation_spec.shape),
        "contrast": _contrast(env),
    }
    write_atomically(folder / PARAMETERS_FILE, serialization.to_bytes(jax.device_get(representation)))
    write_atomically(folder / FACTS_FILE, json.dumps(facts, indent=2).encode())


def load_representation(path: str | os.PathLike[str], env: Environment) -> Representation:
    """Read what `save_representation` wrote for the same domain.

    Raises:
        RepresentationError: the folder is missing, incomplete, damaged or of another domain.
    """
    folder = pathlib.Path(path)
    facts = _read_facts(folder)
    expected = {"domain": env.name, "state_shape": list(env.state_spec.shape),
                "observation_shape": list(env.observation_spec.shape), "contrast": _contrast(env)}
    facts.setdefault("contrast", [0.0, 0.0])
    for name, value in expected.items():
        if facts.get(name) != value:
            raise RepresentationError(f"{folder}: its {name} is {facts.get(name)}, this run's is {value}")
    template = _template(env, facts["features"])
    try:
        loaded = serialization.from_bytes(template, (folder / PARAMETERS_FILE).read_bytes())
    except FileNotFoundError:
        raise RepresentationError(f"{folder}: {PARAMETERS_FILE} is missing; train it anew") from None
    except Exception as error:  # msgpack and flax raise many kinds for damaged bytes
        raise RepresentationError(f"{folder}: {PARAMETERS_FILE} is damaged ({type(error).__name__})") from None
    same = jax.tree.map(lambda a, b: np.shape(a) == np.shape(b), template, loaded)
    if not all(jax.tree.leaves(same)):
        raise RepresentationError(f"{folder}: {PARAMETERS_FILE} holds arrays of other shapes; train it anew")
    return jax.tree.map(jax.numpy.asarray, loaded)


def _contrast(env: Environment) -> list[float]:
    return [env.state_spec.contrast, env.observation_spec.contrast]


def _read_facts(folder: pathlib.Path) -> dict:
    try:
        facts = json.loads((folder / FACTS_FILE).read_text())
    except FileNotFoundError:
        raise RepresentationError(f"{folder}: no representation there ({FACTS_FILE} is missing)") from None
    except (json.JSONDecodeError, UnicodeDecodeError, OSError) as error:
        raise RepresentationError(f"{folder}: {FACTS_FILE} is damaged ({type(error).__name__})") from None
    if not isinstance(facts, dict) or facts.get("format") != FORMAT or not isinstance(facts.get("features"), int):
        raise RepresentationError(f"{folder}: {FACTS_FILE} is not of format {FORMAT}; train it anew")
    return facts


def _template(env: Environment, features: int) -> Representation:
    """A representation with the right structure and shapes."""
    zeros = [np.zeros((1, *spec.shape), spec.dtype) for spec in (env.state_spec, env.observation_spec)]
    parameters = init_parameters(networks_for(env, features), jax.random.key(0), *map(jax.numpy.asarray, zeros))
    return Representation(phi=parameters["phi"], psi=parameters["psi"],
                          z_s_mean=np.zeros(features, np.float32), z_s_variance=np.zeros((), np.float32),  # pyright: ignore[reportArgumentType]
                          data_key=np.zeros(2, np.uint32))  # pyright: ignore[reportArgumentType]

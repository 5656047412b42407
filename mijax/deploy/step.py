"""One step of a trained agent as a function of named arrays, and the contract that says what they are."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.base import ArraySpec, ContinuousActions, DiscreteActions, Environment
from mijax.agents.core import Agent
from mijax.agents.dqn import DQN
from mijax.agents.variants import memory_of
from mijax.deploy.numpy_policy import NEXT, VERSION
from mijax.nets.two_branch import MemoryState
from mijax.run_folder import RunError
from mijax.types import Params

Shapes = dict[str, jax.ShapeDtypeStruct]
MEMORY = "memory"


@dataclasses.dataclass(frozen=True)
class PolicyStep:
    """A greedy agent of one episode: no batch axis, every array by its name."""

    function: Callable[[Mapping[str, jax.Array]], dict[str, jax.Array]]
    """observation, previous_action and the memory's leaves -> action, the leaves as they are next, under `NEXT` + name,
    and with discrete actions values, (A,) float32 Q(h, a)."""
    inputs: Shapes
    memory: tuple[str, ...]
    """Names of the memory's leaves, all zeros at the start of an episode."""


def policy_step(agent: Agent, params: Params) -> PolicyStep:
    """The agent's greedy step with its parameters inside.

    Args:
        agent: any that acts on observations.
        params: of its network; evaluations use the averaged ones, `AgentState.target`.

    Raises:
        RunError: the agent acts on the true state, which nothing but a simulator has.
    """
    if agent.declaration.sees_state:
        raise RunError(f"agent {agent.config.agent!r} acts on the simulator's state, which a policy cannot be given")
    empty = agent.initial_memory(1)
    leaves, structure = jax.tree_util.tree_flatten_with_path(empty)
    names = tuple(f"{MEMORY}.{jax.tree_util.keystr(path, simple=True, separator='.')}" for path, _ in leaves)
    assert not any(np.any(leaf) for _, leaf in leaves), "a contract says that a memory starts with zeros"

    def function(arrays: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
        memory = cast(MemoryState, jax.tree.unflatten(structure, [arrays[name][None] for name in names]))
        seen = memory, arrays["observation"][None], arrays["previous_action"][None]
        outputs: dict[str, jax.Array] = {}
        if isinstance(agent, DQN):  # `act` and the values that it goes by, in one pass
            later, values = agent.action_values(params, *seen)
            action, outputs["values"] = jnp.argmax(values, axis=-1).astype(jnp.int32), values[0]
        else:
            later, action = agent.act(params, *seen)
        outputs["action"] = action[0]
        return outputs | {NEXT + name: leaf[0] for name, leaf in zip(names, jax.tree.leaves(later), strict=True)}

    spec = agent.env.observation_spec
    none = agent.no_action(1)
    inputs = {"observation": jax.ShapeDtypeStruct(spec.shape, _carried(spec.dtype)),
              "previous_action": jax.ShapeDtypeStruct(none.shape[1:], none.dtype)}
    inputs |= {name: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype)
               for name, (_, leaf) in zip(names, leaves, strict=True)}
    return PolicyStep(function, inputs, names)


def contract(agent: Agent, step: PolicyStep) -> dict[str, Any]:
    """What a program must know to call the step: names, shapes, dtypes, units, ranges, frame, rate; for JSON."""
    env, given = agent.env, step.inputs["previous_action"]
    spec, interface = env.observation_spec, env.interface
    low, high = observation_range(env)
    described = {
        "mijax_policy": VERSION, "domain": env.name, "agent": agent.config.agent, "algorithm": agent.group,
        "memory_kind": memory_of(agent.config), "horizon": env.horizon, "rate_hz": _short(interface.rate),
        "frame": interface.frame,
        "observation": {
            "name": "observation", "shape": spec.shape, "dtype": step.inputs["observation"].dtype.name, "low": low,
            "high": high, "unit": interface.observation_unit, "meaning": interface.observation,
            "blank_channels": spec.blank},
        "action": {"name": "action", "shape": given.shape, "dtype": np.dtype(given.dtype).name,
                   "meaning": interface.action, **_actions(env)},
        "previous_action": {
            "name": "previous_action", "shape": given.shape, "dtype": np.dtype(given.dtype).name,
            "at_start": agent.no_action(1).reshape(-1)[0].item(), "meaning": "the action before, as it was done"},
        "memory": [
            {"name": name, "next": NEXT + name, "shape": step.inputs[name].shape,
             "dtype": np.dtype(step.inputs[name].dtype).name, "at_start": 0} for name in step.memory],
    }
    if isinstance(env.action_spec, DiscreteActions):
        described["values"] = {"name": "values", "shape": [env.action_spec.num], "dtype": "float32",
                               "meaning": "Q(h, a) of each action, by which it is chosen"}
    return described


def observation_range(env: Environment) -> tuple[float | None, float | None]:
    """Smallest and largest number of an observation: declared, of all there are, or of its dtype; else None."""
    if env.interface.observation_range is not None:
        low, high = env.interface.observation_range
        return _short(low), _short(high)
    listed = env.all_observations()
    if listed is not None:
        return (listed.min() * 1).item(), (listed.max() * 1).item()
    dtype = np.dtype(cast(ArraySpec, env.observation_spec).dtype)
    if dtype.kind == "b":
        return 0, 1
    return (np.iinfo(dtype).min, np.iinfo(dtype).max) if dtype.kind in "iu" else (None, None)


def _carried(dtype: Any) -> np.dtype:
    """The dtype of observations in an export: of those that every format has, the one that holds the same numbers."""
    given = np.dtype(dtype)
    if given.kind == "b":
        return np.dtype(np.uint8)
    if given.kind in "iu":
        return given if given in (np.uint8, np.uint32) else np.dtype(np.int32)
    return np.dtype(np.float32)


def _actions(env: Environment) -> dict[str, Any]:
    spec, interface = env.action_spec, env.interface
    if isinstance(spec, ContinuousActions):
        scale = [_short(number) for number in interface.action_scale]
        return {"kind": "continuous", "names": spec.names, "low": -1.0, "high": 1.0, "scale": scale,
                "units": interface.action_units}
    return {"kind": "discrete", "names": spec.names, "low": 0, "high": spec.num - 1}


def _short(number: float | None) -> float | None:
    """Without the digits that float32 invents."""
    return None if number is None else round(float(number), 6)

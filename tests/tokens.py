"""Agents without a world: shapes, an untrained representation, three episodes of tokens, random parameters."""

import dataclasses
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.base import ActionSpec, ArraySpec, ContinuousActions, DiscreteActions, Environment
from mijax.agents.core import Agent, AgentState
from mijax.agents.state_shown import StateShown
from mijax.agents.variants import needs_representation
from mijax.config import Config, NetworkConfig
from mijax.representation.model import init_parameters, networks_for
from mijax.types import Representation, Tokens

FEATURES, ROW = 4, 6
OBSERVATION, STATE = ArraySpec((2,)), ArraySpec((3,))
DISCRETE, CONTINUOUS = DiscreteActions(3), ContinuousActions(2)
SPANS = ((0, 0, 4), (0, 4, 6), (1, 0, 5))
"""Row, first token, end: the three episodes of `episodes`."""
END = (0, 3)
"""Row and token: where the first of them ends."""
TINY = NetworkConfig(action_embedding=4, observation_embedding=4, gru_width=8, critic_hidden=(16,), actor_hidden=(16,),
                     auxiliary_hidden=(16,), dropout=0.0)


class Shapes(Environment):
    """Nothing but the shapes that networks are made for."""

    name = "shapes"

    def __init__(self, action_spec: ActionSpec, observation_spec: ArraySpec = OBSERVATION,
                 state_spec: ArraySpec = STATE, horizon: int = ROW - 1) -> None:
        self.action_spec, self.horizon = action_spec, horizon
        self.observation_spec, self.state_spec = observation_spec, state_spec

    def reset(self, key):
        return jnp.zeros(()), None

    def step(self, key, env_state, action):
        raise NotImplementedError


def representation(env: Environment, seed: int = 5, features: int = FEATURES) -> Representation:
    """Untrained encoders, a mean that is not 0 and a variance that is not 1."""
    zeros = [jnp.zeros((1, *spec.shape)) for spec in (env.state_spec, env.observation_spec)]
    parameters = init_parameters(networks_for(env, features), jax.random.key(seed), *zeros)
    return Representation(parameters["phi"], parameters["psi"], jnp.arange(features, dtype=jnp.float32), jnp.float32(2),
                          jnp.zeros(2, jnp.uint32))


def episodes(action_spec: ActionSpec) -> Tokens:
    """Row 0: episodes of 3 steps and of 1 step, both terminated; row 1: one of 4 steps, truncated, and padding."""
    rng = np.random.default_rng(0)
    segment = np.array([[1, 1, 1, 1, 2, 2], [3, 3, 3, 3, 3, 0]])
    position = np.array([[0, 1, 2, 3, 0, 1], [0, 1, 2, 3, 4, 0]])
    terminated, truncated = np.zeros((2, *segment.shape), bool)
    terminated[0, 3] = terminated[0, 5] = truncated[1, 4] = True
    if isinstance(action_spec, DiscreteActions):
        action = np.where(position == 0, -1, rng.integers(0, action_spec.num, segment.shape)).astype(np.int32)
    else:
        drawn = rng.uniform(-0.9, 0.9, (*segment.shape, action_spec.size))
        action = np.where(position[..., None] == 0, 0, drawn).astype(np.float32)
    return Tokens(
        frames=jnp.asarray(rng.normal(size=(segment.size, *OBSERVATION.shape)), jnp.float32),
        frame=None,
        previous_action=jnp.asarray(action),
        reward=jnp.asarray(rng.normal(size=segment.shape), jnp.float32),
        terminated=jnp.asarray(terminated),
        truncated=jnp.asarray(truncated),
        segment=jnp.asarray(segment, jnp.int32),
        position=jnp.asarray(position, jnp.int32),
        z_s=jnp.asarray(rng.normal(size=(*segment.shape, FEATURES)), jnp.float32),
        states=jnp.asarray(rng.normal(size=(segment.size, *STATE.shape)), jnp.float32),
    )


def random_like(shapes: Any, scale: float, seed: int = 7) -> Any:
    """A pytree of normal noise, to be had without compiling an initialisation."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(0, scale, x.shape), x.dtype), shapes)


A = TypeVar("A", bound=Agent)


class AgentCase(Generic[A]):
    """An agent with large random parameters, those of its target network different, and tokens as it sees them."""

    def __init__(self, make: Callable[[Environment, Config], A], action_spec: ActionSpec, config: Config) -> None:
        self.config, env, self.tokens = config, Shapes(action_spec), episodes(action_spec)
        self.agent: A = make(StateShown(env) if config.agent == "mdp" else env, config)
        if config.agent == "mdp":
            both = jnp.concatenate([jnp.asarray(self.tokens.states), jnp.asarray(self.tokens.frames)], axis=-1)
            self.tokens = dataclasses.replace(self.tokens, frames=both)
        self.representation = representation(env) if needs_representation(config) else None
        shapes = jax.eval_shape(self.agent.init, jax.random.key(0), self.representation)
        params, target = random_like((shapes.params, shapes.target), 0.3)
        self.state = AgentState(params, target, self.agent.optimizer.init(params), jnp.zeros((), jnp.int32))

    def losses(self, updates: int = 0) -> tuple[float, dict[str, float]]:
        """The sum of all losses after so many updates, and its parts."""
        loss, metrics = jax.jit(self.agent.loss)(
            self.state.params, self.state.target, self.tokens, self.representation, jnp.int32(updates),
            jax.random.key(0))
        return float(loss), {name: float(value) for name, value in metrics.items()}


def dependencies(outputs: Callable[[Tokens], dict[str, Any]], tokens: Tokens) -> dict[str, str]:
    """Which of "past present state" move each of the `outputs` at the end of the first episode.

    Args:
        outputs: from tokens to what is said at `END`, by name; None where an agent has no such output.
        tokens: an `AgentCase`'s.
    """
    frames, states = np.array(tokens.frames), np.array(tokens.states)
    present, shown = END[1], frames.shape[-1] - OBSERVATION.shape[0]  # entries of the state in an observation

    def changed(array: np.ndarray, index: Any) -> jax.Array:
        array = array.copy()
        array[index] = 5
        return jnp.asarray(array)

    changes = {
        "past": {"frames": changed(frames, 1)},
        "present": {"frames": changed(frames, (present, slice(shown, None)))},
        "state": {"frames": changed(frames, (present, slice(shown))), "states": changed(states, present)},
    }
    before = outputs(tokens)
    after = {what: outputs(dataclasses.replace(tokens, **change)) for what, change in changes.items()}
    return {name: " ".join(what for what in changes if not np.array_equal(before[name], after[what][name]))
            for name in before}

"""Greedy episodes, seen from inside: what the history explains of z_s, the bonus, the values, the attention.

Letters: N episodes, L = horizon + 1 tokens, A actions, F features, H attention heads.
"""

import dataclasses
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.base import DiscreteActions, EnvState, TimeStep
from mijax.learner import Learner, LearnerState
from mijax.nets.encoders import encoder_for
from mijax.nets.two_branch import Prediction
from mijax.types import Representation, Tokens


@dataclasses.dataclass(frozen=True)
class Trace:
    """N greedy episodes; token t is what was known on arriving at step t. What follows an episode's end is meaningless.

    Without a representation there is no bonus and nothing to explain; without a transformer, no attention. The values
    of continuous actions are those of the actions taken, by the more cautious critic.
    """

    env_state: EnvState  # leaves (N, L, ...)
    observation: np.ndarray  # (N, L, *observation_shape)
    state: np.ndarray  # (N, L, *state_shape)
    truth: np.ndarray  # (N, L, V) float32, the environment's variables
    reward: np.ndarray  # (N, L) float32, the task's, on arriving
    reveals: np.ndarray  # (N, L) bool, whether the observation shows what is otherwise hidden
    length: np.ndarray  # (N,) int32, steps
    action: np.ndarray  # (N, L) int32, or of continuous actions (N, L, A) float32, taken after token t
    q: np.ndarray  # (N, L, A), or of continuous actions (N, L, 1)
    bonus: np.ndarray | None  # (N, L) with weight 1, on arriving; 0 at the start
    explained: np.ndarray | None  # (N, L) fraction of the variance of z_s that f(h_t) explains
    explained_by_agent: np.ndarray | None  # (N, L) the same of the memory branch (the auxiliary task)
    attention: np.ndarray | None  # (N, H, L, L) of the last block: token (row) looks at token (column)

    def peaks(self) -> np.ndarray:
        """(N,) int32: the step of each episode at which the bonus is largest."""
        assert self.bonus is not None
        steps = np.arange(self.bonus.shape[1])
        return np.where(steps <= self.length[:, None], self.bonus, -np.inf).argmax(1)

    def first_information(self) -> np.ndarray:
        """(N,) int32: the first step that reveals what is hidden; -1 if none does."""
        seen = self.reveals & (np.arange(self.reveals.shape[1]) <= self.length[:, None])
        return np.where(seen.any(1), seen.argmax(1), -1)

    def peaks_at_information(self) -> float:
        """Of the episodes that reveal something, the fraction whose bonus peaks the moment they first do; NaN: none."""
        informed = self.first_information()
        return float(np.mean((self.peaks() == informed)[informed >= 0])) if (informed >= 0).any() else float("nan")


def trace(learner: Learner, state: LearnerState, key: jax.Array, episodes: int) -> Trace:
    """Play greedily with the averaged network and look inside on the way."""
    return Trace(**jax.device_get(jax.jit(lambda state, key: _trace(learner, state, key, episodes))(state, key)))


def _trace(learner: Learner, state: LearnerState, key: jax.Array, num: int) -> dict[str, Any]:
    env, agent = learner.env, learner.agent
    key_reset, key_steps = jax.random.split(key)
    env_state, first = jax.vmap(env.reset)(jax.random.split(key_reset, num))

    def step(carry: tuple, key: jax.Array) -> tuple[tuple, tuple]:
        env_state, timestep, memory, previous = carry
        memory, action = agent.act(state.agent.target, memory, timestep.observation, previous)
        later, arrived = jax.vmap(env.step)(jax.random.split(key, num), env_state, action)
        return (later, arrived, memory, action), (env_state, timestep, previous, action)

    carry = env_state, first, agent.initial_memory(num), agent.no_action(num)
    (last_state, last, _, last_action), steps = jax.lax.scan(step, carry, jax.random.split(key_steps, env.horizon))
    ending = last_state, last, last_action, last_action
    whole = jax.tree.map(lambda a, b: jnp.moveaxis(jnp.concatenate([a, b[None]]), 0, 1), steps, ending)
    env_state, timestep, previous, action = cast(tuple[EnvState, TimeStep, jax.Array, jax.Array], whole)
    length = jnp.argmax(timestep.done, axis=1).astype(jnp.int32)
    tokens = _tokens(learner, state.representation, timestep, previous, length)
    tokens, q, predicted, attention = _look_inside(learner, state, tokens, action)
    return {
        "env_state": env_state, "observation": timestep.observation, "state": timestep.state,
        "truth": jax.vmap(jax.vmap(learner.domain.ground_truth))(env_state), "reward": timestep.reward,
        "reveals": jax.vmap(jax.vmap(env.reveals))(env_state), "length": length, "action": action, "q": q,
        "attention": attention,
    } | _information(learner, state, tokens, predicted)


def _look_inside(
    learner: Learner, state: LearnerState, tokens: Tokens, action: jax.Array
) -> tuple[Tokens, jax.Array, jax.Array | None, jax.Array | None]:
    """The tokens as f looks at them, and of whole episodes the values, the predicted z_s and the attention."""
    agent, variables = learner.agent, {"params": state.agent.target}
    if isinstance(learner.env.action_spec, DiscreteActions):
        outputs, seen = agent.network.apply(variables, tokens, mutable=["intermediates"])
        q, predicted = outputs.q, outputs.z_s
    else:
        tokens = agent.network.apply(variables, tokens, method="look")
        if agent.looks_once and state.representation is not None:  # the critics see phi's body of the state
            phi = encoder_for(learner.env.state_spec, learner.config.stage1.features)
            body = phi.apply({"params": state.representation.phi}, tokens.states, method="body")
            tokens = dataclasses.replace(tokens, states=body)
        encoded, seen = agent.network.apply(variables, tokens, method="encode", mutable=["intermediates"])
        taken = action.reshape(-1, action.shape[-1])
        values = agent.network.apply(variables, encoded.critic, taken, method="values")
        q = jnp.min(values, axis=0).reshape(*action.shape[:2], 1)
        predicted = encoded.heads[0].z_s if encoded.heads else None
    found = seen.get("intermediates", {})
    attention = jax.tree.leaves(found.get("actor", found))  # an actor's own memory, not its critics'
    return tokens, q, predicted, attention[-1] if attention else None


def _tokens(learner: Learner, representation: Representation | None, timestep: TimeStep, previous: jax.Array,
            length: jax.Array) -> Tokens:
    """One episode per row."""
    z_s, position = None, jnp.broadcast_to(jnp.arange(previous.shape[1])[None], previous.shape[:2])
    if representation is not None:
        phi = encoder_for(learner.env.state_spec, learner.config.stage1.features)
        z_s = cast(jax.Array, phi.apply({"params": representation.phi}, timestep.state))
    return Tokens(
        frames=timestep.observation.reshape(-1, *timestep.observation.shape[2:]), frame=None, z_s=z_s,
        previous_action=previous, reward=timestep.reward, terminated=timestep.terminated,
        truncated=timestep.truncated, segment=(position <= length[:, None]).astype(jnp.int32), position=position,
        states=timestep.state.reshape(-1, *timestep.state.shape[2:]))


def _information(
    learner: Learner, state: LearnerState, tokens: Tokens, predicted: jax.Array | None
) -> dict[str, jax.Array | None]:
    """The bonus, and what f and the agent explain of z_s. Of two models f, their mean."""
    representation, z_s = state.representation, tokens.z_s
    result: dict[str, jax.Array | None] = {"bonus": None, "explained": None, "explained_by_agent": None}
    if representation is None or z_s is None:
        return result

    def explained(guess: jax.Array) -> jax.Array:
        return 1 - jnp.sum(jnp.square(z_s - guess), axis=-1) / representation.z_s_variance

    if predicted is not None:
        result["explained_by_agent"] = explained(representation.destandardise(predicted))
    model = learner.agent.information_model
    if model is not None:
        guesses = [model.apply({"params": params}, tokens) for params in state.agent.params["f"]]
        f = cast(Prediction, jax.tree.map(lambda *guess: sum(guess[1:], guess[0]) / len(guess), *guesses))
        bonus = jnp.where(tokens.position > 0, learner.agent.bonus(f, z_s, representation), 0.0)
        result |= {"bonus": bonus, "explained": explained(representation.destandardise(f.mean))}
    return result

"""Our environments as brax's, with privileged observations, and brax's or MuJoCo Playground's as ours.

`AsBrax("heaven_hell")` shows a policy `obs["state"]` and a critic `obs["privileged_state"]`, the names that brax's PPO
and MuJoCo Playground use, so that PPO with `policy_obs_key="state"` and `value_obs_key="privileged_state"` is an
asymmetric actor-critic. brax comes with `pip install -e '.[robot]'`.
"""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs import base
from brax.envs.wrappers import training
from flax import struct

from envs_mjx import registry
from envs_mjx.base import (
    ArraySpec,
    ContinuousActions,
    DiscreteActions,
    Environment,
    EnvState,
    TimeStep,
    Variable,
)

POLICY_KEY, VALUE_KEY = "state", "privileged_state"
"""What brax calls an observation, and what it calls the state."""


@struct.dataclass
class BraxMoment:
    """What `AsBrax` remembers between steps."""

    env_state: EnvState
    window: jax.Array  # (history, width) float32, the last observations and the actions that led to them, newest last
    key: jax.Array  # (2,) uint32, draws all that follows


class AsBrax(base.Env):
    """One of our environments, for brax's agents.

    `obs["state"]` is the observation, flattened, or with `history` above 1 the last observations, each with the action
    that led to it (zeros before the start): brax's networks have no memory of their own. `obs["privileged_state"]` is
    the state, flattened, after `obs["state"]` where the critic sees both.

    brax's agents act in boxes. Continuous actions go through as they are; of N discrete ones, an action is the largest
    of N numbers, so that the greedy action of a Gaussian policy is the one with the largest mean.

    `done` is 1 at either end of an episode, and `info["time_out"]` where it was the time limit. Train with
    `wrap_env_fn=wrap`: brax's own wrapper starts all episodes of a place in its batch from the same moment, hidden
    variables included, and takes our time limit for an end of the task.
    """

    def __init__(
        self, domain: str | Environment, *, history: int = 1, critic: Literal["state", "history_state"] = "state",
    ) -> None:
        """Args:
            domain: a registered name, `package.module:EnvClass`, or an environment.
            history: observations that the policy sees, the present one among them.
            critic: what `obs["privileged_state"]` shows: the state, or `obs["state"]` and the state. A critic of the
                state alone is biased under partial observability.

        Raises:
            ValueError: no history, or an unknown critic.
        """
        if history < 1:
            raise ValueError(f"history: got {history}, accepted: at least 1, the present observation")
        if critic not in ("state", "history_state"):
            raise ValueError(f"critic: got {critic!r}, accepted: state, history_state")
        self.env = registry.make(domain) if isinstance(domain, str) else domain
        self.history, self._critic = history, critic
        self.episode_length = self.env.horizon
        self._observed = int(np.prod(self.env.observation_spec.shape))

    @property
    def observation_size(self) -> Mapping[str, tuple[int, ...]]:
        """Widths of the policy's and the critic's input."""
        policy, state = self.history * self._width, int(np.prod(self.env.state_spec.shape))
        return {POLICY_KEY: (policy,), VALUE_KEY: (state + (policy if self._critic == "history_state" else 0),)}

    @property
    def action_size(self) -> int:
        """Entries of a continuous action, or the number of discrete ones."""
        spec = self.env.action_spec
        return spec.num if isinstance(spec, DiscreteActions) else spec.size

    @property
    def backend(self) -> str:
        """No physics engine of brax's."""
        return "mijax"

    @property
    def _width(self) -> int:
        return self._observed + (self.action_size if self.history > 1 else 0)

    def reset(self, rng: jax.Array) -> base.State:
        """Start an episode; `rng` is a key of either kind."""
        raw = jax.random.key_data(rng) if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) else rng
        key_reset, key = jax.random.split(jax.random.wrap_key_data(raw))
        env_state, timestep = self.env.reset(key_reset)
        window = self.shift(self.empty_window(), timestep.observation, jnp.zeros((self.action_size,)))
        zero = jnp.zeros(())
        return base.State(
            pipeline_state=self._moment(env_state, window, key), obs=self._show(window, timestep), reward=zero,
            done=zero, metrics={"success": zero}, info={"time_out": zero})

    def step(self, state: base.State, action: jax.Array) -> base.State:
        """One step; `action` is (action_size,) float32. Never resets: see `wrap`."""
        moment: Any = state.pipeline_state
        key_step, key = jax.random.split(jax.random.wrap_key_data(moment.key))
        ours = self.to_action(action)
        env_state, timestep = self.env.step(key_step, moment.env_state, ours)
        window = self.shift(moment.window, timestep.observation, self.encode(ours))
        success = (timestep.done & self.env.success(timestep)).astype(jnp.float32)
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]  (a flax dataclass)
            pipeline_state=self._moment(env_state, window, key), obs=self._show(window, timestep),
            reward=timestep.reward, done=timestep.done.astype(jnp.float32),
            metrics={**state.metrics, "success": success},
            info={**state.info, "time_out": timestep.truncated.astype(jnp.float32)})

    def to_action(self, action: jax.Array) -> jax.Array:
        """Our action, () int32 or (size,) float32, from brax's (action_size,) float32."""
        if isinstance(self.env.action_spec, DiscreteActions):
            return jnp.argmax(action, axis=-1).astype(jnp.int32)
        return jnp.clip(action, -1.0, 1.0)

    def encode(self, action: jax.Array) -> jax.Array:
        """(action_size,) float32: our action as the window holds it. -1, no action, is all zeros."""
        return jax.nn.one_hot(action, self.action_size) if isinstance(self.env.action_spec, DiscreteActions) else action

    def empty_window(self) -> jax.Array:
        """(history, width) float32: nothing seen yet."""
        return jnp.zeros((self.history, self._width))

    def shift(self, window: jax.Array, observation: jax.Array, encoded: jax.Array) -> jax.Array:
        """The (history, width) window one step later: `encoded`, an action, led to `observation`."""
        newest = jnp.ravel(observation).astype(jnp.float32)
        newest = jnp.concatenate([newest, encoded]) if self.history > 1 else newest
        return jnp.concatenate([window[1:], newest[None]])

    def _moment(self, env_state: EnvState, window: jax.Array, key: jax.Array) -> Any:
        return BraxMoment(env_state, window, jax.random.key_data(key))

    def _show(self, window: jax.Array, timestep: TimeStep) -> dict[str, jax.Array]:
        seen, true = window.ravel(), jnp.ravel(timestep.state).astype(jnp.float32)
        return {POLICY_KEY: seen, VALUE_KEY: jnp.concatenate([seen, true]) if self._critic == "history_state" else true}


class TimeLimit(training.EpisodeWrapper):
    """brax's count of an episode's steps; an environment's own time limit is a truncation too."""

    def step(self, state: base.State, action: jax.Array) -> base.State:
        """One step in every environment."""
        after = super().step(state, action)
        truncation = jnp.maximum(after.info["truncation"], after.info["time_out"])
        return after.replace(  # pyright: ignore[reportAttributeAccessIssue]
            info={**after.info, "truncation": truncation})


class FreshEpisodes(base.Wrapper):
    """A new episode, with a key of its own, where one has ended."""

    def step(self, state: base.State, action: jax.Array) -> base.State:
        """One step in every environment; the observation after an episode's end is the next one's first."""
        info = {**state.info, "steps": jnp.where(state.done, 0.0, state.info["steps"])}
        state = self.env.step(
            state.replace(done=jnp.zeros_like(state.done), info=info), action)  # pyright: ignore
        ended: Any = state.pipeline_state
        fresh = jax.vmap(self.unwrapped.reset)(ended.key)

        def pick(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(state.done.reshape(-1, *[1] * (old.ndim - 1)), new, old)

        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=jax.tree.map(pick, fresh.pipeline_state, ended),
            obs=jax.tree.map(pick, fresh.obs, state.obs))


def wrap(
    env: AsBrax, episode_length: int, action_repeat: int = 1, randomization_fn: object = None,
) -> base.Wrapper:
    """A batch of environments for brax's training: `ppo.train(..., wrap_env_fn=wrap)`.

    Args:
        env: one of ours.
        episode_length: a time limit in steps; the environment's own holds too.
        action_repeat: 1, an action is never repeated.
        randomization_fn: None, our environments draw what varies themselves.

    Raises:
        ValueError: an option of brax's that has no meaning here.
    """
    if action_repeat != 1:
        raise ValueError(f"action_repeat: got {action_repeat}, accepted: 1")
    if randomization_fn is not None:
        raise ValueError("randomization_fn: accepted: None, our environments draw what varies themselves")
    return FreshEpisodes(TimeLimit(training.VmapWrapper(env), min(episode_length, env.episode_length), 1))


@contextlib.contextmanager
def on_recent_jax() -> Iterator[None]:
    """Let brax's training run inside: brax 0.14 calls `jax.device_put_replicated`, which JAX 0.10 has no longer.

    Nothing is changed where JAX has it, and nothing stays changed afterwards.
    """
    if hasattr(jax, "device_put_replicated"):
        yield
        return
    jax.device_put_replicated = _replicated
    try:
        yield
    finally:
        del jax.device_put_replicated


def _replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """`tree` with a leading axis, one entry on each device."""
    mesh = jax.sharding.Mesh(np.array(devices), ("device",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("device"))
    return jax.tree.map(
        lambda x: jax.device_put(jnp.broadcast_to(x, (len(devices), *jnp.shape(x))), sharding), tree)


@struct.dataclass
class SimulatorMoment:
    """What `FromBrax` remembers between steps."""

    state: Any  # brax's State
    time: jax.Array  # () int32, steps since the reset


class FromBrax(Environment):
    """An environment of brax's or of MuJoCo Playground's, bare: without wrappers that batch it or reset it.

    Of a dictionary of observations, one entry is our observation and another our state. A single array is the state,
    and the observation is part of it. Such environments draw everything from the key of `reset`.
    """

    def __init__(
        self, env: Any, *, horizon: int, name: str | None = None, observation_key: str = POLICY_KEY,
        state_key: str | None = None, observed: Sequence[int] | None = None, variables: Sequence[Variable] = (),
    ) -> None:
        """Args:
            env: has `reset(key)`, `step(state, action)` and `action_size`.
            horizon: time limit in steps; these libraries keep it outside of the environment.
            name: for files and tables; None: the class's.
            observation_key: the entry of the observations that a policy sees.
            state_key: the one for training only; None: `privileged_state`, or without such an entry the observation's,
                in full.
            observed: which numbers of that vector a policy sees, e.g. positions without velocities; None: all.
            variables: a name for each number of the flattened state, for probes.

        Raises:
            ValueError: a wrapper that resets, no such entry or number, or variables that do not fit the state.
        """
        self.name, self.horizon = name or type(env).__name__, int(horizon)
        layer = env
        while layer is not None:
            if "AutoReset" in type(layer).__name__:
                raise ValueError(f"{self.name}: {type(layer).__name__} resets within a step, accepted: the bare "
                                 "environment, e.g. brax.envs.get_environment(name)")
            layer = vars(layer).get("env")
        obs = jax.eval_shape(env.reset, jax.random.PRNGKey(0)).obs
        for option, entry in (("observation_key", observation_key), ("state_key", state_key)):
            if isinstance(obs, Mapping) and entry is not None and entry not in obs:
                raise ValueError(f"{option}: {self.name} shows no {entry!r}, accepted: {', '.join(sorted(obs))}")
        state_key = VALUE_KEY if state_key is None else state_key
        self._env, self._keys = env, (observation_key, state_key)
        self._observed = None if observed is None else np.asarray(observed, np.int32)
        seen, state = jax.eval_shape(lambda obs: self._views(obs), obs)
        whole = obs[observation_key] if isinstance(obs, Mapping) else obs
        if observed is not None and not all(0 <= i < whole.shape[-1] for i in observed):
            raise ValueError(f"observed: got {list(observed)}, accepted: numbers from 0 to {whole.shape[-1] - 1}")
        self.observation_spec = ArraySpec(seen.shape, seen.dtype)
        self.state_spec = ArraySpec(state.shape, state.dtype)
        self.action_spec = ContinuousActions(int(env.action_size))
        size = int(np.prod(state.shape))
        if variables and len(variables) != size:
            raise ValueError(f"variables: got {len(variables)}, accepted: one for each of the state's {size} numbers")
        if not variables and observed is not None and not (isinstance(obs, Mapping) and state_key in obs):
            variables = [Variable(f"state[{i}]", hidden=i not in observed) for i in range(size)]
        self.variables = tuple(variables)

    def reset(self, key: jax.Array) -> tuple[SimulatorMoment, TimeStep]:
        """As the simulator resets."""
        state = self._env.reset(jax.random.key_data(key))  # these libraries expect keys of the old kind
        state = jax.tree.map(lambda x: jnp.asarray(x, jnp.asarray(x).dtype), state)
        moment = SimulatorMoment(state, jnp.zeros((), jnp.int32))
        return moment, self._show(moment, jnp.zeros(()), jnp.zeros((), bool))

    def step(self, key: jax.Array, env_state: SimulatorMoment, action: jax.Array) -> tuple[SimulatorMoment, TimeStep]:
        """As the simulator steps; what is random follows from the key of `reset`."""
        del key
        state = self._env.step(env_state.state, action)
        state = jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), state, env_state.state)
        moment = SimulatorMoment(state, env_state.time + 1)
        return moment, self._show(moment, jnp.asarray(state.reward, jnp.float32), state.done > 0)

    def ground_truth(self, env_state: SimulatorMoment) -> jax.Array:
        """(n,) float32: the state, flattened, where its numbers have names."""
        if not self.variables:
            return super().ground_truth(env_state)
        return jnp.ravel(self._views(env_state.state.obs)[1]).astype(jnp.float32)

    def _views(self, obs: Any) -> tuple[jax.Array, jax.Array]:
        """Observation and state."""
        observation_key, state_key = self._keys
        whole = obs[observation_key] if isinstance(obs, Mapping) else obs
        state = obs.get(state_key, whole) if isinstance(obs, Mapping) else whole
        return (whole if self._observed is None else whole[..., self._observed]), state

    def _show(self, moment: SimulatorMoment, reward: jax.Array, terminated: jax.Array) -> TimeStep:
        observation, state = self._views(moment.state.obs)
        return TimeStep(observation, state, reward, terminated, (moment.time >= self.horizon) & ~terminated)

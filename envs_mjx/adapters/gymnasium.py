"""Any of our environments as Gymnasium's, `AsGymnasium("heaven_hell")`, and Gymnasium's as ours, `FromGymnasium`."""

import collections
import threading
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from gymnasium import spaces

from envs_mjx import registry
from envs_mjx.base import (
    ActionSpec,
    ArraySpec,
    ContinuousActions,
    DiscreteActions,
    Environment,
    TimeStep,
    Variable,
)


class AsGymnasium(gymnasium.Env):
    """One environment, stepped from the host. Each instance compiles its own functions; a second finds them on disk.

    `info` holds the privileged `state`, and `success` once an episode has ended. The time limit is reported as
    `truncated`, so no wrapper is needed. For speed step our environments inside `jax.vmap` instead: here every step
    is a call from the host.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  (Gymnasium's own convention)

    def __init__(self, domain: str | Environment) -> None:
        """Args:
            domain: a registered name, `package.module:EnvClass`, or an environment.
        """
        self._env = registry.make(domain) if isinstance(domain, str) else domain
        self.observation_space = _space(self._env.observation_spec)
        spec = self._env.action_spec
        self.action_space = (spaces.Discrete(spec.num) if isinstance(spec, DiscreteActions)
                             else spaces.Box(-1.0, 1.0, (spec.size,), np.float32))
        self.state_space = _space(self._env.state_spec)
        self._reset, self._step, self._success = (
            jax.jit(function) for function in (self._env.reset, self._env.step, self._env.success))
        self._key = jax.random.key(0)
        self._state: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Start an episode; the same seed starts the same sequence of episodes."""
        super().reset(seed=seed)
        if seed is not None or self._state is None:
            seed = int(self.np_random.integers(2**31)) if seed is None else seed
            self._key = jax.random.key(seed % 2**32)
            while seed := seed >> 32:  # Gymnasium's seeds may have any number of bits, those of JAX have 32
                self._key = jax.random.fold_in(self._key, seed % 2**32)
        self._state, timestep = self._reset(self._next_key())
        return np.array(timestep.observation), {"state": np.array(timestep.state)}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        """One step."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("step: call reset first")
        if isinstance(self.action_space, spaces.Discrete) and not self.action_space.contains(action):
            raise gymnasium.error.InvalidAction(f"action: got {action!r}, accepted: {self.action_space}")
        self._state, timestep = self._step(self._next_key(), self._state, np.asarray(action, self.action_space.dtype))
        info: dict[str, Any] = {"state": np.array(timestep.state)}
        terminated, truncated = bool(timestep.terminated), bool(timestep.truncated)
        if terminated or truncated:
            info["success"] = bool(self._success(timestep))
        return np.array(timestep.observation), float(timestep.reward), terminated, truncated, info

    def _next_key(self) -> jax.Array:
        self._key, key = jax.random.split(self._key)
        return key


def _space(spec: ArraySpec) -> spaces.Box | spaces.MultiBinary:
    """All that an array of this shape and type can hold."""
    dtype = np.dtype(spec.dtype)
    if dtype.kind == "b":
        return spaces.MultiBinary(spec.shape)
    if np.issubdtype(dtype, np.integer):
        return spaces.Box(np.iinfo(dtype).min, np.iinfo(dtype).max, spec.shape, dtype.type)
    return spaces.Box(-np.inf, np.inf, spec.shape, dtype.type)


@struct.dataclass
class HostEpisode:
    """An episode that a simulator on the host can play again: its seed and its actions so far are its whole state."""

    seed: jax.Array  # () uint32
    actions: jax.Array  # (horizon,) or (horizon, size), those up to `time`; zeros after it
    time: jax.Array  # () int32, steps since the reset, at most the horizon
    observation: jax.Array  # (*observation_shape)  at `time`
    state: jax.Array  # (*state_shape)  at `time`
    over: jax.Array  # () bool


class FromGymnasium(Environment):
    """A Gymnasium environment, stepped on the host, inside our compiled programs.

    What an episode is at a moment follows from the seed of its reset and its actions since, so those are the
    `EnvState`, and `reset` and `step` are pure functions. The host keeps a live simulator for each episode that was
    stepped lately, and plays an episode again from its seed where it has none: after `--resume`, when memory is short,
    or when one moment is stepped twice. Hence training resumes bit for bit, and any moment may be stepped in any order.

    What is lost against an environment in JAX: speed (each step waits for Python, one environment after the other, and
    our learners reset at every step what they may need); memory, since each moment holds the actions of its episode, so
    that stage 1 of N episodes with T steps of A numbers takes 4 N T^2 A bytes (500 of CartPole-v1's 500 steps: 0.5 GB);
    compiled programs with a callback are not kept on disk; and the simulator must repeat itself exactly for a seed,
    which is tried once when the adapter is made. An episode that is over stays at its last moment.
    """

    def __init__(
        self, make: Callable[[], gymnasium.Env], *, horizon: int | None = None, name: str | None = None,
        state: str | None = None, variables: Sequence[Variable] = (), room: int = 64,
    ) -> None:
        """Args:
            make: makes a simulator, e.g. `functools.partial(gymnasium.make, "CartPole-v1")`. Called for each live one.
            horizon: time limit in steps; None: the one it is registered with. Its own truncation counts too.
            name: for files and tables; None: its registered id, or the class's name.
            state: the entry of `info` that holds the privileged state, an array; None: the observation is the state.
            variables: a name for each number of the flattened state, for probes.
            room: simulators kept alive at least; more are made for a batch that needs them, and closed after it.

        Raises:
            ValueError: no callable, spaces other than Box and Discrete, no time limit, no such entry of `info`,
                variables that do not fit the state, or a simulator that does not repeat itself for a seed.
        """
        if not callable(make):
            raise ValueError(f"make: got {make!r}, accepted: a callable that makes a simulator, e.g. "
                             'functools.partial(gymnasium.make, "CartPole-v1")')
        self._make, self._entry, self._least, self._room = make, state, room, room
        self._live: collections.OrderedDict[tuple[int, bytes], gymnasium.Env] = collections.OrderedDict()
        self._smaller = 0  # batches in a row that need less room than there is
        self._lock = threading.Lock()  # seeds on several devices call at the same time
        env = make()
        self.name = name or (env.spec.id if env.spec is not None else type(env.unwrapped).__name__)
        registered = env.spec.max_episode_steps if env.spec is not None else None
        limit = registered if horizon is None else horizon
        if limit is None:
            raise ValueError(f"horizon: {self.name} has no time limit of its own, accepted: a number of steps")
        if limit < 1:
            raise ValueError(f"horizon: got {limit}, accepted: a number of steps >= 1")
        self.horizon = int(limit)
        self._space = env.observation_space
        self.observation_spec = self._spec_of(env.observation_space)
        self.action_spec = self._actions(env.action_space)
        self._action_shape = () if isinstance(self.action_spec, DiscreteActions) else (self.action_spec.size,)
        self._action_type = np.int32 if isinstance(self.action_spec, DiscreteActions) else np.float32
        self.state_spec = self._spec_of_state(env)
        size = int(np.prod(self.state_spec.shape))
        if variables and len(variables) != size:
            raise ValueError(f"variables: got {len(variables)}, accepted: one for each of the state's {size} numbers")
        self.variables = tuple(variables)
        self._require_repeatable(env)

    # ------------------------------------------------------------------------------------------------ in the program

    def reset(self, key: jax.Array) -> tuple[HostEpisode, TimeStep]:
        """As the simulator resets, with a seed drawn from `key`."""
        seed = jax.random.bits(key, (), jnp.uint32) >> 1  # seeds of 31 bits suit every library
        observation, state = jax.pure_callback(
            self._host_reset, self._shapes[:2], seed, vmap_method="broadcast_all")
        false = jnp.zeros((), bool)
        episode = HostEpisode(
            seed, jnp.zeros((self.horizon, *self._action_shape), self._action_type), jnp.zeros((), jnp.int32),
            observation, state, false)
        return episode, TimeStep(observation, state, jnp.zeros(()), false, false)

    def step(self, key: jax.Array, env_state: HostEpisode, action: jax.Array) -> tuple[HostEpisode, TimeStep]:
        """As the simulator steps; what is random follows from its seed."""
        del key
        action = jnp.asarray(action, self._action_type)
        observation, state, reward, terminated, truncated = jax.pure_callback(
            self._host_step, self._shapes, env_state.seed, env_state.actions, env_state.time, env_state.over, action,
            vmap_method="broadcast_all")
        moves = ~env_state.over
        observation = jnp.where(moves, observation, env_state.observation)
        state = jnp.where(moves, state, env_state.state)
        time = env_state.time + moves.astype(jnp.int32)
        actions = jnp.where(moves, env_state.actions.at[env_state.time].set(action), env_state.actions)
        truncated = (truncated | (time >= self.horizon)) & ~terminated
        episode = HostEpisode(
            env_state.seed, actions, time, observation, state, env_state.over | terminated | truncated)
        return episode, TimeStep(observation, state, reward, terminated, truncated)

    def ground_truth(self, env_state: HostEpisode) -> jax.Array:
        """(n,) float32: the state, flattened, where its numbers have names."""
        if not self.variables:
            return super().ground_truth(env_state)
        return jnp.ravel(env_state.state).astype(jnp.float32)

    @property
    def _shapes(self) -> tuple[jax.ShapeDtypeStruct, ...]:
        specs = (self.observation_spec, self.state_spec, ArraySpec(()), ArraySpec((), bool), ArraySpec((), bool))
        return tuple(jax.ShapeDtypeStruct(spec.shape, spec.dtype) for spec in specs)

    # --------------------------------------------------------------------------------------------------- on the host

    def _host_reset(self, seed: Any) -> tuple[np.ndarray, ...]:
        """Start (*batch) episodes: their observations and states."""
        seeds = np.asarray(seed)
        with self._lock:
            self._make_room(seeds.size)
            rows = [self._start(int(one))[1] for one in seeds.ravel()]
        return self._stacked(rows, seeds.shape, 2)

    def _host_step(self, seed: Any, actions: Any, time: Any, over: Any, action: Any) -> tuple[np.ndarray, ...]:
        """Step those of (*batch) episodes that are not over."""
        seeds, times, ended = np.asarray(seed), np.ravel(time), np.ravel(over)
        histories = np.asarray(actions).reshape((seeds.size, self.horizon, *self._action_shape))
        moves = np.asarray(action).reshape((seeds.size, *self._action_shape))
        nothing = tuple(np.zeros(shape.shape, shape.dtype) for shape in self._shapes)
        with self._lock:
            self._make_room(seeds.size)
            rows = [nothing if ended[i] else self._advance(int(one), histories[i, : times[i]], moves[i])
                    for i, one in enumerate(seeds.ravel())]
        return self._stacked(rows, seeds.shape, len(nothing))

    def _stacked(self, rows: Sequence[Sequence[Any]], batch: tuple[int, ...], number: int) -> tuple[np.ndarray, ...]:
        return tuple(
            np.stack([row[i] for row in rows]).astype(shape.dtype).reshape((*batch, *shape.shape))
            for i, shape in enumerate(self._shapes[:number]))

    def _make_room(self, batch: int) -> None:
        # A learner steps a batch and resets as many at every step, beside what an evaluation plays. A larger batch, as
        # of stage 1, is over when batches are smaller again for as many steps as an episode has.
        if 4 * batch >= self._room:
            self._room, self._smaller = 4 * batch, 0
            return
        self._smaller += 1
        if self._smaller > 2 * self.horizon:
            self._room, self._smaller = max(self._least, 4 * batch), 0
            while len(self._live) > self._room:
                self._live.popitem(last=False)[1].close()

    def close(self) -> None:
        """Close all simulators; more are made when the environment is stepped again."""
        with self._lock:
            while self._live:
                self._live.popitem()[1].close()

    def _start(self, seed: int) -> tuple[gymnasium.Env, tuple[np.ndarray, np.ndarray]]:
        """Reset a simulator: the one that was left alone longest, once there are enough."""
        env = self._live.popitem(last=False)[1] if len(self._live) >= self._room else self._make()
        observation, info = env.reset(seed=seed)
        self._keep(seed, b"", env)
        return env, self._views(observation, info)

    def _keep(self, seed: int, history: bytes, env: gymnasium.Env) -> None:
        """Remember which moment a simulator is at; another one at the same moment is not needed any more."""
        if (same := self._live.pop((seed, history), None)) is not None:
            same.close()
        self._live[seed, history] = env

    def _advance(self, seed: int, history: np.ndarray, action: np.ndarray) -> tuple[Any, ...]:
        env = self._live.get((seed, history.tobytes()))
        if env is None:
            env, _ = self._start(seed)
            for past in history:
                env.step(self._to_theirs(past))
            del self._live[seed, b""]
        else:
            del self._live[seed, history.tobytes()]
        observation, reward, terminated, truncated, info = env.step(self._to_theirs(action))
        self._keep(seed, history.tobytes() + action.tobytes(), env)
        return *self._views(observation, info), np.float32(reward), np.bool_(terminated), np.bool_(truncated)

    def _to_theirs(self, action: np.ndarray) -> Any:
        if isinstance(self.action_spec, DiscreteActions):
            return int(action) + self._first_action
        return self._low + 0.5 * (np.clip(action, -1, 1) + 1) * (self._high - self._low)

    def _views(self, observation: Any, info: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Observation and state as arrays."""
        if isinstance(self._space, spaces.Discrete):
            seen = np.zeros(self.observation_spec.shape, np.float32)
            seen[int(observation) - int(self._space.start)] = 1
        else:
            seen = np.asarray(observation, self.observation_spec.dtype)
        return seen, (seen if self._entry is None else np.asarray(info[self._entry], self.state_spec.dtype))

    # ------------------------------------------------------------------------------------------------ what it is like

    def _spec_of(self, space: spaces.Space) -> ArraySpec:
        if isinstance(space, spaces.Discrete):
            return ArraySpec((int(space.n),))
        if isinstance(space, spaces.Box):
            return ArraySpec(space.shape, np.uint8 if space.dtype == np.uint8 else np.float32)
        raise ValueError(f"{self.name}: its observations are {type(space).__name__}, accepted: Box, Discrete, or "
                         "what gymnasium.wrappers.FlattenObservation makes of others")

    def _spec_of_state(self, env: gymnasium.Env) -> ArraySpec:
        if self._entry is None:
            return self.observation_spec
        info = env.reset(seed=0)[1]
        if self._entry not in info:
            raise ValueError(f"state: the info of {self.name} has no {self._entry!r}, accepted: "
                             f"{', '.join(info) or 'none, info is empty'}")
        state = np.asarray(info[self._entry])
        return ArraySpec(state.shape, np.uint8 if state.dtype == np.uint8 else np.float32)

    def _actions(self, space: spaces.Space) -> ActionSpec:
        if isinstance(space, spaces.Discrete):
            self._first_action = int(space.start)
            return DiscreteActions(int(space.n))
        real = np.issubdtype(space.dtype, np.floating)
        if isinstance(space, spaces.Box) and len(space.shape) == 1 and space.is_bounded() and real:
            self._low, self._high = np.asarray(space.low, np.float32), np.asarray(space.high, np.float32)
            return ContinuousActions(int(space.shape[0]))
        raise ValueError(f"{self.name}: its actions are {space}, accepted: Discrete, or a flat Box of real "
                         "numbers with bounds")

    def _require_repeatable(self, env: gymnasium.Env, steps: int = 20) -> None:
        """Play one seed twice in `env`, with another episode in between, and once in a new simulator."""
        draw = np.random.default_rng(0)
        number = min(steps, self.horizon)
        if isinstance(self.action_spec, DiscreteActions):
            actions = draw.integers(self.action_spec.num, size=number)
        else:
            actions = draw.uniform(-1, 1, (number, self.action_spec.size)).astype(np.float32)

        def play(env: gymnasium.Env, seed: int) -> list[np.ndarray]:
            seen = [*self._views(*env.reset(seed=seed))]
            for action in actions:
                observation, reward, terminated, truncated, info = env.step(self._to_theirs(action))
                seen += [*self._views(observation, info), np.asarray(reward, np.float32)]
                if terminated or truncated:
                    break
            return seen

        fresh = self._make()
        first, _, again, anew = play(env, 1), play(env, 2), play(env, 1), play(fresh, 1)
        env.close()
        fresh.close()
        for other in (again, anew):
            if len(first) != len(other) or not all(map(np.array_equal, first, other)):
                raise ValueError(f"{self.name}: two episodes with the same seed and actions differ, accepted: a "
                                 "simulator whose randomness follows from reset(seed=...) alone")

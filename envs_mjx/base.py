"""The contract of an environment.

An environment is an immutable object whose `reset` and `step` are pure functions of their arguments, so that they can
be compiled, mapped over a batch and scanned over time. Everything an environment remembers lives in its `EnvState`.
Two rules keep learning correct:

* `step` never resets. Who runs the environment resets it, with a fresh key, so that hidden variables are drawn anew
  and the final observation of an episode is never lost.
* `TimeStep.observation` is all that a policy may ever see; `TimeStep.state` is for training only.
"""

import abc
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

EnvState = Any
"""Whatever pytree an environment needs to continue: its own frozen dataclass."""


@struct.dataclass
class TimeStep:
    """What one step shows."""

    observation: jax.Array  # (*observation_shape)  all that a policy may ever see
    state: jax.Array  # (*state_shape)  privileged: training only
    reward: jax.Array  # ()  float32, received on arriving here; 0 after a reset
    terminated: jax.Array  # ()  bool: the task ended
    truncated: jax.Array  # ()  bool: the time limit was reached

    @property
    def done(self) -> jax.Array:
        """() bool: the episode is over, for either reason."""
        return self.terminated | self.truncated


@struct.dataclass
class Demonstrations:
    """N whole episodes of an expert, of at most T = horizon steps; what follows an episode's end is meaningless.

    They hold moments, not images: `Environment.show` gives back what each of them showed.
    """

    env_state: EnvState  # leaves (N, T + 1, ...)
    action: jax.Array  # (N, T, ...)  action t leads from moment t to moment t + 1
    length: jax.Array  # (N,) int32  steps of each episode
    success: jax.Array  # (N,) bool  whether the episode solved the task
    intended: jax.Array | None = None  # (N, T, ...)  what the expert meant to do, and is to be imitated; None: what it
    # did


@dataclasses.dataclass(frozen=True)
class ArraySpec:
    """Shape and dtype of an observation or a state. Images are (rows, columns, channels)."""

    shape: tuple[int, ...]
    dtype: Any = np.float32
    blank: int = 0
    """Trailing channels of an image that are always 0: learners may leave them out of what they store and encode."""
    contrast: float = 0.0
    """The difference between two pixels that matters, of an image whose level does not: phi and psi see it relative to
    the mean of its first channel, in this unit. 0: they see it as it is."""

    @property
    def is_image(self) -> bool:
        """Whether the array has rows, columns and channels."""
        return len(self.shape) == 3


@dataclasses.dataclass(frozen=True)
class DiscreteActions:
    """Actions 0 .. num - 1, int32 scalars."""

    num: int
    names: tuple[str, ...] = ()

    def sample(self, key: jax.Array) -> jax.Array:
        """() int32 drawn uniformly."""
        return jax.random.randint(key, (), 0, self.num, jnp.int32)


@dataclasses.dataclass(frozen=True)
class ContinuousActions:
    """Actions in [-1, 1]^size, float32 vectors."""

    size: int
    names: tuple[str, ...] = ()

    def sample(self, key: jax.Array) -> jax.Array:
        """(size,) float32 drawn uniformly."""
        return jax.random.uniform(key, (self.size,), jnp.float32, -1.0, 1.0)


ActionSpec = DiscreteActions | ContinuousActions


@dataclasses.dataclass(frozen=True)
class Interface:
    """What a program needs to know to stand in for the environment, a robot's above all; policies are exported with it.
    """

    observation: str = ""
    """What an observation shows."""
    observation_unit: str = ""
    observation_range: tuple[float, float] | None = None
    """Smallest and largest number that a policy may be shown; None: those of the listed observations or of the dtype,
    and without either any finite number."""
    action: str = ""
    """What an action does."""
    action_scale: tuple[float, ...] = ()
    """What 1 means in each entry of a continuous action, in the units below."""
    action_units: tuple[str, ...] = ()
    frame: str = ""
    """Which way the axes of observations and actions point."""
    rate: float | None = None
    """Steps per second; None: time does not matter."""


@dataclasses.dataclass(frozen=True)
class Variable:
    """A ground-truth quantity that probes try to decode from learned features.

    `num_values` is the number of classes of a categorical variable, whose values are 0 .. num_values - 1; None means a
    real number. `hidden` tells whether a single observation usually leaves it unknown.
    """

    name: str
    hidden: bool
    num_values: int | None = None


class Environment(abc.ABC):
    """A partially observable task whose true state is available during training.

    Subclasses set the attributes below and implement `reset` and `step`; the other methods are optional.
    """

    name: str
    """Short name for files and tables."""
    horizon: int
    """Time limit of an episode, in steps."""
    observation_spec: ArraySpec
    state_spec: ArraySpec
    action_spec: ActionSpec
    variables: tuple[Variable, ...] = ()
    """What `ground_truth` returns, for probes; empty when nothing is declared."""
    interface: Interface = Interface()
    """What an exported policy's contract says of observations and actions."""

    @abc.abstractmethod
    def reset(self, key: jax.Array) -> tuple[EnvState, TimeStep]:
        """Start an episode: draw the hidden variables and the start, show the first observation."""

    @abc.abstractmethod
    def step(self, key: jax.Array, env_state: EnvState, action: jax.Array) -> tuple[EnvState, TimeStep]:
        """Apply `action`. Never resets; stepping a finished episode is undefined."""

    def success(self, timestep: TimeStep) -> jax.Array:
        """() bool: whether the episode that ends with `timestep` solved the task. Default: it terminated rewarded."""
        return timestep.terminated & (timestep.reward > 0)

    def ground_truth(self, env_state: EnvState) -> jax.Array:
        """(len(variables),) float32: the current values of `variables`."""
        del env_state
        return jnp.zeros((0,), jnp.float32)

    def reveals(self, env_state: EnvState) -> jax.Array:
        """() bool: whether the current observation shows what is otherwise hidden (an information cell)."""
        del env_state
        return jnp.zeros((), bool)

    def all_observations(self) -> np.ndarray | None:
        """(D, *observation_shape) every observation there can be, each once; None, the default, when too many to list.

        Learners store and encode listed observations once, however often they are seen.
        """
        return None

    def show(self, env_state: EnvState) -> TimeStep:
        """What `reset` or `step` showed when it returned `env_state`, so that moments can be stored in place of frames.

        Raises:
            NotImplementedError: by default. Only environments that have `demonstrations` need it.
        """
        del env_state
        raise NotImplementedError(f"environment {self.name!r} does not show a moment again")

    def demonstrations(self, key: jax.Array, number: int) -> Demonstrations | None:
        """`number` episodes of an expert, those that solve the task first; None, the default, without an expert.

        A pure function of `key`, to be compiled with `number` fixed.
        """
        del key, number
        return None

    def augment(self, key: jax.Array, env_state: EnvState, action: jax.Array) -> tuple[EnvState, jax.Array]:
        """A moment and an action, as they would be in a world that a symmetry of the task has moved.

        `key` draws the symmetry, and nothing else does: with one key for both of its moments a transition stays one,
        with one key for all of its moments an episode does. Default: the world as it is.
        """
        del key
        return env_state, action


def shows_again(env: Environment) -> bool:
    """Whether the environment can show a moment again, so that moments can be stored in place of frames."""
    env_state, _ = jax.eval_shape(env.reset, jax.random.key(0))
    try:
        shown = jax.eval_shape(env.show, env_state)
    except (NotImplementedError, TypeError):  # a user's method of that name may be another
        return False
    return isinstance(shown, TimeStep)

"""Episodes in the other world, in the halves of the paper's Table 1: the first object worked on moves, or does not."""

import dataclasses
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.robot import film
from envs_mjx.robot.planner import Planner
from envs_mjx.robot.realworld import IMMOVABLE, MOVABLE, NOTHING_TOUCHED, RealState, RealWorld
from envs_mjx.robot.task import OUTCOMES, RUNNING, STOPPED, SUCCESS, RobotTask


class Policy(Protocol):
    """What acts in an episode. It remembers in what it hands back, nowhere else."""

    looks: bool
    """Whether it needs observations; most of the time goes into them."""

    def start(self, key: jax.Array, env_state: RealState) -> Any:
        """What it remembers at the start of an episode."""
        ...

    def act(self, memory: Any, observation: np.ndarray | None, env_state: RealState) -> tuple[Any, np.ndarray]:
        """The new memory, and an action (4,). A policy has the observation (84, 84, 2), only an expert `env_state`."""
        ...


class ExpertPolicy:
    """The scripted expert, which reads poses: the best that the dynamics of the other world allow, whatever is seen."""

    looks = False

    def __init__(self, training: RobotTask) -> None:
        """Args: training: the task."""
        planner = Planner(training)
        self._start, self._act = jax.jit(planner.start), jax.jit(planner.act)

    def start(self, key: jax.Array, env_state: RealState) -> Any:
        """Choose an object at random."""
        return self._start(key, env_state.robot)

    def act(self, memory: Any, observation: np.ndarray | None, env_state: RealState) -> tuple[Any, np.ndarray]:
        """See `Planner.act`."""
        del observation
        action, memory = self._act(memory, env_state.robot)
        return memory, np.asarray(action)


@dataclasses.dataclass(frozen=True)
class RealEpisode:
    """One episode, from the reset to its end."""

    states: list[RealState]

    @property
    def length(self) -> int:
        """Steps."""
        return len(self.states) - 1

    @property
    def outcome(self) -> int:
        """An index into `task.OUTCOMES`."""
        return self.states[-1].outcome

    @property
    def first_touched(self) -> int:
        """`realworld.NOTHING_TOUCHED`, `IMMOVABLE` or `MOVABLE`."""
        return self.states[-1].first_touched


def play(world: RealWorld, policy: Policy, key: jax.Array, movable: int | None = None) -> RealEpisode:
    """One episode; all that `key` draws is the same whichever object is `movable`."""
    key_reset, key_policy, key_steps = jax.random.split(key, 3)
    env_state = world.begin(key_reset, movable)
    memory, states = policy.start(key_policy, env_state), [env_state]
    while env_state.outcome == RUNNING:
        observation = world.observe(env_state) if policy.looks else None
        memory, action = policy.act(memory, observation, env_state)
        env_state = world.advance(jax.random.fold_in(key_steps, len(states)), env_state, action)
        states.append(env_state)
    return RealEpisode(states)


def play_beginning_with(world: RealWorld, policy: Policy, key: jax.Array, first: int) -> RealEpisode:
    """One episode in which the first object touched is the `IMMOVABLE` or the `MOVABLE` one.

    Both look the same, so that a policy touches the same object first, whichever of them moves. When it is not the
    wanted one, the same episode is played again with the other object movable: the scene and the policy's choice stay
    as they were drawn, and only the answer to it is another one. An episode that touches nothing is left as it is.
    """
    episode = play(world, policy, key)
    if episode.first_touched in (first, NOTHING_TOUCHED):
        return episode
    return play(world, policy, key, 1 - int(episode.states[0].robot.movable))


@dataclasses.dataclass(frozen=True)
class Half:
    """Episodes counted: a row of the table."""

    name: str
    episodes: int
    success: int
    protective_stops: int
    misses: int
    """What ended otherwise: by the time limit, or with the object out of the workspace."""
    mean_length: float


def halves(episodes: list[RealEpisode]) -> list[Half]:
    """Rows by the object that was touched first, those that there are, and one for all episodes."""
    rows = []
    for name, wanted in (("the immovable object", IMMOVABLE), ("the movable object", MOVABLE),
                         ("neither", NOTHING_TOUCHED), ("all", None)):
        chosen = [episode for episode in episodes if wanted is None or episode.first_touched == wanted]
        if chosen:
            outcomes = np.array([episode.outcome for episode in chosen])
            success, stops = int((outcomes == SUCCESS).sum()), int((outcomes == STOPPED).sum())
            length = float(np.mean([episode.length for episode in chosen]))
            rows.append(Half(name, len(chosen), success, stops, len(chosen) - success - stops, length))
    return rows


def frames(world: RealWorld, episode: RealEpisode) -> list[np.ndarray]:
    """(height, width, 3) uint8 each: what the cameras make of it, what training would show, a view from the side."""
    render, pictures = jax.jit(lambda moment: world.training.render(moment)[0]), []
    for state in episode.states:
        panels = {"fused from three cameras (observation)": film.grey(world.observe(state)[..., 0]),
                  "as in training": film.grey(np.asarray(render(jax.tree.map(jnp.asarray, state.robot)))[..., 0]),
                  "the other world; red moves": world.picture(state)}
        caption = f"step {int(state.robot.time)}  {OUTCOMES[state.outcome]}  pressed {state.pressed:.0f} N"
        pictures.append(film.side_by_side(panels, caption))
    return pictures

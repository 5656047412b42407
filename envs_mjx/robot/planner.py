"""The scripted experts (paper Appendix C.1), and demonstrations from one compiled call.

An expert chooses an object, at random or the nearer one, and works on it: it hovers above where the work starts, goes
down, and pulls or pushes. When the object does not move for a while, it changes over to the other one, or begins anew
if it has moved this one before. It reads poses, but not which object is movable. Lengths in metres, angles in radians.

A step is cut to the largest length along its way, so that a stroke is straight and a turned one is the stroke of the
turned scene. (The original cuts x and y each to the limits, and goes up to 45 degrees off the line. Imitation
alone on Block-Pushing: 0.936 of 1 024 episodes so, and with copies' actions clipped; 0.972 without either.)
"""

import jax
import jax.numpy as jnp
from flax import struct

from envs_mjx.robot import scene
from envs_mjx.robot.task import RUNNING, SUCCESS, RobotState, RobotTask

_STAGES = 3
_WORK = _STAGES - 1
_MOVED = 0.003
"""An object that moves less in one step of work counts as standing still: contacts give way a little."""
_BATCH = 16
"""Episodes side by side: the fastest on a CPU."""
_RETREAT_STEPS = 2
_ROUNDS = 10
"""Rounds of episodes, at most, until there are enough demonstrations: for experts that fail up to nine times in ten."""


@struct.dataclass
class PlannerState:
    """What an expert remembers."""

    chosen: jax.Array  # () int32, the object that it works on
    stage: jax.Array  # () int32: hover, down, work
    stuck: jax.Array  # () int32, steps of work without motion
    loose: jax.Array  # () bool, whether it has moved that object
    retreating: jax.Array  # () int32, steps of retreat that are left
    seen: jax.Array  # (2, 2) where the objects were before the last action


@struct.dataclass
class Trajectory:
    """An episode of at most T steps; what follows its end is meaningless. `RobotTask.show` gives the images back."""

    states: RobotState  # leading axis T + 1
    actions: jax.Array  # (T, 4) what was done
    intended: jax.Array  # (T, 4) what the expert meant to do, without noise
    length: jax.Array  # () int32, steps of the episode
    outcome: jax.Array  # () int32, how it ended: an index into `task.OUTCOMES`
    first: jax.Array  # () int32, the object that was chosen first

    @property
    def success(self) -> jax.Array:
        """() bool: whether the episode ended with the task solved."""
        return self.outcome == SUCCESS


class Planner:
    """The expert of a task. `act` is a pure function."""

    def __init__(self, env: RobotTask, changes_over: bool = True, noise: float = 0.0) -> None:
        """How the expert works.

        Args:
            env: its task.
            changes_over: False gives one that works on its first choice for ever, for comparison.
            noise: standard deviation of what is added to its actions in `play`, in fractions of the largest action. It
                sees what comes of it and makes it good.
        """
        self.env = env
        self.changes_over = changes_over
        self.noise = noise

    def start(self, key: jax.Array, env_state: RobotState) -> PlannerState:
        """Choose an object at random, or the nearer one."""
        chosen = jax.random.bernoulli(key)
        if self.env.plan.nearer_first:
            chosen = jnp.argmin(jnp.linalg.norm(self.env.object_offsets(env_state), axis=1))
        return self.start_with(chosen.astype(jnp.int32), env_state)

    def start_with(self, chosen: jax.Array, env_state: RobotState) -> PlannerState:
        """Choose the object `chosen`, () int32."""
        zero = jnp.zeros((), jnp.int32)
        return PlannerState(chosen, zero, zero, jnp.zeros((), bool), zero, self.env.object_poses(env_state)[:, :2])

    def act(self, planner: PlannerState, env_state: RobotState) -> tuple[jax.Array, PlannerState]:
        """The action (4,) in [-1, 1], and what to remember."""
        objects = self.env.object_poses(env_state)
        moved = jnp.linalg.norm(objects[planner.chosen, :2] - planner.seen[planner.chosen]) > _MOVED
        working = planner.stage == _WORK
        loose = planner.loose | (working & moved)
        stuck = jnp.where(working & ~moved, planner.stuck, 0)
        anew = (stuck >= self.env.plan.patience) & self.changes_over
        change = anew & ~loose
        chosen = jnp.where(change, 1 - planner.chosen, planner.chosen)
        stage = jnp.where(anew, 0, planner.stage)
        retreating = jnp.where(anew, _RETREAT_STEPS, planner.retreating)

        error = self._waypoints(objects, chosen, env_state.goal)[stage] - env_state.qpos[:4]
        error = error.at[3].set(_wrap_half_turn(error[3]))
        steps = error / scene.ACTION_SCALE
        distance = jnp.linalg.norm(steps[:2])
        arrives = (distance < 1) & (jnp.abs(steps[2:]) < 1).all() & (retreating == 0)
        straight = jnp.clip(steps.at[:2].divide(jnp.maximum(distance, 1.0)), -1.0, 1.0)
        action = jnp.where(retreating > 0, jnp.array(self.env.plan.retreat, jnp.float32), straight)
        return action, PlannerState(
            chosen=chosen,
            stage=jnp.where(arrives, (stage + 1) % _STAGES, stage),
            stuck=jnp.where(anew, 0, jnp.where(stage == _WORK, stuck + 1, 0)),
            loose=loose,
            retreating=jnp.maximum(retreating - 1, 0),
            seen=objects[:, :2],
        )

    def _waypoints(self, objects: jax.Array, chosen: jax.Array, goal: jax.Array) -> jax.Array:
        """(3, 4) x, y, z, yaw of the three stages."""
        plan, (begin, end, forth) = self.env.plan, self.env.stroke(objects[chosen], objects[1 - chosen], goal)
        yaw = jnp.arctan2(forth[1], forth[0]) + jnp.pi / 2
        heights = jnp.array([plan.hover, plan.work, plan.work], jnp.float32)
        places = jnp.clip(jnp.stack([begin, begin, end]), scene.WORKSPACE_LOW[None, :2], scene.WORKSPACE_HIGH[None, :2])
        return jnp.concatenate([places, heights[:, None], jnp.broadcast_to(yaw, (_STAGES, 1))], axis=1)

    def play(self, key: jax.Array, first: jax.Array | None = None) -> Trajectory:
        """One episode. `first` () int32: 0 begins with the immovable object, 1 with the movable one; None: at random.

        The scene is drawn as `env.reset` draws it from the first of three splits of `key`.
        """
        key_reset, key_start, key_steps = jax.random.split(key, 3)
        env_state, _ = self.env.reset(key_reset)
        planner = self.start(key_start, env_state)
        if first is not None:
            planner = self.start_with(jnp.where(first == 1, env_state.movable, 1 - env_state.movable), env_state)

        def step(carry: tuple, key: jax.Array) -> tuple[tuple, tuple]:
            env_state, planner = carry
            intended, planner = self.act(planner, env_state)
            action = intended
            if self.noise:
                noise = self.noise * jax.random.normal(jax.random.fold_in(key, 1), action.shape)
                action = jnp.clip(action + noise, -1.0, 1.0)
            env_state, _ = self.env.step(key, env_state, action)
            return (env_state, planner), (env_state, action, intended)

        keys = jax.random.split(key_steps, self.env.horizon)
        _, (later, actions, intended) = jax.lax.scan(step, (env_state, planner), keys)
        states = jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), env_state, later)
        end = jnp.argmax(states.outcome != RUNNING).astype(jnp.int32)
        return Trajectory(states, actions, intended, end, states.outcome[end], planner.chosen)


def demonstrations(env: RobotTask, key: jax.Array, number: int = 80, spare: float = 0.25) -> Trajectory:
    """`number` demonstrations, successful ones first: those of enough episodes to have as many, in their order.

    An expert that seldom fails has them of one round of episodes. One that presses down with a shaking hand, where that
    is a protective stop, takes a second, and after `_ROUNDS` the rest are failures.

    Args:
        spare: how many more episodes a round plays at least, as a fraction of `number`.

    Returns:
        Trajectories with a leading axis `number`. Check `success`: it is False where too few succeeded.
    """
    played = -(-(number + int(number * spare)) // _BATCH) * _BATCH  # whole batches: a partial one is compiled by itself
    planner = Planner(env, noise=env.expert_noise)

    def round_of(key: jax.Array) -> Trajectory:
        return jax.lax.map(planner.play, jax.random.split(key, played), batch_size=_BATCH)

    def again(carry: tuple[jax.Array, Trajectory]) -> tuple[jax.Array, Trajectory]:
        rounds, kept = carry
        more = round_of(jnp.where(rounds == 0, key, jax.random.fold_in(key, played + rounds)))  # no episode's key
        episodes = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), kept, more)
        last = jnp.where(episodes.outcome == RUNNING, 2, 1)  # what was not played, after failures
        order = jnp.argsort(jnp.where(episodes.success, 0, last), stable=True)[:number]
        return rounds + 1, jax.tree.map(lambda x: x[order], episodes)

    def too_few(carry: tuple[jax.Array, Trajectory]) -> jax.Array:
        rounds, kept = carry
        return (rounds < _ROUNDS) & ~kept.success.all()

    none = jax.tree.map(lambda x: jnp.zeros((number, *x.shape[1:]), x.dtype), jax.eval_shape(round_of, key))
    return jax.lax.while_loop(too_few, again, (jnp.zeros((), jnp.int32), none))[1]


def _wrap_half_turn(angle: jax.Array) -> jax.Array:
    """The same angle up to half turns, in [-pi/2, pi/2): the gripper is the same after half a turn."""
    return jnp.mod(angle + jnp.pi / 2, jnp.pi) - jnp.pi / 2

"""What the three robot tasks share: two objects that look the same from above, of which only one can be moved.

Which one is hidden, and drawn anew at every reset. Only touching tells.
"""

import abc
import dataclasses
import math
import numbers
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs_mjx.base import (
    ArraySpec,
    ContinuousActions,
    Demonstrations,
    Environment,
    Interface,
    TimeStep,
    Variable,
)
from envs_mjx.robot import depth, rotation, scene, window
from envs_mjx.robot.noise import AMPLITUDE, perlin
from envs_mjx.robot.plan import Plan, Stroke
from envs_mjx.robot.rotation import turn_places, turn_poses, turn_vectors

OUTCOMES = ("running", "success", "left the workspace", "not finite", "time limit", "protective stop")
"""What `RobotState.outcome` counts."""
RUNNING, SUCCESS, LEFT, NOT_FINITE, TIME_LIMIT, STOPPED = range(6)

_FADE = 0.04
"""Metres at the border of the window, half of them inside, over which what is declared to be in view fades."""
CONTRAST = 0.05
"""Metres: the height of an object, against depths that shift by four times as much when the gripper rises. The fingers,
painted 0, still tell how high it is."""


@struct.dataclass
class RobotState:
    """Where everything is. Lengths in metres, angles in radians."""

    qpos: jax.Array  # (nq,) the gripper's x, y, z, yaw, then the movable object's joints
    qvel: jax.Array  # (nv,) their velocities
    poses: jax.Array  # (2, 3) x, y, yaw of both objects after the reset
    goal: jax.Array  # (2,) x, y of the goal pad; zeros in a task without one
    touched: jax.Array  # () bool, whether a finger has touched an object since the reset
    movable: jax.Array  # () int32, the hidden variable: which of the two objects can be moved
    time: jax.Array  # () int32, steps since the reset
    outcome: jax.Array  # () int32, an index into `OUTCOMES`
    noise_key: jax.Array  # (2,) uint32, of the noise in the image of this moment


class RobotTask(Environment):
    """A task given by its scene, its draws and its test of success; subclasses bring those.

    Actions in [-1, 1]^4: (dx, dy, dz) x 5 cm in the world frame and a turn x pi/8. Observation (84, 84, 2) float32: the
    depth image in metres (`envs_mjx.robot.depth`), and zeros. State: the same depth image, and that of the scene
    without the immovable object. An episode ends with reward 1 when the task is solved, and with 0 when a block leaves
    the workspace, when the gripper presses onto an object, if asked for, when the simulation is no longer finite (the
    last finite moment is kept), or after 50 steps.
    """

    horizon = 50
    action_spec = ContinuousActions(4, ("x", "y", "z", "turn"))
    observation_spec = ArraySpec((depth.SIZE, depth.SIZE, 2), np.float32, blank=1, contrast=CONTRAST)
    state_spec = ArraySpec((depth.SIZE, depth.SIZE, 2), np.float32, contrast=CONTRAST)
    interface = Interface(
        observation="channel 0: depth below a camera 6 cm above the gripper, 0 where a finger is; channel 1: zeros. "
                    "The window is 0.4 m x 0.4 m, the gripper where pixels 41 and 42 meet",
        observation_unit="m",
        observation_range=(-3 * AMPLITUDE, window.DEEPEST + 3 * AMPLITUDE),
        action="the gripper's next set-point, relative to where it is",
        action_scale=tuple(scene.ACTION_SCALE.tolist()),
        action_units=("m", "m", "m", "rad"),
        frame="the world's: rows run along x, columns along y, z up, whatever the gripper's yaw",
        rate=1 / (scene.TIME_STEP * scene.SUBSTEPS),
    )
    opening: window.Opening
    has_pad = False
    """Whether there is a goal pad, at `RobotState.goal`."""
    plan: Plan
    """How the scripted expert works; `stroke` says where."""
    expert_noise = 0.0
    """Standard deviation of what is added to the actions of demonstrations, in fractions of the largest action."""
    variables = (Variable("nearer moves", hidden=True, num_values=2),
                 *(Variable(name, hidden=False) for name in (
                     "height", "objects x", "objects y", "objects xx-yy", "objects 2xy", "objects xx+yy")))

    def __init__(self, noise: float = 0.0, stop_force: float = 0.0, expert_noise: float | None = None) -> None:
        """Options that make a policy fit for a robot.

        Args:
            noise: amplitude of the Perlin noise in the depth image, in metres (paper Appendix E.2: 0.007).
            stop_force: in newtons; pressing down harder is a protective stop (paper Section 6), which ends the episode
                with 0. The gripper's height has 2 500 N/m: 12.5 stops it 5 mm too deep. 0: never.
            expert_noise: replaces the task's own, if given. With some, demonstrations show what to do after a small
                error and after an attempt that failed.

        Raises:
            ValueError: for anything but a finite number >= 0.
        """
        expert_noise = self.expert_noise if expert_noise is None else expert_noise
        for name, value in (("noise", noise), ("stop_force", stop_force), ("expert_noise", expert_noise)):
            if isinstance(value, bool) or not isinstance(value, numbers.Real) or not 0 <= value < math.inf:
                raise ValueError(f"{name}: got {value!r}, accepted: a finite number >= 0")
        self.noise, self.stop_force, self.expert_noise = noise, stop_force, expert_noise
        farthest = max(3 * AMPLITUDE, self.noise)
        self.interface = dataclasses.replace(self.interface, observation_range=(-farthest, window.DEEPEST + farthest))
        self.physics = scene.Physics(self.xml(), self.placed)

    placed: Sequence[str]
    """Bodies of the scene that stand where `placed_poses` says."""

    @abc.abstractmethod
    def xml(self, visual: bool = False) -> str:
        """The scene as MJCF; `visual` adds what is seen but never touched, for renderers."""

    @abc.abstractmethod
    def draw(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Draw the poses (2, 3) of the objects and the goal (2,), the same for whichever object is the movable one."""

    @abc.abstractmethod
    def joints(self, pose: jax.Array) -> jax.Array:
        """(nq - 4,) positions of the movable object's joints when it is placed at `pose` (3,)."""

    @abc.abstractmethod
    def placed_poses(self, env_state: RobotState) -> jax.Array:
        """(len(placed), 3) x, y in metres and yaw in radians of `placed`, in the world's frame: all episode long."""

    @abc.abstractmethod
    def object_poses(self, env_state: RobotState) -> jax.Array:
        """(2, 3) x, y, yaw of both objects now: of what the gripper works on."""

    @abc.abstractmethod
    def solved(self, env_state: RobotState) -> jax.Array:
        """() bool: whether the task is done, which ends an episode with reward 1.

        Asked after every substep of the physics, with no more than `qpos` brought up to date: metres and radians in the
        world's frame, of a drawer how far it is open.
        """

    @abc.abstractmethod
    def stroke(self, own: jax.Array, other: jax.Array, goal: jax.Array) -> Stroke:
        """How the expert works on an object.

        Args:
            own: (3,) its pose, of `object_poses`.
            other: (3,) the other object's.
            goal: (2,) of the state.
        """

    @abc.abstractmethod
    def heights(self, env_state: RobotState) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Heights of the movable object, of the immovable one, and of the ground, each (84, 84)."""

    @abc.abstractmethod
    def turn(self, env_state: RobotState, angle: jax.Array) -> RobotState:
        """The whole scene turned by `angle` () about the middle of the workspace; `turn_common` does what all share."""

    def mirror(self, env_state: RobotState) -> RobotState:
        """The whole scene mirrored in the plane of the workspace's middle y. Default: the objects' joints stay."""
        gripper, goal = env_state.qpos[jnp.array([0, 1, 3])], env_state.goal
        x, y, yaw = rotation.mirror_poses(gripper)
        return dataclasses.replace(
            env_state, qpos=env_state.qpos.at[jnp.array([0, 1, 3])].set(jnp.stack([x, y, yaw])),
            qvel=env_state.qvel.at[jnp.array([1, 3])].multiply(-1), poses=rotation.mirror_poses(env_state.poses),
            goal=goal.at[1].set(2 * scene.CENTRE[1] - goal[1]))

    def left_workspace(self, env_state: RobotState) -> jax.Array:
        """() bool: whether the movable object is out of reach. Default: it cannot be."""
        del env_state
        return jnp.zeros((), bool)

    def reset(self, key: jax.Array) -> tuple[RobotState, TimeStep]:
        """Draw the scene and which object is movable; the gripper hovers above the middle."""
        key_draw, key_movable, key_noise = jax.random.split(key, 3)
        poses, goal = self.draw(key_draw)
        movable = jax.random.bernoulli(key_movable).astype(jnp.int32)
        qpos = jnp.concatenate([jnp.asarray(scene.START), self.joints(poses[movable])])
        zero = jnp.zeros((), jnp.int32)
        env_state = RobotState(
            qpos=qpos, qvel=jnp.zeros_like(qpos), poses=poses, goal=goal, touched=jnp.zeros((), bool), movable=movable,
            time=zero, outcome=zero, noise_key=_noise_key(key_noise))
        return env_state, self.show(env_state)

    def step(self, key: jax.Array, env_state: RobotState, action: jax.Array) -> tuple[RobotState, TimeStep]:
        """Move the gripper for 0.2 s. The dynamics are deterministic: the key serves the image's noise."""
        qpos, qvel, touched, pressed = self.physics.advance(
            self.placed_poses(env_state), env_state.qpos, env_state.qvel, scene.target_of(env_state.qpos, action),
            lambda qpos: self.solved(dataclasses.replace(env_state, qpos=qpos)))
        finite = jnp.isfinite(qpos).all() & jnp.isfinite(qvel).all()
        moved = dataclasses.replace(
            env_state, qpos=jnp.where(finite, qpos, env_state.qpos), qvel=jnp.where(finite, qvel, env_state.qvel),
            touched=env_state.touched | touched, time=env_state.time + 1, noise_key=_noise_key(key))
        pressing = pressed > self.stop_force if self.stop_force else jnp.zeros((), bool)
        late = moved.time >= self.horizon
        endings = ((NOT_FINITE, ~finite), (SUCCESS, self.solved(moved)), (STOPPED, pressing),
                   (LEFT, self.left_workspace(moved)), (TIME_LIMIT, late))
        outcome = jnp.int32(RUNNING)
        for code, condition in reversed(endings):
            outcome = jnp.where(condition, jnp.int32(code), outcome)
        moved = dataclasses.replace(moved, outcome=outcome)
        return moved, self.show(moved)

    def show(self, env_state: RobotState) -> TimeStep:
        """What `reset` or `step` showed when it returned `env_state`: poses are all that needs to be stored."""
        observation, state = self.render(env_state)
        outcome = env_state.outcome
        return TimeStep(
            observation=observation,
            state=state,
            reward=(outcome == SUCCESS).astype(jnp.float32),
            terminated=(outcome != RUNNING) & (outcome != TIME_LIMIT),
            truncated=outcome == TIME_LIMIT,
        )

    def render(self, env_state: RobotState) -> tuple[jax.Array, jax.Array]:
        """Observation and state, each (84, 84, 2) float32."""
        movable, immovable, ground = self.heights(env_state)
        painted = depth.fingers(env_state.qpos[3], self.opening.painted)
        without = jnp.maximum(movable, ground)
        seen = depth.depth(jnp.maximum(without, immovable), env_state.qpos[2], painted)
        if self.noise:
            seen += perlin(jax.random.wrap_key_data(env_state.noise_key), self.noise)
        masked = depth.depth(without, env_state.qpos[2], painted)
        return jnp.stack([seen, jnp.zeros_like(seen)], axis=-1), jnp.stack([seen, masked], axis=-1)

    def demonstrations(self, key: jax.Array, number: int) -> Demonstrations:
        """`number` episodes of the scripted expert (Appendix C.1), the successful ones of as many as it takes first."""
        from envs_mjx.robot import planner  # it builds on this module

        episodes = planner.demonstrations(self, key, number)
        return Demonstrations(
            episodes.states, episodes.actions, episodes.length, episodes.success, episodes.intended)

    def augment(self, key: jax.Array, env_state: RobotState, action: jax.Array) -> tuple[RobotState, jax.Array]:
        """The scene and the action turned by a random angle (Appendix F), mirrored before half of the time; the noise
        in the image drawn anew.

        The scene is turned and rendered again, not its image: exact, where turning pixels smooths edges, invents what
        lies beyond the border and turns the painted fingers and the pad, which stay upright in real observations.
        """
        key_angle, key_noise = jax.random.split(key)
        angle = rotation.random_angle(key_angle)
        mirrored = jax.random.bernoulli(jax.random.fold_in(key_angle, 1))
        before = env_state, action
        env_state, action = jax.tree.map(lambda a, b: jnp.where(mirrored, a, b),
                                         (self.mirror(env_state), rotation.mirror_action(action)), before)
        turned = self.turn(env_state, angle)
        noise_key = turned.noise_key ^ _noise_key(key_noise)
        return dataclasses.replace(turned, noise_key=noise_key), rotation.rotate_action(action, angle)

    def ground_truth(self, env_state: RobotState) -> jax.Array:
        """(7,) float32: whether the nearer object is the movable one; the gripper's height; the `moments_in_view` of
        both objects but for their number. Metres.
        """
        offsets = self.object_offsets(env_state)
        nearer = jnp.argmin(jnp.sum(jnp.square(offsets), axis=1))
        return jnp.concatenate([
            (nearer == env_state.movable).astype(jnp.float32)[None], env_state.qpos[2:3], moments_in_view(offsets)[1:]])

    def object_offsets(self, env_state: RobotState) -> jax.Array:
        """(2, 2) x, y of both objects from the gripper, metres."""
        return self.object_poses(env_state)[:, :2] - env_state.qpos[None, :2]

    def reveals(self, env_state: RobotState) -> jax.Array:
        """() bool: whether an object has been touched, from when on what is seen can tell which one moves."""
        return env_state.touched


def moments_in_view(offsets: jax.Array) -> jax.Array:
    """How many of the things at (N, 2) `offsets` from the gripper are in its window, and sums over them: (6,) float32
    N, x, y, xx - yy, 2xy, xx + yy.

    These tell where two equal things are without calling one of them the first, and have no jumps, neither where both
    are equally near nor at the window's edge, where a thing fades over `_FADE`. Asked for the nearer and the farther
    one in their places, psi was off by 24 and 50 mm in a tenth of images, and what imitates on its body solved less of
    Block-Pushing (results/robots).
    """
    x, y = offsets[:, 0], offsets[:, 1]
    outside = jnp.maximum(jnp.abs(x), jnp.abs(y)) - depth.WINDOW / 2
    weight = jnp.clip(0.5 - outside / _FADE, 0.0, 1.0)
    return jnp.stack([jnp.ones_like(x), x, y, x * x - y * y, 2 * x * y, x * x + y * y]) @ weight


def turn_common(env_state: RobotState, angle: jax.Array) -> RobotState:
    """Gripper, poses and goal turned by `angle` () about the middle of the workspace; the objects' joints stay."""
    gripper = turn_poses(env_state.qpos[jnp.array([0, 1, 3])], angle)
    qpos = env_state.qpos.at[:2].set(gripper[:2]).at[3].set(gripper[2])
    qvel = env_state.qvel.at[:2].set(turn_vectors(env_state.qvel[:2], angle))
    return dataclasses.replace(env_state, qpos=qpos, qvel=qvel, poses=turn_poses(env_state.poses, angle),
                               goal=turn_places(env_state.goal, angle))


def _noise_key(key: jax.Array) -> jax.Array:
    """(2,) uint32: a key that can be stored with the state."""
    return jax.random.bits(key, (2,), jnp.uint32)


def first_valid(candidates: jax.Array, valid: jax.Array) -> jax.Array:
    """Rejection by a fixed number of draws: the first of `candidates` (N, ...) that is `valid` (N,), else the first."""
    return candidates[jnp.argmax(valid)]

"""A stand-in for the robot (paper Section 6): another simulator that plays the real world, seen by three cameras.

The scenes are drawn as in training. Everything else differs: MuJoCo C with gravity, free bodies and a table
(`envs_mjx.robot.tabletop`), another time step and solver, a step of half a second, images fused from cameras that are
off in place and time and that measure badly (`envs_mjx.robot.gap` says how much), a movable object and frictions that
are not those of training, and a safety controller: pressing onto an object is a protective stop and ends the episode.

It is an `Environment` for evaluation. What `reset` and `step` give depends on their arguments and on the gap that the
world was made with alone, so that an episode can be repeated exactly, also with the other object movable. What is lost
on a host:

* they cannot be compiled, mapped or scanned, nor called by two threads at once, since each call writes all that it
  needs into the one model that MuJoCo holds: one episode at a time, arrays of NumPy, about ten steps a second;
* `TimeStep.state` is zeros: what is privileged in training is not there outside of it.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs_mjx.base import Environment, TimeStep
from envs_mjx.errors import UserError
from envs_mjx.robot import cameras as fusion
from envs_mjx.robot import scene, sensors, tabletop
from envs_mjx.robot.cameras import Cameras
from envs_mjx.robot.film import SIDE
from envs_mjx.robot.gap import Gap
from envs_mjx.robot.task import LEFT, NOT_FINITE, RUNNING, STOPPED, SUCCESS, TIME_LIMIT, RobotState, RobotTask

NOTHING_TOUCHED, IMMOVABLE, MOVABLE = -1, 0, 1
"""What `RealState.first_touched` counts."""
STOP_FORCE = 50.0
"""Newtons, pressing down: 5 mm too deep at the stiffness of `tabletop`. In 150 expert
episodes of each task, whatever the gap, it never was above 17 N (measured)."""
_TICK = 0.02  # s, between two readings of the force, two set-points and two tests of success
_TICKS, _RAMP_TICKS = 25, 15
_SUBSTEPS = round(_TICK / tabletop.TIME_STEP)


class NoOpenGL(UserError):
    """Cameras need OpenGL; the message tells which."""


@dataclasses.dataclass(frozen=True)
class Draw:
    """What one episode's world is like."""

    mass: float
    """The movable object's, as a multiple of training's; so are both frictions."""
    finger_friction: float
    slide_friction: float
    """Of the table under a block, of a drawer in its cabinet."""
    calibration: Cameras
    """Where the cameras are believed to be."""


@dataclasses.dataclass(frozen=True)
class RealState:
    """A moment of the other world."""

    robot: RobotState  # the same moment in the terms of training: what experts and tests of success read
    seen: RobotState  # the moment that the cameras show; older by the latency
    physics: np.ndarray  # (mj_stateSize,) float64, all that MuJoCo needs to continue
    draw: Draw
    first_touched: int  # by a finger: NOTHING_TOUCHED, IMMOVABLE or MOVABLE
    pressed: float  # N, the largest force downwards so far
    outcome: int  # an index into `task.OUTCOMES`
    image_key: jax.Array  # of the cameras' noise at this moment


class RealWorld(Environment):
    """One robot task in the other world. Close it when done: its cameras hold OpenGL contexts."""

    def __init__(self, training: RobotTask, gap: Gap) -> None:
        """Args: training: the task as it was trained on; gap: how different this world is."""
        self.training, self.gap = training, gap
        self.name, self.horizon = f"{training.name} in the other world", training.horizon
        self.observation_spec, self.state_spec = training.observation_spec, training.state_spec
        self.action_spec = training.action_spec
        self.model = tabletop.build(training)
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # pyright: ignore[reportAttributeAccessIssue]
        self._nominal = tabletop.build(training)
        self.data = mujoco.MjData(self.model)  # pyright: ignore[reportAttributeAccessIssue]
        self.cameras = sensors.calibration()
        try:
            self.rig = sensors.Rig(self.model, SIDE)
        except Exception as error:
            raise NoOpenGL("cameras need OpenGL without a display: EGL or OSMesa") from error
        self._finger = self._geoms_of("gripper")
        self._loose = self._geoms_of("loose", "loose_drawer")
        self._fixed = self._geoms_of("fixed", "fixed_drawer")
        self._movable = np.unique(self.model.geom_bodyid[self._loose])
        self._draw_scene = jax.jit(lambda key: training.reset(key)[0])
        self._conditions = jax.jit(lambda moment: (training.solved(moment), training.left_workspace(moment)))
        self._observe = jax.jit(lambda cameras, images, gripper, goal: fusion.observe(
            fusion.cloud(cameras, images), gripper, training.opening, goal if training.has_pad else None))

    def close(self) -> None:
        """Free the OpenGL contexts."""
        self.rig.close()

    def reset(self, key: jax.Array, movable: int | None = None) -> tuple[RealState, TimeStep]:
        """Draw a scene as training does, and a world; see `begin`."""
        state = self.begin(key, movable)
        return state, self.show(state)

    def step(self, key: jax.Array, env_state: RealState, action: np.ndarray) -> tuple[RealState, TimeStep]:
        """Move the gripper, then look; see `advance`."""
        state = self.advance(key, env_state, action)
        return state, self.show(state)

    def begin(self, key: jax.Array, movable: int | None = None) -> RealState:
        """What `reset` does, without a look.

        Args:
            key: draws all, in the same way whichever object is movable.
            movable: 0 or 1 makes that object the movable one; None draws it.
        """
        key_scene, key_world = jax.random.split(key)
        robot: RobotState = jax.device_get(self._draw_scene(key_scene))
        if movable is not None:
            joints = np.asarray(self.training.joints(robot.poses[movable]))
            robot = dataclasses.replace(
                robot, movable=np.int32(movable), qpos=np.concatenate([robot.qpos[:4], joints]))
        return self.set_up(robot, key_world)

    def set_up(self, robot: RobotState, key: jax.Array) -> RealState:
        """A moment of training in this world, at rest; `key` draws the world and the cameras' noise."""
        key_world, key_image = jax.random.split(key)
        draw = self._world(np.random.default_rng(np.asarray(jax.random.key_data(key_world))))
        self._furnish(robot, draw)
        mujoco.mj_resetData(self.model, self.data)  # pyright: ignore[reportAttributeAccessIssue]
        self._place(robot)
        return RealState(
            robot=robot, seen=robot, physics=self._physics(), draw=draw, first_touched=NOTHING_TOUCHED, pressed=0.0,
            outcome=RUNNING, image_key=key_image)

    def advance(self, key: jax.Array, env_state: RealState, action: np.ndarray) -> RealState:
        """What `step` does, without a look: half a second, or until the task is solved or the robot stops itself."""
        self._resume(env_state)
        start = self.data.qpos[:4].copy()
        wanted = np.asarray(action, np.float32)
        target = np.asarray(scene.target_of(jnp.asarray(start, jnp.float32), jnp.asarray(wanted)))
        robot, seen = env_state.robot, None
        outcome = RUNNING if np.isfinite(wanted).all() else NOT_FINITE
        pressed, touched = env_state.pressed, env_state.first_touched
        for tick in range(1, _TICKS + 1 if outcome == RUNNING else 1):
            self.data.ctrl[:] = start + (target - start) * min(tick / _RAMP_TICKS, 1.0)
            mujoco.mj_step(self.model, self.data, _SUBSTEPS)  # pyright: ignore[reportAttributeAccessIssue]
            if not (np.isfinite(self.data.qpos).all() and np.isfinite(self.data.qvel).all()):
                outcome = NOT_FINITE
                break
            force, object_met = self._contact()
            robot, pressed = self._moment(env_state.robot), max(pressed, force)
            touched = object_met if touched == NOTHING_TOUCHED else touched
            if seen is None and tick >= _TICKS - round(self.gap.latency / _TICK):
                seen = robot
            solved, left = self._conditions(robot)
            outcome = SUCCESS if solved else STOPPED if force > STOP_FORCE else LEFT if left else RUNNING
            if outcome != RUNNING:
                break
        time = env_state.robot.time + 1
        if outcome == RUNNING and time >= self.horizon:
            outcome = TIME_LIMIT
        robot = dataclasses.replace(robot, time=np.int32(time), touched=np.bool_(touched != NOTHING_TOUCHED),
                                    outcome=np.int32(outcome))
        return RealState(
            robot=robot, seen=robot if seen is None else seen, physics=self._physics(), draw=env_state.draw,
            first_touched=touched, pressed=pressed, outcome=outcome, image_key=key)

    def show(self, env_state: RealState) -> TimeStep:
        """What the cameras make of a moment, fused; the state is zeros."""
        outcome = env_state.outcome
        fields: dict[str, Any] = {  # arrays of NumPy, where training has those of JAX
            "observation": self.observe(env_state),
            "state": np.zeros(self.state_spec.shape, np.float32),
            "reward": np.float32(outcome == SUCCESS),
            "terminated": np.bool_(outcome not in (RUNNING, TIME_LIMIT)),
            "truncated": np.bool_(outcome == TIME_LIMIT),
        }
        return TimeStep(**fields)

    def observe(self, env_state: RealState, gripper: bool = True) -> np.ndarray:
        """(84, 84, 2) float32; `gripper` False takes the gripper out of the cameras' sight."""
        images = self.photograph(env_state, gripper)
        seen = env_state.seen
        return np.asarray(self._observe(env_state.draw.calibration, images, seen.qpos[:4], seen.goal))

    def photograph(self, env_state: RealState, gripper: bool = True) -> np.ndarray:
        """(3, rows, columns) float32: the cameras' depth images in metres, 0 where nothing was measured."""
        self._furnish(env_state.robot, env_state.draw)
        self._place(env_state.seen)
        exact = self.rig.images(self.data, gripper)
        return sensors.degraded(exact, float(self.cameras.intrinsics[0, 0]), self.gap, env_state.image_key)

    def picture(self, env_state: RealState) -> np.ndarray:
        """(SIDE, SIDE, 3) uint8: a view from the side, the movable object in red."""
        self._furnish(env_state.robot, env_state.draw)
        self._place(env_state.robot)
        return self.rig.picture(self.data)

    # ------------------------------------------------------------------------------------------ what MuJoCo holds

    def _world(self, generator: np.random.Generator) -> Draw:
        def factor(spread: float) -> float:
            return float(np.exp(generator.uniform(-1, 1) * np.log1p(spread)))

        return Draw(factor(self.gap.mass), factor(self.gap.friction), factor(self.gap.friction),
                    sensors.miscalibrated(self.cameras, self.gap, generator))

    def _furnish(self, robot: RobotState, draw: Draw) -> None:
        """Make the model that of an episode: where things stand that do not move, and the draw."""
        model, nominal = self.model, self._nominal
        scene.place(model, self.training.placed, np.asarray(self.training.placed_poses(robot)))
        if self.training.has_pad:
            model.body_pos[model.body("pad").id] = *robot.goal, 0
        model.body_mass[self._movable] = nominal.body_mass[self._movable] * draw.mass
        model.body_inertia[self._movable] = nominal.body_inertia[self._movable] * draw.mass
        model.geom_friction[self._finger, 0] = nominal.geom_friction[self._finger, 0] * draw.finger_friction
        table = model.geom("table").id
        model.geom_friction[table, 0] = nominal.geom_friction[table, 0] * draw.slide_friction
        model.dof_frictionloss[:] = nominal.dof_frictionloss * draw.slide_friction

    def _place(self, robot: RobotState) -> None:
        """Put the gripper and the movable object where training's positions say, at rest."""
        qpos = np.asarray(robot.qpos, np.float64)
        self.data.qpos[:4] = self.data.ctrl[:] = qpos[:4]
        if self.model.nq == 5:
            self.data.qpos[4] = qpos[4]
        else:
            x, y, yaw = qpos[4:]
            self.data.qpos[4:] = x, y, 0, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)
        self.data.qvel[:] = 0
        mujoco.mj_forward(self.model, self.data)  # pyright: ignore[reportAttributeAccessIssue]

    def _moment(self, before: RobotState) -> RobotState:
        """Where everything is now, in the terms of training."""
        qpos, qvel = self.data.qpos, self.data.qvel
        if self.model.nq > 5:
            w, i, j, k = qpos[7:11]
            yaw = np.arctan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k))
            qpos = np.concatenate([qpos[:6], [yaw]])
            qvel = np.concatenate([qvel[:6], qvel[9:10]])
        return dataclasses.replace(before, qpos=qpos.astype(np.float32), qvel=qvel.astype(np.float32))

    def _contact(self) -> tuple[float, int]:
        """The force with which the fingers press down on objects, in newtons, and which object they touch."""
        force, touched, wrench = 0.0, NOTHING_TOUCHED, np.zeros(6)
        for index in range(self.data.ncon):
            contact = self.data.contact[index]
            own = [geom in self._finger for geom in contact.geom]
            if not any(own):
                continue
            mujoco.mj_contactForce(self.model, self.data, index, wrench)  # pyright: ignore[reportAttributeAccessIssue]
            on_second = contact.frame.reshape(3, 3).T @ wrench[:3]  # its normal points from the first to the second
            force -= on_second[2] if own[0] else -on_second[2]
            other = contact.geom[1] if own[0] else contact.geom[0]
            touched = IMMOVABLE if other in self._fixed else MOVABLE if other in self._loose else touched
        return force, touched

    def _physics(self) -> np.ndarray:
        kind: Any = mujoco.mjtState.mjSTATE_INTEGRATION  # pyright: ignore[reportAttributeAccessIssue]
        state = np.empty(mujoco.mj_stateSize(self.model, kind))  # pyright: ignore[reportAttributeAccessIssue]
        mujoco.mj_getState(self.model, self.data, state, kind)  # pyright: ignore[reportAttributeAccessIssue]
        return state

    def _resume(self, env_state: RealState) -> None:
        self._furnish(env_state.robot, env_state.draw)
        kind: Any = mujoco.mjtState.mjSTATE_INTEGRATION  # pyright: ignore[reportAttributeAccessIssue]
        mujoco.mj_setState(self.model, self.data, env_state.physics, kind)  # pyright: ignore[reportAttributeAccessIssue]

    def _geoms_of(self, *bodies: str) -> np.ndarray:
        names = [self.model.body(body).name for body in self.model.geom_bodyid]
        return np.array([geom for geom, name in enumerate(names) if name in bodies])

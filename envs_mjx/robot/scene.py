"""The gripper, and the physics that all robot scenes share: a model for MuJoCo and its copy for MJX.

Everything moves in the plane, so that there is no gravity and no contact with the table: the table's friction is the
`frictionloss` of an object's joints. Contacts are between explicit pairs of geoms only. Lengths are in metres, angles
in radians; a pose (3,) is x, y, yaw.
"""

import contextlib
import dataclasses
import io
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs_mjx.robot.window import FINGER_BELOW, FINGER_RADIUS, HIGHEST

with contextlib.redirect_stdout(io.StringIO()):  # it prints that the optional package warp is missing
    from mujoco import mjx

CENTRE = np.array([0.5, 0.0], np.float32)
"""x and y of the middle of the workspace."""
WORKSPACE_LOW = np.array([0.3, -0.2, 0.01], np.float32)
WORKSPACE_HIGH = np.array([0.7, 0.2, HIGHEST], np.float32)
START = np.array([0.5, 0.0, 0.2, 0.0], np.float32)
"""x, y, z, yaw of the gripper after a reset."""
ACTION_SCALE = np.array([0.05, 0.05, 0.05, np.pi / 8], np.float32)
"""What an action of 1 asks for: metres and radians."""
GRAVITY = 9.81
FINGER_FRICTION = 0.8

TIME_STEP = 0.02
SUBSTEPS = 10
RAMP_SUBSTEPS = 6
"""The set-point moves evenly over these substeps; the others let the gripper arrive (a test allows 2.5 mm)."""
_HEIGHT = 2
"""Of the gripper, among positions and forces."""
_INERTIA = 0.005  # kg m^2, of the gripper, whose mass is 1 kg
_CONTACT = 'solref="0.04 1"'  # the shortest time constant that this time step allows


@dataclasses.dataclass(frozen=True)
class Drive:
    """What moves the gripper along one axis, critically damped."""

    stiffness: float
    """N/m, or Nm/rad."""
    limit: float
    """Newtons, or Nm."""


SLIDE, TURN = Drive(2500.0, 30.0), Drive(12.5, 3.0)


def joints_xml(height: Drive = SLIDE) -> str:
    """The gripper's mass and its joints x, y, z, yaw; `height` is what drives z."""
    joints = "".join(
        f'<joint name="gripper_{name}" type="{kind}" axis="{axis}" damping="{2 * (drive.stiffness * inertia) ** 0.5}"/>'
        for name, kind, axis, drive, inertia in (
            ("x", "slide", "1 0 0", SLIDE, 1.0), ("y", "slide", "0 1 0", SLIDE, 1.0),
            ("z", "slide", "0 0 1", height, 1.0), ("yaw", "hinge", "0 0 1", TURN, _INERTIA)))
    return f'<inertial pos="0 0 0" mass="1" diaginertia="{_INERTIA} {_INERTIA} {_INERTIA}"/>{joints}'


def drives_xml(height: Drive = SLIDE) -> str:
    """What moves those joints."""
    return "".join(
        f'<position joint="gripper_{name}" kp="{drive.stiffness}" forcerange="{-drive.limit} {drive.limit}"/>'
        for name, drive in (("x", SLIDE), ("y", SLIDE), ("z", height), ("yaw", TURN)))


def gripper_xml(offset: float, capsules: bool) -> str:
    """A body with the joints x, y, z, yaw and two fingers, their centres at `offset` along its x axis to both sides.

    A finger is a sphere at its tip, which is all that meets boxes from the side or from above: they are upright, and
    higher than the tips when these are low. `capsules` adds vertical capsules, to hook lying bars, and to be seen.
    """
    tip = FINGER_RADIUS - FINGER_BELOW
    geoms = []
    for index, x in enumerate((-offset, offset)):
        geoms.append(f'<geom name="tip{index}" type="sphere" size="{FINGER_RADIUS}" pos="{x} 0 {tip}"/>')
        if capsules:
            geoms.append(f'<geom name="finger{index}" type="capsule" size="{FINGER_RADIUS}" '
                         f'fromto="{x} 0 {tip} {x} 0 {tip + 0.05}"/>')
    return f'<body name="gripper">{joints_xml()}{"".join(geoms)}</body>'


def pair_xml(first: str, second: str, friction: float | None) -> str:
    """Lets two geoms touch; `friction` None is a contact without friction, which is cheaper."""
    kind = 'condim="1"' if friction is None else f'condim="3" friction="{friction} {friction}"'
    return f'<pair geom1="{first}" geom2="{second}" {kind} {_CONTACT}/>'


def scene_xml(gripper: str, bodies: str, pairs: Sequence[str]) -> str:
    """A whole scene. The first four positions (qpos) are the gripper's; the bodies bring the others.

    The solver's tolerance is what float32 can tell: with MuJoCo's own, 1e-8, it always iterates to the end.
    One or two iterations are not enough: objects get pushed into each other.
    """
    return f"""
    <mujoco>
      <compiler angle="radian" autolimits="true"/>
      <option timestep="{TIME_STEP}" solver="Newton" iterations="4" ls_iterations="6" tolerance="1e-5"
              cone="pyramidal" jacobian="sparse" integrator="Euler">
        <flag gravity="disable"/>
      </option>
      <default><geom contype="0" conaffinity="0"/><joint solreffriction="0.04 1" solreflimit="0.04 1"/></default>
      <worldbody>{gripper}{bodies}</worldbody>
      <contact>{"".join(pairs)}</contact>
      <actuator>{drives_xml()}</actuator>
    </mujoco>"""


def loose_joints_xml(mass: float, side: float, friction: float) -> str:
    """Joints of a square block that slides on the table: x, y and yaw, with the table's friction.

    The torque that turns a square of side `a` on the spot is friction x weight x 0.3826 a (its mean distance from the
    middle). Armature and damping keep a light block from spinning up between two fingers.
    """
    force = friction * mass * GRAVITY
    return (f'<joint type="slide" axis="1 0 0" frictionloss="{force}"/>'
            f'<joint type="slide" axis="0 1 0" frictionloss="{force}"/>'
            f'<joint type="hinge" axis="0 0 1" frictionloss="{0.3826 * side * force}" armature="2e-5" damping="1e-4"/>')


def place(model: Any, names: Sequence[str], poses: np.ndarray) -> None:
    """Let bodies of a model of MuJoCo C stand at `poses` (len(names), 3); their heights stay."""
    for name, (x, y, yaw) in zip(names, poses, strict=True):
        body = model.body(name).id
        model.body_pos[body, :2] = x, y
        model.body_quat[body] = np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)


class Physics:
    """A scene that has been built: one model for all episodes, in which some bodies are placed anew in each of them."""

    def __init__(self, xml: str, placed: Sequence[str]) -> None:
        """Args: xml: of `scene_xml`; placed: names of the bodies whose pose is an argument of `advance`."""
        self.model: Any = mujoco.MjModel.from_xml_string(xml)  # pyright: ignore[reportAttributeAccessIssue]
        self.placed = tuple(self.model.body(name).id for name in placed)
        names = [self.model.geom(geom).name for geom in range(self.model.ngeom)]
        self._fingers = np.array([geom for geom, name in enumerate(names) if name.startswith(("tip", "finger"))])
        with _as_mjx_is_written():
            self._mjx_model = mjx.put_model(self.model)
            self._data = mjx.make_data(self.model)

    def advance(
        self, poses: jax.Array, qpos: jax.Array, qvel: jax.Array, target: jax.Array,
        solved: Callable[[jax.Array], jax.Array]
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """One environment step: 0.2 s in 10 substeps, or until the task is solved.

        Args:
            poses: (len(placed), 3) of the placed bodies.
            qpos: (nq,) positions, the gripper's x, y, z, yaw first.
            qvel: (nv,) velocities.
            target: (4,) where the gripper shall arrive.
            solved: (nq,) -> () bool; everything stands still from then on.

        Returns:
            qpos, qvel, () bool whether a finger touched something on the way, and () newtons: the largest force with
            which the gripper pressed down.
        """
        model, start = self._place(poses), qpos[:4]

        def substep(carry: tuple, time: jax.Array) -> tuple[tuple, None]:
            qpos, qvel, warmstart, over, touched, pressed = carry
            control = start + (target - start) * jnp.minimum(time / RAMP_SUBSTEPS, 1.0)
            data = self._data.replace(qpos=qpos, qvel=qvel, ctrl=control, qacc_warmstart=warmstart)
            with _as_mjx_is_written():
                data = mjx.step(model, data)
            touched |= ~over & self._touches(data)
            pressed = jnp.where(over, pressed, jnp.maximum(pressed, data.qfrc_constraint[_HEIGHT]))
            qpos, qvel = (jnp.where(over, old, new) for old, new in ((qpos, data.qpos), (qvel, data.qvel)))
            return (qpos, qvel, data.qacc_warmstart, over | solved(qpos), touched, pressed), None

        first = (qpos, qvel, jnp.zeros_like(qvel), solved(qpos), jnp.zeros((), bool), jnp.zeros(()))
        times = jnp.arange(1, SUBSTEPS + 1, dtype=jnp.float32)
        (qpos, qvel, _, _, touched, pressed), _ = jax.lax.scan(substep, first, times)
        return qpos, qvel, touched, pressed

    def _touches(self, data: Any) -> jax.Array:
        """() bool: whether a finger is in contact."""
        contact = data._impl.contact
        own = (contact.geom[:, :, None] == self._fingers[None, None]).any(axis=(1, 2))
        return (own & (contact.dist <= 0)).any()

    def _place(self, poses: jax.Array) -> Any:
        bodies = np.array(self.placed)
        body_pos = self._mjx_model.body_pos.at[bodies, :2].set(poses[:, :2])
        half, zero = poses[:, 2] / 2, jnp.zeros_like(poses[:, 2])
        quaternions = jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)], axis=1)
        body_quat = self._mjx_model.body_quat.at[bodies].set(quaternions)
        return self._mjx_model.replace(body_pos=body_pos, body_quat=body_quat)


@contextlib.contextmanager
def _as_mjx_is_written() -> Iterator[None]:
    """MJX relies on JAX's implicit promotion of ranks and types, which a caller may have turned into errors."""
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield


def target_of(qpos: jax.Array, action: jax.Array) -> jax.Array:
    """(4,) where an action in [-1, 1]^4 sends the gripper: from where it is, no further than the workspace."""
    target = qpos[:4] + jnp.clip(action, -1.0, 1.0) * ACTION_SCALE
    return jnp.concatenate([jnp.clip(target[:3], WORKSPACE_LOW, WORKSPACE_HIGH), target[3:]])

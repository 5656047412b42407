"""The scenes of the other world as MJCF for MuJoCo C: the same objects, another simulation of them.

Training moves objects in the plane. Here there is gravity, blocks are free bodies that lie on a table, a drawer is a
tray with walls, fingers are as long as they look, there is a palm above them, and three cameras look on.
"""

import mujoco
import numpy as np

from envs_mjx.robot import drawer_opening as drawer
from envs_mjx.robot import scene, window
from envs_mjx.robot.blocks import Block, BlockTask
from envs_mjx.robot.cameras import look_at
from envs_mjx.robot.task import RobotTask

ROWS, COLUMNS, FOV = 480, 640, 45.0
"""Of each camera: image size in pixels, and the angle of view from top to bottom in degrees."""
EYES = {"left": (0.5, -0.65, 0.75), "right": (0.5, 0.65, 0.75), "overhead": (0.65, 0.0, 1.0)}
"""Where the cameras are, in metres; all look at the middle of the table. Right above it, the palm is more in the way:
98.7 % of the pixels are within 5 mm of training's depth, and 99.0 % here (opened drawers, the gripper in sight)."""
TIME_STEP = 0.002
GRIPPER_GROUP = 2
"""Of geoms, so that it can be left out of an image."""
FINGER_LENGTH = 0.10
_DOWN = scene.Drive(stiffness=10000.0, limit=150.0)
"""An arm's weight is behind what it presses on: stiff enough to trip a safety controller within millimetres. Sideways
it is as compliant as in training, or the immovable object would be torn off."""

# Who meets whom: fingers (1) everything; a free block (2) the table and the fixed block; drawers fingers alone.
_FINGER, _LOOSE, _STATIC = 'contype="1" conaffinity="0"', 'contype="2" conaffinity="1"', 'contype="0" conaffinity="3"'
_DRAWER, _SEEN = 'contype="0" conaffinity="1"', 'contype="0" conaffinity="0"'
_RED, _BLUE = 'rgba="0.8 0.2 0.2 1"', 'rgba="0.2 0.4 0.8 1"'
_GREY = f'rgba="0.3 0.3 0.3 1" group="{GRIPPER_GROUP}"'


def build(task: RobotTask) -> mujoco.MjModel:  # pyright: ignore[reportAttributeAccessIssue]
    """The model of a task's scene. Position (qpos) 0 to 3 are the gripper's; the movable object's follow."""
    if isinstance(task, BlockTask):
        bodies, table = _blocks_xml(task.block), task.block.friction
    elif isinstance(task, drawer.DrawerOpening):
        bodies, table = _cabinet_xml("loose", _RED) + _cabinet_xml("fixed", _BLUE), 0.5
    else:
        raise TypeError(f"the other world has blocks and drawers, and no scene for {type(task).__name__}")
    pad = f"""
      <body name="pad" pos="0 0 -1">
        <geom name="pad" type="box" size="{window.PAD_SIDE / 2} {window.PAD_SIDE / 2} 0.0002" {_SEEN}
              rgba="0.9 0.8 0.2 1"/>
      </body>"""
    xml = f"""
    <mujoco>
      <compiler angle="radian" autolimits="true"/>
      <option timestep="{TIME_STEP}" solver="CG" iterations="100" cone="elliptic" integrator="implicitfast"/>
      <visual>
        <global offwidth="{COLUMNS}" offheight="{ROWS}"/><quality offsamples="0" shadowsize="0"/>
        <map znear="0.05" zfar="4"/>
      </visual>
      <statistic extent="1" center="0.5 0 0"/>
      <worldbody>
        <light pos="0.5 0 1.5" castshadow="false"/>
        <geom name="table" type="plane" size="2 2 0.1" friction="{table} 0.005 0.0001" {_STATIC}
              rgba="0.8 0.8 0.8 1"/>
        {pad}{_gripper_xml(task.opening)}{bodies}{_cameras_xml()}
      </worldbody>
      <actuator>{scene.drives_xml(_DOWN)}</actuator>
    </mujoco>"""
    return mujoco.MjModel.from_xml_string(xml)  # pyright: ignore[reportAttributeAccessIssue]


def _gripper_xml(opening: window.Opening) -> str:
    radius, tip = window.FINGER_RADIUS, window.FINGER_RADIUS - window.FINGER_BELOW
    fingers = "".join(
        f'<geom name="finger{index}" type="capsule" size="{radius}" friction="{scene.FINGER_FRICTION} 0.005 0.0001" '
        f'fromto="{x} 0 {tip} {x} 0 {tip + FINGER_LENGTH}" {_FINGER} {_GREY}/>'
        for index, x in enumerate((-opening.finger, opening.finger)))
    palm = tip + FINGER_LENGTH + 0.02
    return f"""
      <body name="gripper" gravcomp="1">{scene.joints_xml(_DOWN)}{fingers}
        <geom name="palm" type="box" size="0.07 0.03 0.02" pos="0 0 {palm}" {_SEEN} {_GREY}/>
        <geom name="wrist" type="cylinder" size="0.035" fromto="0 0 {palm} 0 0 {palm + 0.3}" {_SEEN} {_GREY}/>
      </body>"""


def _blocks_xml(block: Block) -> str:
    """The greater friction of two surfaces counts: the block's own is next to none, so that of what it meets does."""
    half, middle = block.side / 2, block.height / 2
    box = f'type="box" size="{half} {half} {middle}" pos="0 0 {middle}" friction="0.001 0.0001 0.0001"'
    return f"""
      <body name="loose"><freejoint/><geom name="loose" {box} mass="{block.mass}" {_LOOSE} {_RED}/></body>
      <body name="fixed"><geom name="fixed" {box} {_STATIC} {_BLUE}/></body>"""


def _cabinet_xml(name: str, colour: str) -> str:
    """A cabinet, a drawer in it that slides when it is the `loose` one, and its handle."""
    depth, width, height = drawer.CABINET
    joint = ("" if name == "fixed" else
             f'<joint name="drawer" type="slide" axis="-1 0 0" range="0 {drawer.MAX_TRAVEL}" frictionloss="1" '
             'damping="2"/>')
    half, wall, top, floor = drawer.TRAY / 2, drawer.TRAY_WALL / 2, drawer.TRAY_TOP / 2, drawer.TRAY_FLOOR / 2
    boxes = [(0.0, 0.0, half, half, floor)]
    boxes += [(sign * (half - wall), 0.0, wall, half, top) for sign in (-1, 1)]
    boxes += [(0.0, sign * (half - wall), half, wall, top) for sign in (-1, 1)]
    tray = "".join(f'<geom type="box" size="{a} {b} {c}" pos="{x} {y} {c}" mass="0.06" {_DRAWER} {colour}/>'
                   for x, y, a, b, c in boxes)
    front, bar = -depth / 2, -depth / 2 - drawer.BAR_BEFORE_FRONT
    reach, level = drawer.BAR_LENGTH / 2 - drawer.BAR_RADIUS, drawer.BAR_HEIGHT
    bars = [(drawer.BAR_RADIUS, (bar, -reach), (bar, reach))]
    bars += [(drawer.SIDE_RADIUS, (bar, y), (front, y)) for y in (-drawer.SIDE_APART / 2, drawer.SIDE_APART / 2)]
    handle = "".join(f'<geom type="capsule" size="{radius}" fromto="{a[0]} {a[1]} {level} {b[0]} {b[1]} {level}" '
                     f'mass="0.05" {_DRAWER} {colour}/>' for radius, a, b in bars)
    return f"""
      <body name="{name}">
        <geom name="{name}" type="box" size="{depth / 2} {width / 2} {height / 2}" pos="0 0 {height / 2}"
              {_DRAWER} {colour}/>
        <body name="{name}_drawer">{joint}{tray}{handle}</body>
      </body>"""


def _cameras_xml() -> str:
    lines = []
    for name, eye in EYES.items():
        axes = look_at(np.array(eye), np.array([*scene.CENTRE, 0.0]))[:3, :2] * [1, -1]  # MuJoCo's y points up
        lines.append(f'<camera name="{name}" fovy="{FOV}" pos="{_numbers(eye)}" xyaxes="{_numbers(axes.T.ravel())}"/>')
    return "".join(lines)


def _numbers(values) -> str:
    return " ".join(f"{value:.9g}" for value in values)

"""Drawer-Opening (paper Section 5.0.2 and Appendix B.4): open the drawer that is not locked."""

import jax
import jax.numpy as jnp

from envs_mjx.base import Variable
from envs_mjx.robot import depth, scene, window
from envs_mjx.robot.plan import Plan, Stroke
from envs_mjx.robot.task import RobotState, RobotTask, first_valid, turn_common

CABINET = (0.1065, 0.114, 0.054)  # depth, width, height
TRAY, TRAY_WALL, TRAY_TOP, TRAY_FLOOR = 0.105, 0.003, 0.0495, 0.0075
BAR_LENGTH, BAR_RADIUS, BAR_BEFORE_FRONT, BAR_HEIGHT = 0.10, 0.0075, 0.05, 0.0267
SIDE_RADIUS, SIDE_APART = 0.005, 0.07
HOOK_INSIDE_BAR = 0.03
"""From the bar's axis to where the gripper hooks it, towards the front."""
_FRONT = CABINET[0] / 2
_OPEN = 0.05
MAX_TRAVEL = 0.10
"""How far a drawer can be open."""
_PULL = 0.2
_HANDLE_FRICTION = 0.8
_NEAR, _FAR, _SIDEWAYS, _BETWEEN = 0.15, 0.20, 0.1, 0.12
_CANDIDATES = 12
"""A candidate is valid with probability 0.87 (measured): all of 12 fail once in 4e10 resets."""


class DrawerOpening(RobotTask):
    """Two cabinets side by side, each with a drawer and a handle; solved when the loose one is open by more than 5 cm.

    With rot ~ U(0, 2 pi), m0 = (cos rot, sin rot) and m1 = (-sin rot, cos rot): the first stands at the middle of the
    workspace + m0 U(0.15, 0.20) + m1 U(-0.1, 0.1), the second 0.12 m further along m1. Drawers open along -m0. Drawn
    again when a handle cannot be reached from within the workspace. Object 0 is the first.

    Position (qpos) 4 is the loose drawer's travel; positions of objects are those of their handles' hooks.
    """

    name = "drawer_opening"
    opening, has_pad = window.TASKS[name]
    # Of an expert of either handle, agents learnt to come down between the two: one of them pressed on something in 42
    # of 256 episodes, in all of them 27 to 60 mm beside a handle, towards the other one (results/robots).
    plan = Plan(hover=0.11, work=0.01, patience=3, retreat=(0.0, 0.0, 1.0, 0.0), nearer_first=True)
    expert_noise = 0.3
    variables = (*RobotTask.variables, Variable("rot cos", hidden=False), Variable("rot sin", hidden=False))
    placed = ("loose", "fixed")

    def xml(self, visual: bool = False) -> str:
        """Gripper and both cabinets; what only is seen: the open tray in place of the solid one that fingers meet."""
        bodies, pairs = "", []
        for name in self.placed:
            joint = (f'<joint type="slide" axis="-1 0 0" range="0 {MAX_TRAVEL}" frictionloss="1" damping="2"/>'
                     if name == "loose" else "")
            bodies += f"""
              <body name="{name}">
                <geom name="{name}_cabinet" type="box" size="{_FRONT} {CABINET[1] / 2} {CABINET[2] / 2}"
                      pos="0 0 {CABINET[2] / 2}"/>
                <body name="{name}_drawer">{joint}{_drawer_xml(name, visual)}</body>
              </body>"""
            for i in (0, 1):
                pairs.append(scene.pair_xml(f"finger{i}", f"{name}_bar", _HANDLE_FRICTION))
                pairs += [scene.pair_xml(f"finger{i}", f"{name}_side{side}", None) for side in (0, 1)]
                pairs += [scene.pair_xml(f"tip{i}", f"{name}_{box}", None) for box in ("cabinet", "tray")]
        return scene.scene_xml(scene.gripper_xml(self.opening.finger, capsules=True), bodies, pairs)

    def draw(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The first valid one of 12 candidates; there is no goal."""
        draws = jax.random.uniform(key, (3, _CANDIDATES), jnp.float32)
        rot = draws[0] * (2 * jnp.pi)
        away, sideways = _NEAR + (_FAR - _NEAR) * draws[1], _SIDEWAYS * (2 * draws[2] - 1)
        m0, m1 = jnp.stack([jnp.cos(rot), jnp.sin(rot)], axis=1), jnp.stack([-jnp.sin(rot), jnp.cos(rot)], axis=1)
        first = m0 * away[:, None] + m1 * sideways[:, None]
        places = jnp.stack([first, first + _BETWEEN * m1], axis=1)
        hooks = places - (_FRONT + BAR_BEFORE_FRONT - HOOK_INSIDE_BAR) * m0[:, None]
        half = (scene.WORKSPACE_HIGH - scene.WORKSPACE_LOW)[:2] / 2
        valid = (jnp.abs(hooks) <= half[None, None, :]).all(axis=(1, 2))
        places += scene.CENTRE[None, None, :]
        poses = jnp.concatenate([places, jnp.broadcast_to(rot[:, None, None], (_CANDIDATES, 2, 1))], axis=2)
        return first_valid(poses, valid), jnp.zeros((2,), jnp.float32)

    def joints(self, pose: jax.Array) -> jax.Array:
        """(1,) closed."""
        return jnp.zeros_like(pose[:1])

    def placed_poses(self, env_state: RobotState) -> jax.Array:
        """(2, 3) of the loose and the fixed cabinet."""
        return jnp.stack([env_state.poses[env_state.movable], env_state.poses[1 - env_state.movable]])

    def object_poses(self, env_state: RobotState) -> jax.Array:
        """(2, 3): where the handles are hooked, and the cabinets' yaw."""
        travel = jnp.zeros((2,), jnp.float32).at[env_state.movable].set(env_state.qpos[4])
        before = _FRONT + BAR_BEFORE_FRONT - HOOK_INSIDE_BAR + travel
        yaw = env_state.poses[:, 2]
        direction = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=1)
        return jnp.concatenate([env_state.poses[:, :2] - before[:, None] * direction, yaw[:, None]], axis=1)

    def ground_truth(self, env_state: RobotState) -> jax.Array:
        """(9,) float32: as of every task, and cosine and sine of the way from the handles to the cabinets."""
        rot = env_state.poses[0, 2]
        return jnp.concatenate([super().ground_truth(env_state), jnp.stack([jnp.cos(rot), jnp.sin(rot)])])

    def solved(self, env_state: RobotState) -> jax.Array:
        """() bool: whether the loose drawer is open."""
        return env_state.qpos[4] > _OPEN

    def stroke(self, own: jax.Array, other: jax.Array, goal: jax.Array) -> Stroke:
        """From the handle away from the cabinet."""
        del other, goal
        forth = -jnp.stack([jnp.cos(own[2]), jnp.sin(own[2])])
        return Stroke(own[:2], own[:2] + _PULL * forth, forth)

    def turn(self, env_state: RobotState, angle: jax.Array) -> RobotState:
        """Turned by `angle` (): the drawer's travel turns with its cabinet."""
        return turn_common(env_state, angle)

    def heights(self, env_state: RobotState) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Heights of the loose drawer with its cabinet, of the locked ones, and of the table, each (84, 84)."""
        zero = jnp.zeros((), jnp.float32)
        loose, fixed = (
            _height(*depth.local_frame(env_state.qpos[:2], pose), travel)
            for pose, travel in zip(self.placed_poses(env_state), (env_state.qpos[4], zero), strict=True))
        return loose, fixed, jnp.zeros_like(loose)


def _drawer_xml(name: str, visual: bool) -> str:
    bar_x, bar = -_FRONT - BAR_BEFORE_FRONT, BAR_LENGTH / 2 - BAR_RADIUS
    geoms = [f'<geom name="{name}_bar" type="capsule" size="{BAR_RADIUS}" mass="0.05" '
             f'fromto="{bar_x} {-bar} {BAR_HEIGHT} {bar_x} {bar} {BAR_HEIGHT}"/>']
    for side in (0, 1):
        y = (side - 0.5) * SIDE_APART
        geoms.append(f'<geom name="{name}_side{side}" type="capsule" size="{SIDE_RADIUS}" mass="0.05" '
                     f'fromto="{bar_x} {y} {BAR_HEIGHT} {-_FRONT} {y} {BAR_HEIGHT}"/>')
    half, wall = TRAY / 2, TRAY_WALL / 2
    geoms.append(f'<geom name="{name}_tray" type="box" size="{half} {half} {TRAY_TOP / 2}" '
                 f'pos="0 0 {TRAY_TOP / 2}" mass="0.3" group="3"/>')
    if visual:
        sizes = [(0.0, 0.0, half, half, TRAY_FLOOR)]
        sizes += [(sign * (half - wall), 0.0, wall, half, TRAY_TOP) for sign in (-1, 1)]
        sizes += [(0.0, sign * (half - wall), half, wall, TRAY_TOP) for sign in (-1, 1)]
        geoms += [f'<geom type="box" size="{a} {b} {top / 2}" pos="{x} {y} {top / 2}" mass="0"/>'
                  for x, y, a, b, top in sizes]
    return "".join(geoms)


def _height(u: jax.Array, v: jax.Array, travel: jax.Array) -> jax.Array:
    """(84, 84) height of a cabinet at the origin of (u, v) whose drawer is open by `travel` ()."""
    out = u + travel
    bar = depth.capsule(v, out + (_FRONT + BAR_BEFORE_FRONT), BAR_LENGTH / 2 - BAR_RADIUS, BAR_RADIUS, BAR_HEIGHT)
    parts = [
        depth.box(u, v, CABINET[0] / 2, CABINET[1] / 2, CABINET[2]),
        depth.tray(out, v, TRAY / 2, TRAY_WALL, TRAY_TOP, TRAY_FLOOR),
        bar,
        # Both side bars at once: they mirror each other in the drawer's middle.
        depth.capsule(out + (_FRONT + BAR_BEFORE_FRONT / 2), jnp.abs(v) - SIDE_APART / 2, BAR_BEFORE_FRONT / 2,
                      SIDE_RADIUS, BAR_HEIGHT),
    ]
    height = parts[0]
    for part in parts[1:]:
        height = jnp.maximum(height, part)
    return height

"""Two square blocks on the table, one loose and one fixed: what Block-Pulling and Block-Pushing share."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.base import Variable
from envs_mjx.robot import depth, scene
from envs_mjx.robot.rotation import mirror_poses, turn_poses, turn_vectors
from envs_mjx.robot.task import RobotState, RobotTask, moments_in_view, turn_common

_BEHIND = 0.08


@dataclasses.dataclass(frozen=True)
class Block:
    """A square block. Lengths in metres, mass in kilograms."""

    side: float
    height: float
    mass: float
    friction: float
    """With the table."""


class BlockTask(RobotTask):
    """Positions (qpos) 4 to 6 are the loose block's x, y and yaw."""

    block: Block
    reach: float
    """How far the loose block's middle may leave the workspace, metres."""
    blocks_collide: bool
    variables = (*RobotTask.variables,
                 *(Variable(name, hidden=False) for name in ("objects seen", "turn cos", "turn sin")))
    placed = ("fixed",)

    def xml(self, visual: bool = False) -> str:
        """Gripper, a loose and a fixed block; `visual` adds the fingers above their tips."""
        block, half = self.block, self.block.side / 2
        middle, size = f'pos="0 0 {block.height / 2}"', f'size="{half} {half} {block.height / 2}"'
        pairs = [scene.pair_xml(f"tip{tip}", name, scene.FINGER_FRICTION) for tip in (0, 1)
                 for name in ("loose", "fixed")]
        cores = {"loose": "", "fixed": ""}
        if self.blocks_collide:
            # Two boxes in the plane: each one's inscribed circle against the other's box leaves room for no overlap
            # but that of two corners, at a fraction of the cost of MJX's box against box.
            cores = {name: f'<geom name="{name}_core" type="sphere" size="{half}" mass="0" {middle} group="3"/>'
                     for name in cores}
            pairs += [scene.pair_xml("loose_core", "fixed", None), scene.pair_xml("fixed_core", "loose", None)]
        loose = scene.loose_joints_xml(block.mass, block.side, block.friction)
        bodies = f"""
          <body name="loose">{loose}
            <geom name="loose" type="box" {size} {middle} mass="{block.mass}"/>{cores["loose"]}
          </body>
          <body name="fixed"><geom name="fixed" type="box" {size} {middle}/>{cores["fixed"]}</body>"""
        return scene.scene_xml(scene.gripper_xml(self.opening.finger, capsules=visual), bodies, pairs)

    def joints(self, pose: jax.Array) -> jax.Array:
        """(3,) x, y, yaw."""
        return pose

    def placed_poses(self, env_state: RobotState) -> jax.Array:
        """(1, 3) of the fixed block."""
        return env_state.poses[1 - env_state.movable][None]

    def object_poses(self, env_state: RobotState) -> jax.Array:
        """(2, 3) x, y, yaw of both blocks."""
        return env_state.poses.at[env_state.movable].set(env_state.qpos[4:])

    def left_workspace(self, env_state: RobotState) -> jax.Array:
        """() bool: whether the loose block's middle is out of the workspace by more than `reach`."""
        middle = env_state.qpos[4:6]
        low, high = scene.WORKSPACE_LOW[:2] - self.reach, scene.WORKSPACE_HIGH[:2] + self.reach
        return ((middle < low) | (middle > high)).any()

    def turn(self, env_state: RobotState, angle: jax.Array) -> RobotState:
        """Turned by `angle` (); object 0 is the one that began at smaller y, as `draw` has it."""
        turned = turn_common(env_state, angle)
        order = jnp.argsort(turned.poses[:, 1])
        joints, speeds = turn_poses(env_state.qpos[4:], angle), turn_vectors(env_state.qvel[4:6], angle)
        return dataclasses.replace(
            turned, qpos=turned.qpos.at[4:].set(joints), qvel=turned.qvel.at[4:6].set(speeds),
            poses=turned.poses[order], movable=jnp.where(order[0] == 0, env_state.movable, 1 - env_state.movable))

    def mirror(self, env_state: RobotState) -> RobotState:
        """Mirrored in the plane of the workspace's middle y."""
        mirrored = super().mirror(env_state)
        return dataclasses.replace(
            mirrored, qpos=mirrored.qpos.at[4:].set(mirror_poses(env_state.qpos[4:])),
            qvel=mirrored.qvel.at[jnp.array([5, 6])].multiply(-1))

    def ground_truth(self, env_state: RobotState) -> jax.Array:
        """(10,) float32: as of every task, how many blocks are in view, and cosine and sine of twice the gripper's yaw,
        as it looks the same after half a turn. (Drawers are always in view, and the closed gripper shows no yaw.)
        """
        seen = moments_in_view(self.object_offsets(env_state))[:1]
        turn = 2 * env_state.qpos[3]
        return jnp.concatenate([
            super().ground_truth(env_state), seen, jnp.stack([jnp.cos(turn), jnp.sin(turn)])])

    def heights(self, env_state: RobotState) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Heights of the loose block, the fixed block, and the ground, each (84, 84)."""
        xy, half = env_state.qpos[:2], self.block.side / 2
        poses = env_state.qpos[4:], env_state.poses[1 - env_state.movable]
        loose, fixed = (depth.box(*depth.local_frame(xy, pose), half, half, self.block.height) for pose in poses)
        return loose, fixed, self.ground(env_state)

    def ground(self, env_state: RobotState) -> jax.Array:
        """(84, 84) height of the ground. Default: the table, at 0."""
        del env_state
        return jnp.zeros((depth.SIZE, depth.SIZE), jnp.float32)


def behind(block: jax.Array, towards: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(2,) 8 cm from the middle of a block at pose (3,), on its far side from `towards` (2,); (2,) the direction there.

    That is where the gripper goes down to bring the block there.
    """
    way = towards - block[:2]
    forth = way / jnp.maximum(jnp.linalg.norm(way), 1e-6)
    return block[:2] - _BEHIND * forth, forth


def square_gap(first: jax.Array, second: jax.Array, half: float) -> jax.Array:
    """() metres between two squares of side 2 `half` at poses (3,), as long as they do not overlap; then it is <= 0.

    The shortest way between two disjoint squares starts at a corner of one of them.
    """
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]], np.float32) * np.float32(half)

    def to_corners(square: jax.Array, other: jax.Array) -> jax.Array:
        cos, sin = jnp.cos(other[2]), jnp.sin(other[2])
        x = other[0] + signs[:, 0] * cos - signs[:, 1] * sin - square[0]
        y = other[1] + signs[:, 0] * sin + signs[:, 1] * cos - square[1]
        cos, sin = jnp.cos(square[2]), jnp.sin(square[2])
        beyond = jnp.stack([jnp.abs(cos * x + sin * y), jnp.abs(cos * y - sin * x)]) - half
        outside = jnp.maximum(beyond, 0.0)
        distance = jnp.sqrt(jnp.sum(outside * outside, axis=0))
        return jnp.min(jnp.where((beyond <= 0).all(axis=0), beyond.max(axis=0), distance))

    return jnp.minimum(to_corners(first, second), to_corners(second, first))

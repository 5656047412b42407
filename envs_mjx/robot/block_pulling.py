"""Block-Pulling (paper Section 5.0.2 and Appendix B.4): bring the loose block to the one that is fixed."""

import jax
import jax.numpy as jnp

from envs_mjx.robot import scene, window
from envs_mjx.robot.blocks import Block, BlockTask, behind, square_gap
from envs_mjx.robot.plan import Plan, Stroke
from envs_mjx.robot.task import RobotState

_TOUCHING = 0.001
_X, _Y = 0.115, 0.115  # half-widths of the area of the blocks' middles
_APART = 0.17


class BlockPulling(BlockTask):
    """Two flat blocks of 0.10 x 0.10 x 0.05 m; solved when they touch (gap <= 1 mm).

    Both at the same x ~ U(0.385, 0.615), their y ~ U(-0.115, 0.115) at least 0.17 m apart, yaws U(-pi/2, pi/2).
    Object 0 is the one at smaller y.
    """

    name = "block_pulling"
    opening, has_pad = window.TASKS[name]
    plan = Plan(hover=0.1, work=0.03, patience=3, retreat=(0.0, 0.0, 1.0, 0.0))
    expert_noise = 0.35
    block = Block(side=0.10, height=0.05, mass=0.5, friction=0.5)
    reach = 0.0
    blocks_collide = False  # the episode ends when they touch

    def draw(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Both y at once, without rejection: two sorted uniform numbers fill the triangle of allowed pairs evenly."""
        draws = jax.random.uniform(key, (5,), jnp.float32)
        y = jnp.sort(draws[:2]) * (2 * _Y - _APART) + jnp.array([-_Y, _APART - _Y], jnp.float32)
        x = jnp.broadcast_to(scene.CENTRE[0] + (2 * draws[2] - 1) * _X, (2,))
        yaw = (draws[3:] - 0.5) * jnp.pi
        return jnp.stack([x, y, yaw], axis=1), jnp.zeros((2,), jnp.float32)

    def solved(self, env_state: RobotState) -> jax.Array:
        """() bool: whether the blocks touch."""
        fixed = env_state.poses[1 - env_state.movable]
        return square_gap(env_state.qpos[4:], fixed, self.block.side / 2) <= _TOUCHING

    def stroke(self, own: jax.Array, other: jax.Array, goal: jax.Array) -> Stroke:
        """From behind the block to the other one."""
        del goal
        begin, forth = behind(own, other[:2])
        return Stroke(begin, other[:2], forth)

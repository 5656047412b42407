"""`python -m launch.fusion`: how far depth fused from three cameras is from the analytic depth of training."""

import contextlib
import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import configs
from envs_mjx import registry
from envs_mjx.robot import headless, scene
from envs_mjx.robot.drawer_opening import MAX_TRAVEL, DrawerOpening
from envs_mjx.robot.gap import GAPS
from envs_mjx.robot.realworld import NoOpenGL, RealWorld
from envs_mjx.robot.task import RobotState, RobotTask
from mijax import runtime
from mijax.config import require


@dataclasses.dataclass(frozen=True)
class FusionOptions:
    """Random scenes of the robot tasks: fused depth against training's, with the gripper out of sight and in it."""

    scenes: int = 200
    """Per task."""
    gap: str = "none"
    """What the cameras are like: none (exact), mild or hard (envs_mjx/robot/gap.py)."""


def moments(training: RobotTask, key: jax.Array, number: int) -> list[RobotState]:
    """Scenes as after a reset, the gripper anywhere in its workspace at any yaw, drawers open by up to 10 cm."""
    def draw(key: jax.Array) -> RobotState:
        key_reset, key_place = jax.random.split(key)
        env_state = training.reset(key_reset)[0]
        place = jax.random.uniform(key_place, (5,), jnp.float32)
        low, high = jnp.asarray(scene.WORKSPACE_LOW), jnp.asarray(scene.WORKSPACE_HIGH)
        qpos = env_state.qpos.at[:3].set(low + place[:3] * (high - low)).at[3].set((2 * place[3] - 1) * jnp.pi)
        if isinstance(training, DrawerOpening):
            qpos = qpos.at[4].set(place[4] * MAX_TRAVEL)
        return dataclasses.replace(env_state, qpos=qpos)

    drawn = jax.device_get(jax.jit(jax.vmap(draw))(jax.random.split(key, number)))
    return [jax.tree.map(lambda x, i=index: x[i], drawn) for index in range(number)]


def errors(world: RealWorld, robots: list[RobotState], gripper: bool) -> np.ndarray:
    """(len(robots), 84, 84) metres between fused and analytic depth; `gripper`: whether cameras see it."""
    render = jax.jit(lambda moment: world.training.render(moment)[0][..., 0])
    found = []
    for number, robot in enumerate(robots):
        state = world.set_up(robot, jax.random.key(number))
        found.append(np.abs(world.observe(state, gripper)[..., 0] - np.asarray(render(robot))))
    return np.stack(found)


def compare(options: FusionOptions) -> None:
    """Print the table."""
    require(options.gap in GAPS, "gap", options.gap, ", ".join(GAPS))
    require(options.scenes >= 1, "scenes", options.scenes, "a number >= 1")
    if headless.bind() is None:
        raise NoOpenGL("no OpenGL without a display: the cameras need EGL or OSMesa")
    print(f"{options.scenes} scenes of each task, gap {options.gap}")
    print(f"{'task':<16}{'gripper':<14}{'median mm':>10}{'<= 5 mm':>9}{'worst scene':>12}")
    for domain in configs.ROBOTS:
        training = registry.make(domain)
        assert isinstance(training, RobotTask)
        robots = moments(training, jax.random.key(0), options.scenes)
        with contextlib.closing(RealWorld(training, GAPS[options.gap])) as world:
            for gripper in (False, True):
                error = errors(world, robots, gripper)
                near = (error <= 0.005).mean(axis=(1, 2))
                print(f"{domain:<16}{'in sight' if gripper else 'out of sight':<14}{np.median(error) * 1e3:>10.4f}"
                      f"{near.mean():>9.4f}{near.min():>12.4f}", flush=True)


def main() -> int:
    """The command; returns its exit code."""
    options = tyro.cli(FusionOptions, prog="python -m launch.fusion")

    def work() -> None:
        runtime.prepare()
        compare(options)

    return runtime.exit_code(work)


if __name__ == "__main__":
    sys.exit(main())

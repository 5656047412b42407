"""The robot tasks' part of the bench: measures one task in a process of its own, which `launch.bench` starts.

It does so twice over an empty compilation cache: what the second process compiles comes from the disk. A
process of its own can also have one host device per core, over which the environments are spread.
"""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.sharding import AxisType, PartitionSpec

from envs_mjx import registry
from envs_mjx.base import TimeStep
from envs_mjx.robot import scene
from envs_mjx.robot.task import RobotState, RobotTask
from mijax import runtime
from mijax.rollout import select

BATCH = 16
"""Environments per device: the fastest of 1 to 64 on a CPU (measured on one core)."""
TRANSITIONS = 100_000
"""Of the replay whose memory is reported."""


@dataclasses.dataclass(frozen=True)
class Measurement:
    """Of one task."""

    steps_per_second: float
    """Whole environment, observation and state drawn, all devices."""
    devices: int
    compile_seconds: float
    c_steps_per_second: float
    """MuJoCo C, the same model and number of substeps, physics alone, one core."""
    frames_per_second: float
    """Stored moments shown again: an observation and a state each, one device."""
    image_mib: float
    """Of `TRANSITIONS` transitions as uint8 images: depth and the state's own channel, each frame once."""
    moment_mib: float
    """Of the same as moments."""


def measure(env: RobotTask, steps: int, repetitions: int) -> Measurement:
    """Measure in this process; `steps` steps of every environment at a time."""
    devices = len(jax.local_devices())
    mesh = jax.make_mesh((devices,), ("environments",), axis_types=(AxisType.Auto,))

    def run(keys: jax.Array) -> jax.Array:
        """Random actions; sums of all that a step shows are consumed."""
        start = jax.vmap(env.reset)(jax.random.split(keys[0], BATCH))

        def step(carry: tuple[RobotState, TimeStep], key: jax.Array) -> tuple[tuple, jax.Array]:
            key_action, key_step, key_reset = jax.random.split(key, 3)
            action = jax.vmap(env.action_spec.sample)(jax.random.split(key_action, BATCH))
            following = jax.vmap(env.step)(jax.random.split(key_step, BATCH), carry[0], action)
            fresh = jax.vmap(env.reset)(jax.random.split(key_reset, BATCH))
            shown = jnp.stack([jnp.sum(x.astype(jnp.float32)) for x in jax.tree.leaves(following[1])])
            return select(following[1].done, fresh, following), shown

        return jnp.sum(jax.lax.scan(step, start, jax.random.split(keys[0], steps))[1])[None]

    spread = jax.shard_map(run, mesh=mesh, in_specs=PartitionSpec("environments"),
                           out_specs=PartitionSpec("environments"), check_vma=False)
    keys = jax.random.split(jax.random.key(0), devices)
    started = time.perf_counter()
    program = jax.jit(spread).lower(keys).compile()
    compile_seconds = time.perf_counter() - started
    seconds = _fastest(lambda: jax.block_until_ready(program(keys)), repetitions)
    moments = jax.jit(jax.vmap(lambda key: env.reset(key)[0]))(jax.random.split(keys[0], 1024))
    show = jax.jit(lambda moments: jax.lax.map(
        lambda moment: sum(jnp.sum(x) for x in env.render(moment)), moments, batch_size=BATCH))
    showing = _fastest(lambda: jax.block_until_ready(show(moments)), repetitions)
    moment_bytes = sum(leaf.nbytes for leaf in jax.tree.leaves(moments)) / 1024
    image_bytes = 2 * env.observation_spec.shape[0] * env.observation_spec.shape[1]
    return Measurement(
        steps_per_second=steps * BATCH * devices / seconds, devices=devices, compile_seconds=compile_seconds,
        c_steps_per_second=_c_steps_per_second(env, repetitions), frames_per_second=1024 / showing,
        image_mib=TRANSITIONS * image_bytes / 2**20, moment_mib=TRANSITIONS * moment_bytes / 2**20)


def _fastest(function: Any, repetitions: int) -> float:
    """Seconds of the fastest of a few calls, after one that does not count."""
    function()
    found = []
    for _ in range(repetitions):
        started = time.perf_counter()
        function()
        found.append(time.perf_counter() - started)
    return min(found)


def _c_steps_per_second(env: RobotTask, repetitions: int, steps: int = 2000) -> float:
    """Random set-points around the middle of the workspace; the objects stand where the model has them."""
    model = env.physics.model
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    targets = scene.START + np.random.default_rng(0).uniform(-1, 1, (steps, 4)) * scene.ACTION_SCALE

    def run() -> None:
        mujoco.mj_resetData(model, data)  # pyright: ignore[reportAttributeAccessIssue]
        data.qpos[:4] = scene.START
        for target in targets:
            data.ctrl[:] = target
            mujoco.mj_step(model, data, scene.SUBSTEPS)  # pyright: ignore[reportAttributeAccessIssue]

    return steps / _fastest(run, repetitions)


def measure_apart(domain: str, steps: int, repetitions: int) -> tuple[Measurement, Measurement]:
    """What a first and a second process measure, the first one over an empty compilation cache."""
    with tempfile.TemporaryDirectory() as cache:
        variables = {**os.environ, runtime.CACHE_VARIABLE: cache}
        command = [sys.executable, "-m", "launch.robots", domain, str(steps), str(repetitions)]
        first, second = (
            json.loads(subprocess.run(command, env=variables, check=True, capture_output=True, text=True).stdout)
            for _ in range(2))
    return Measurement(**first), Measurement(**second)


def main() -> None:
    """Print a `Measurement` as JSON, for `measure_apart`: DOMAIN STEPS REPETITIONS."""
    if len(sys.argv) != 4:
        sys.exit("started by: python -m launch.bench --only environments --domains block_pulling")
    domain, steps, repetitions = sys.argv[1:]
    runtime.prepare(host_devices=runtime.cores())
    env = registry.make(domain)
    assert isinstance(env, RobotTask)
    print(json.dumps(dataclasses.asdict(measure(env, int(steps), int(repetitions)))))


if __name__ == "__main__":
    main()

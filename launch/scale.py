"""`python -m launch.scale [--devices 8] [--domain D] [--strategy shard]`: what each of several devices has to do.

On simulated devices of the CPU, one seed for each of 1, 2, 4, ... of them: what an iteration of learning costs each
device as the compiler counts it, and the operations that pass anything between devices. The programs are not run, so
that this tells nothing of time.
"""

import argparse
import os
import re
import sys
from collections.abc import Sequence

import jax

import configs
from envs_mjx import registry
from launch.bench import Sizes, fresh_learner
from mijax import runtime, tables
from mijax.config import SeedStrategy, require
from mijax.learner import make_learner
from mijax.seeds import SeedRunner, training_key

_TRAFFIC = re.compile(r"= .* (all-reduce|all-gather|all-to-all|reduce-scatter|collective-[a-z]+|send|recv)(-start)?\(")


def gflop(program: jax.stages.Compiled) -> float:
    """Arithmetic of an iteration of learning, as XLA counts it: the body of a loop once."""
    counted = program.cost_analysis()
    assert counted is not None
    return float(counted["flops"]) / 1e9


def traffic(program: jax.stages.Compiled) -> int:
    """Operations that pass something between devices."""
    return sum(bool(_TRAFFIC.search(line)) for line in (program.as_text() or "").splitlines())


def measure(domain: str, strategy: SeedStrategy, devices: int) -> tables.Table:
    """A line for each number of devices."""
    env, config = registry.make(domain), configs.preset(domain)
    _, _, representation = fresh_learner(env, config, Sizes())
    lines = []
    for number in (2**power for power in range(devices.bit_length())):
        runner = SeedRunner(lambda pack: make_learner(env, config, pack), range(number), strategy)
        template = jax.eval_shape(runner.learner.init, training_key(0), representation)
        programs = runner.compile(template)
        work = [gflop(program) for program in programs]
        lines.append({"devices": len(programs), "seeds": number, "least_gflop": min(work), "most_gflop": max(work),
                      "operations_between_devices": sum(map(traffic, programs))})
    return lines


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Options of the command."""
    parser = argparse.ArgumentParser(
        prog="python -m launch.scale", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--devices", type=int, default=8, help="the most, a power of two (8)")
    parser.add_argument("--domain", default="heaven_hell", help="whose preset (heaven_hell)")
    parser.add_argument("--strategy", default="shard", choices=("shard", "vmap"), help="of the seeds (shard)")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = parse(sys.argv[1:] if arguments is None else arguments)

    def work() -> None:
        devices = options.devices
        require(devices >= 1 and devices & (devices - 1) == 0, "devices", devices, "a power of two")
        # To be counted and not to be run, programs need none of LLVM's optimisations.
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"
        runtime.prepare(host_devices=devices)
        require(devices <= jax.local_device_count(), "devices", devices, f"at most {jax.local_device_count()} here")
        print(tables.plain_markdown(measure(options.domain, options.strategy, devices)))

    return runtime.exit_code(work)


if __name__ == "__main__":
    sys.exit(main())

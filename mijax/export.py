"""`python -m mijax.export RUN --to npz`: the trained policy as a file that runs without the library.

    OUT/policy.json         the contract: every input and output, units, ranges, memory, and where the policy is from
    OUT/policy.npz          or policy.onnx, policy.stablehlo
    OUT/numpy_policy.py     beside a policy.npz: all that runs it, with NumPy alone
    OUT/serve.py            and a server for other programs: see `mijax.serve`
"""

import dataclasses
import hashlib
import json
import pathlib
import shutil
import sys
from collections.abc import Sequence
from typing import Any, Literal

import jax
import tyro
from jax import export as jax_export

from envs_mjx import registry
from mijax import runtime, serve
from mijax.agents.core import Agent
from mijax.agents.variants import memory_of
from mijax.config import require
from mijax.deploy import numpy_policy, runtimes, trace
from mijax.deploy.numpy_policy import CONTRACT_FILE, FILES, Policy, PolicyError
from mijax.deploy.parity import Parity, compare, play
from mijax.deploy.step import PolicyStep, contract, policy_step
from mijax.files import make_folder
from mijax.learner import make_learner
from mijax.run_folder import RunError, RunFolder
from mijax.seeds import evaluation_key
from mijax.trained import load_learner_state, seed_of, training_of
from mijax.types import Params
from mijax.versions import current_versions

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
"""What a StableHLO export runs on."""


@dataclasses.dataclass(frozen=True)
class ExportOptions:
    """Write the greedy policy of a run's newest checkpoint, as evaluation plays it, and check it against the agent."""

    run: tyro.conf.Positional[pathlib.Path]
    """Run folder."""
    to: Literal["npz", "onnx", "stablehlo"]
    """npz: NumPy alone runs it. onnx: ONNX Runtime. stablehlo: JAX without mijax, on any device."""
    seed: int | None = None
    """Which of the run's seeds; default its first."""
    out: pathlib.Path | None = None
    """Folder to write; default RUN/seed_K/policy_FORMAT. An earlier export there is replaced."""
    episodes: int = 5
    """Whole episodes in which the policy has to act as the agent does."""


def save(kind: str, step: PolicyStep, folder: pathlib.Path) -> None:
    """Write the policy of that format into a folder; `RunError` for a network that the format cannot hold."""
    path = folder / FILES[kind]
    if kind == "stablehlo":
        exported = jax_export.export(jax.jit(step.function), platforms=PLATFORMS)(step.inputs)
        path.write_bytes(exported.serialize())
        return
    try:
        program = trace.trace(step.function, step.inputs)
    except trace.NotTraceable as error:
        raise RunError(f"--to {kind}: the network has {error}; --to stablehlo takes any") from None
    if kind == "npz":
        program.save(path)
        for module in (numpy_policy, serve):
            source = pathlib.Path(str(module.__file__))
            shutil.copyfile(source, folder / source.name)
        return
    from mijax.deploy import onnx_graph

    outputs = jax.eval_shape(step.function, step.inputs)
    path.write_bytes(onnx_graph.to_onnx(program, step.inputs, outputs).SerializeToString())


def write(kind: str, agent: Agent, params: Params, out: pathlib.Path, origin: dict[str, Any], key: jax.Array,
          episodes: int) -> tuple[Policy, Parity]:
    """Export a policy and keep it only if it acts as the agent does.

    Args:
        kind: a key of `FILES`.
        agent: on the environment in which it is to be compared.
        params: of its network.
        out: folder; an earlier export in it is replaced once the new one has passed, and other files there stay.
        origin: what the contract says of the run.
        key: draws the episodes.
        episodes: how many.

    Returns:
        The policy as it was read back, and what the comparison found.

    Raises:
        RunError: the folder holds something else, the format cannot hold the network, or actions differ.
        PolicyError: a package is missing.
    """
    out = out.resolve()
    check_free(out)
    make_folder(out.parent)
    step = policy_step(agent, params)
    partial = out.with_name(f"{out.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    try:
        save(kind, step, partial)
        digest = hashlib.sha256((partial / FILES[kind]).read_bytes()).hexdigest()
        described = contract(agent, step) | {"format": kind, "file": FILES[kind], "sha256": digest} | origin
        _write_contract(partial, described)
        policy = Policy.load(partial)
        found = compare(policy, play(agent, params, key, episodes))
        _write_contract(partial, described | {"parity": dataclasses.asdict(found)})
        out.mkdir(exist_ok=True)
        for path in sorted(partial.iterdir(), key=lambda path: path.name == CONTRACT_FILE):  # it makes the rest valid
            path.replace(out / path.name)
        for name in set(FILES.values()) - {FILES[kind]}:
            (out / name).unlink(missing_ok=True)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return policy, found


def _write_contract(folder: pathlib.Path, described: dict[str, Any]) -> None:
    (folder / CONTRACT_FILE).write_text(json.dumps(described, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def check_free(out: pathlib.Path) -> None:
    """Raise `RunError` unless a folder is empty, missing, or an earlier export."""
    if out.exists() and not (out / CONTRACT_FILE).exists() and (not out.is_dir() or any(out.iterdir())):
        raise RunError(f"{out}: holds something else than an exported policy; choose another --out")


def export(options: ExportOptions) -> pathlib.Path:
    """Export as the options say; the folder."""
    require(options.episodes >= 1, "episodes", options.episodes, "a number >= 1")
    runtimes.require(options.to, *runtimes.WRITES[options.to])
    run = RunFolder.open(options.run)
    config, seed = training_of(run).config, seed_of(run, options.seed)
    out = options.out or run.seed_path(seed) / f"policy_{options.to}"
    check_free(out)
    learner = make_learner(registry.make(config.domain), config)
    at_step, state = load_learner_state(run, seed, learner)
    origin = {"run": {"name": run.path.resolve().name, "seed": seed, "step": at_step, "versions": run.versions(),
                      "config": run.config()}, "exported_with": current_versions()}
    policy, found = write(options.to, learner.agent, state.agent.target, out, origin, evaluation_key(seed, at_step),
                          options.episodes)
    taken = numpy_policy.measure(policy, seconds=0.5)
    print(f"{config.domain}, {config.agent}, {memory_of(config)}, seed {seed}, step {at_step:,}: {out}")
    print(f"against the trained agent: {found}")
    print(f"here {1 / taken.mean():,.0f} steps per second")
    return out


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    options = tyro.cli(ExportOptions, args=arguments, prog="python -m mijax.export")

    def work() -> None:
        runtime.prepare()
        export(options)

    return runtime.exit_code(work, PolicyError)


if __name__ == "__main__":
    sys.exit(main())

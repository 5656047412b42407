"""`python -m mijax.represent`: stage 1 alone, for any number of seeds, each probed and kept.

With `--search 16` it chooses the loss weights first: many weightings are trained at once, the best is kept.
"""

import argparse
import dataclasses
import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import tyro

import configs
from envs_mjx import registry
from envs_mjx.contract import check_contract
from envs_mjx.errors import UserError
from mijax import runtime, stage1
from mijax.config import Stage1Config, parse_seeds, require
from mijax.run_folder import RunError, RunFolder


@dataclasses.dataclass(frozen=True)
class RepresentOptions:
    """Learn features of the state and of the observation that do not overlap (stage 1), and test them."""

    stage1: Stage1Config = dataclasses.field(default_factory=Stage1Config)
    domain: str = "heaven_hell"
    """A registered environment, or `package.module:EnvClass`; its arguments may follow: `name,argument=value,...`."""
    seeds: Annotated[str, tyro.conf.arg(name="seeds")] = "1"
    """How many seeds (5: seeds 0 to 4), or which ones (3,7; a single one with a comma: 3,)."""
    search: int = 0
    """How many loss weightings to try in place of --stage1.lambda-* and --stage1.phi-shrinkage (a DIM weight of 0 stays
    0). 0: none, the weights are taken as they are."""
    out: pathlib.Path | None = None
    """Run folder to make, or one of the same options to add seeds to; default runs/DOMAIN-representation.
    `mijax.train --representation` reads it."""


def parse(arguments: Sequence[str]) -> RepresentOptions:
    """Options in two stages: the domain first, since its preset gives the defaults of all the others."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--domain", default="heaven_hell")
    domain = first.parse_known_args(list(arguments))[0].domain
    default = RepresentOptions(stage1=configs.preset(domain).stage1, domain=domain)
    return tyro.cli(RepresentOptions, default=default, args=list(arguments), prog="python -m mijax.represent")


def open_run(options: RepresentOptions, seeds: Sequence[int]) -> RunFolder:
    """A new run folder, or the one that the same command made before, for the same seeds or for others."""
    path = options.out or pathlib.Path("runs") / f"{registry.file_name(options.domain)}-representation"
    stored = dataclasses.asdict(options) | {"seed_list": list(seeds), "out": None}
    if (path / "config.json").exists():
        run = RunFolder.open(path)
        other = [name for name, value in _flat(stored).items() if _flat(run.config()).get(name, value) != value]
        if not options.search and not other:
            run.add_seeds(seeds)
            return run
        named = f"with another --{other[0].replace('_', '-')}" if other else "by a search"
        raise RunError(f"{path}: was made {named}; choose another --out")
    return RunFolder.create(path, stored)


def _flat(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Options by their names on the command line, with underscores, but for the seeds."""
    stage1 = {f"stage1.{name}": value for name, value in dict(stored.get("stage1") or {}).items()}
    return {name: value for name, value in stored.items() if name not in ("stage1", "seeds", "seed_list")} | stage1


def represent(options: RepresentOptions) -> None:
    """Train, probe and keep the representation of every seed that has none yet; fine if one fails its probe."""
    require(options.search >= 0, "search", options.search, "a number >= 1, or 0 for none")
    seeds, env = parse_seeds(options.seeds), registry.make(options.domain)
    require(not options.search or any(variable.hidden for variable in env.variables), "search", options.search,
            f"0: {env.name} names no hidden variable, by whose decoding candidates are ranked")
    check_contract(env)
    run = open_run(options, seeds)
    with run.held(seeds):
        try:
            if options.search:
                passed = stage1.choose_weights(run, env, options.stage1, seeds, options.search, print).best.passed
            else:
                stage1.representations(run, env, options.stage1, seeds, print)
                passed = sum(stage1.passed(run, seed) for seed in seeds)
        except UserError:
            run.discard(seeds)  # options that nothing can be learnt with are no run to go on with
            raise
    if env.variables:
        print(f"{passed} of {len(seeds)} representations pass P1 and P2")


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    def work() -> None:
        options = parse(sys.argv[1:] if arguments is None else arguments)
        runtime.prepare(host_devices=runtime.cores() if options.search else 1)
        represent(options)

    return runtime.exit_code(work)


if __name__ == "__main__":
    sys.exit(main())

"""`python -m mijax.represent`: stage 1 alone, for any number of seeds, each probed and kept."""

import argparse
import dataclasses
import json
import pathlib
import sys
from collections.abc import Sequence
from typing import Annotated

import jax
import tyro

import configs
from envs_mjx import registry
from envs_mjx.base import Environment
from mijax import runtime, stage1
from mijax.config import ConfigError, Stage1Config, require
from mijax.metrics import ProgressDisplay, RunError, RunFolder
from mijax.representation import DivergenceError, learn_representation
from mijax.representation.probe import ProbeReport, format_report, probe
from mijax.representation.storage import RepresentationError, save_representation, write_atomically

PROBE_FILE = "probe.json"
USER_ERRORS = (ConfigError, RunError, RepresentationError, DivergenceError, registry.UnknownDomain,
               registry.ContractError, OSError)
"""What a user can mend: shown as one line."""


@dataclasses.dataclass(frozen=True)
class RepresentOptions:
    """Learn features of the state and of the observation that do not overlap (stage 1), and test them."""

    stage1: Stage1Config = dataclasses.field(default_factory=Stage1Config)
    domain: str = "heaven_hell"
    """A registered environment, or `package.module:EnvClass`."""
    seeds: Annotated[str, tyro.conf.arg(name="seeds")] = "1"
    """How many seeds (5: seeds 0 to 4), or which ones (3,7; a single one with a comma: 3,)."""
    out: pathlib.Path | None = None
    """Run folder to make; default runs/DOMAIN-representation. `mijax.train --representation` reads it."""


def parse(arguments: Sequence[str]) -> RepresentOptions:
    """Options in two stages: the domain first, since its preset gives the defaults of all the others."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--domain", default="heaven_hell")
    domain = first.parse_known_args(list(arguments))[0].domain
    default = RepresentOptions(stage1=configs.preset(domain).stage1, domain=domain)
    return tyro.cli(RepresentOptions, default=default, args=list(arguments), prog="python -m mijax.represent")


def represent(env: Environment, config: Stage1Config, seed: int, run: RunFolder) -> ProbeReport:
    """Learn, probe and keep one seed's representation."""
    key = stage1.representation_key(seed)
    with ProgressDisplay(f"stage 1, seed {seed}", config.epochs, unit="epochs") as progress:
        representation, history = learn_representation(env, config, key, on_progress=progress.update)
    report = probe(representation, env, config, probe_key(seed), history)
    folder = stage1.folder_of(run, seed)
    save_representation(representation, env, folder)
    timing = {"updates": history.updates, "updates_per_second": history.updates_per_second,
              "compile_seconds": history.compile_seconds, "seconds": history.seconds}
    write_atomically(folder / PROBE_FILE, json.dumps(report.as_dict() | timing, indent=2).encode())
    print(f"seed {seed}: {history.updates} updates in {history.compile_seconds + history.seconds:.0f} s "
          f"({history.updates_per_second:.0f}/s), kept in {folder}\n{format_report(report)}", flush=True)
    return report


def probe_key(seed: int) -> jax.Array:
    """The key of a seed's held-out episodes, which training never sees."""
    return jax.random.fold_in(stage1.representation_key(seed), 1)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 when all went well, also if a representation fails its probe."""
    options = parse(sys.argv[1:] if arguments is None else arguments)
    runtime.prepare()
    try:
        seeds, env = parse_seeds(options.seeds), registry.make(options.domain)
        name = f"{options.domain.replace(':', '.')}-representation"
        stored = dataclasses.asdict(options) | {"seed_list": list(seeds), "out": None}
        run = RunFolder.create(options.out or pathlib.Path("runs") / name, stored)
        passed = [report.p1 and report.p2 for report in (represent(env, options.stage1, s, run) for s in seeds)]
    except USER_ERRORS as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"{sum(passed)} of {len(passed)} representations pass P1 and P2")
    return 0


def parse_seeds(text: str) -> tuple[int, ...]:
    """`5` -> (0, 1, 2, 3, 4); `3,7` -> (3, 7); `3,` -> (3,)."""
    parts = [part.strip() for part in text.split(",") if part.strip()]
    require(bool(parts) and all(part.isdigit() for part in parts), "seeds", text, "a number such as 5, or a list 3,7")
    numbers = tuple(map(int, parts))
    require("," in text or numbers[0] >= 1, "seeds", text, "at least one seed")
    require(len(set(numbers)) == len(numbers), "seeds", text, "different seeds")
    return numbers if "," in text else tuple(range(numbers[0]))


if __name__ == "__main__":
    sys.exit(main())

"""Stage 1 of a run: each seed's representation, learnt and probed, or taken from another run."""

import json
import pathlib
import time
from collections.abc import Callable
from typing import Any

import jax

from envs_mjx.base import Environment
from mijax import figures, runtime
from mijax.config import Stage1Config
from mijax.files import write_atomically
from mijax.progress import ProgressDisplay
from mijax.representation import DivergenceError, learn_representation
from mijax.representation.probe import ProbeReport, format_report, probe
from mijax.representation.search import CONFIRMATIONS, SearchResult, Weights, confirm, draw_candidates, search
from mijax.representation.storage import FACTS_FILE, load_representation, save_representation
from mijax.run_folder import RunError, RunFolder
from mijax.types import Representation

FOLDER = "representation"
PROBE_FILE = "probe.json"
SEARCH_FILE, TRADE_OFF_FILE = "search.json", "trade_off.png"


def representation_key(seed: int) -> jax.Array:
    """The key that a seed's stage 1 follows from."""
    return jax.random.fold_in(jax.random.key(seed), 1)


def folder_of(run: RunFolder, seed: int) -> pathlib.Path:
    """Where a run keeps a seed's representation."""
    return run.seed_path(seed) / FOLDER


def reuse(
    source: RunFolder, env: Environment, features: int, seeds: tuple[int, ...], say: Callable[[str], None]
) -> Callable[[RunFolder], None]:
    """Read representations of another run, the same seed's where it has one, else its first, which is said; the result
    puts them, and what their probes found, into a run.

    Raises:
        RunError: the other run has no representation of so many features.
        RepresentationError: one of them is damaged, or of another domain.
    """
    found = [seed for seed in source.seeds() if (folder_of(source, seed) / FACTS_FILE).exists()]
    if not found:
        raise RunError(f"{source.path}: holds no representation (no seed_K/{FOLDER})")
    origins = {seed: folder_of(source, seed if seed in found else found[0]) for seed in seeds}
    read = {seed: load_representation(origin, env) for seed, origin in origins.items()}
    lacking = ", ".join(str(seed) for seed in seeds if seed not in found)
    if lacking:
        say(f"{source.path}: has no stage 1 of seed {lacking}; that of its seed {found[0]} takes its place")
    widths = {representation.z_s_mean.shape[0] for representation in read.values()} - {features}
    if widths:
        raise RunError(f"{source.path}: holds features {widths.pop()} wide, wanted --stage1.features {features}")

    def put(run: RunFolder) -> None:
        for seed, origin in origins.items():
            folder, probed = folder_of(run, seed), origin / PROBE_FILE
            folder.mkdir(parents=True, exist_ok=True)
            if probed.exists():
                write_atomically(folder / PROBE_FILE, probed.read_bytes())
            save_representation(read[seed], env, folder)

    return put


def representations(
    run: RunFolder, env: Environment, config: Stage1Config, seeds: tuple[int, ...], say: Callable[[str], None]
) -> dict[int, Representation]:
    """Every seed's representation, trained where the run has none yet."""
    result = {}
    for seed in seeds:
        if not (folder_of(run, seed) / FACTS_FILE).exists():
            learn(run, env, config, seed, say)
        result[seed] = load_representation(folder_of(run, seed), env)
    return result


def learn(run: RunFolder, env: Environment, config: Stage1Config, seed: int, say: Callable[[str], None]) -> ProbeReport:
    """Train one seed's representation, keep it, probe it, keep and say what the probe found."""
    key, folder, started = representation_key(seed), folder_of(run, seed), time.perf_counter()
    with ProgressDisplay(f"stage 1, seed {seed}", config.epochs, unit="epochs") as progress:
        representation, history = learn_representation(env, config, key, on_progress=progress.update)
    report = probe(representation, env, config, jax.random.fold_in(key, 3), history)
    timing = {"starts": history.starts, "updates": history.updates, "updates_per_second": history.updates_per_second,
              "compile_seconds": history.compile_seconds, "seconds": history.seconds,
              "wall_seconds": time.perf_counter() - started}
    _keep(folder, env, representation, report, timing)
    jax.clear_caches()  # stage 1's programs are 0.2 GiB on CarFlag-2D
    runtime.release_memory()
    if history.starts > 1:
        say(f"stage 1, seed {seed}: z_s was erased, and stage 1 was begun again from other weights, start "
            f"{history.starts}")
    say(f"stage 1, seed {seed}: {history.updates} updates in {history.compile_seconds + history.seconds:.0f} s "
        f"({history.updates_per_second:.0f}/s), kept in {folder}\n{format_report(report)}")
    return report


def passed(run: RunFolder, seed: int) -> bool:
    """Whether a seed's representation passed P1 and P2 when it was made."""
    report = _probed(run, seed)
    return bool(report.get("p1") and report.get("p2"))


def seconds_of(run: RunFolder, seed: int) -> float:
    """What stage 1 of a seed took, data and probe included, in whatever run it was; 0 where that is not known."""
    return float(_probed(run, seed).get("wall_seconds", 0.0))


def _probed(run: RunFolder, seed: int) -> dict[str, Any]:
    """What probe.json holds; nothing where there is none."""
    path = folder_of(run, seed) / PROBE_FILE
    try:
        report = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    except ValueError:
        raise RunError(f"{path}: damaged, not JSON") from None
    return report if isinstance(report, dict) else {}


def choose_weights(
    run: RunFolder, env: Environment, config: Stage1Config, seeds: tuple[int, ...], count: int,
    say: Callable[[str], None]
) -> SearchResult:
    """Search `count` loss weightings, try the best with further seeds, keep one's representations, the table and the
    figure of all."""
    keys = {seed: representation_key(seed) for seed in seeds}
    further = {seed: representation_key(seed) for seed in range(max(seeds) + 1, max(seeds) + 1 + CONFIRMATIONS)}
    with ProgressDisplay(f"{count} weightings, {len(seeds)} seeds", config.epochs, unit="epochs") as progress:
        result = search(env, config, draw_candidates(config, count), keys, on_progress=progress.update)
    for seed, report in result.best.reports.items():
        if report is None:
            raise DivergenceError(f"stage 1: every weighting that was kept diverged with seed {seed}; try a smaller "
                                  f"--stage1.learning-rate than {config.learning_rate}")
    _keep_search(run, env, config, result)  # the trainings that follow may be stopped
    result = confirm(env, config, result, further, lambda weights, seed, passes: say(
        f"{_flags(weights)}\n{'passes' if passes else 'fails'} with seed {seed}"))
    _keep_search(run, env, config, result)
    for seed, report in result.best.reports.items():
        if report is not None:
            say(f"seed {seed}, kept in {folder_of(run, seed)}\n{format_report(report)}")
    say(f"{count} weightings in {result.seconds:.0f} s; the best: {_flags(result.best.weights)}\n"
        f"{_verdict(result, len(further))}\n"
        f"All of them: {run.path / SEARCH_FILE}, {run.path / TRADE_OFF_FILE}")
    return result


def _keep_search(run: RunFolder, env: Environment, config: Stage1Config, result: SearchResult) -> None:
    """The best candidate's representations, the table and the figure of all."""
    best, count = result.best, len(result.candidates)
    for seed, report in best.reports.items():
        assert report is not None
        _keep(folder_of(run, seed), env, best.representations[seed], report, {"weights": best.weights})
    write_atomically(run.path / SEARCH_FILE, json.dumps(result.as_dict(), indent=2).encode())
    seeds = f"{len(best.reports)} seed{'s' if len(best.reports) > 1 else ''}"
    figures.draw_trade_off(result, run.path / TRADE_OFF_FILE,
                           f"{figures.display_name(env.name)}: {count} weightings, {seeds}, {config.epochs} epochs")


def _verdict(result: SearchResult, further: int) -> str:
    """Of the candidate that is kept, tried with `further` seeds up to the first failure."""
    confirmed = result.best.confirmed
    if not any(candidate.confirmed for candidate in result.candidates):
        return "None passes P1 and P2"
    if all(confirmed) and len(confirmed) == further:
        return f"It passes with all of {further} further seeds"
    return f"It passes with {sum(confirmed)} further seeds and fails with the next, of {further} at most"


def _flags(weights: Weights) -> str:
    return " ".join(f"--stage1.{name.replace('_', '-')} {value:g}" for name, value in weights.items())


def _keep(
    folder: pathlib.Path, env: Environment, representation: Representation, report: ProbeReport, facts: dict[str, Any]
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / PROBE_FILE, json.dumps(report.as_dict() | facts, indent=2).encode())
    save_representation(representation, env, folder)  # last: where it is, the probe's result is

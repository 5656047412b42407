"""The paper's experiments, one command each.

    python -m launch.paper fig3 --domain heaven_hell --seeds 5
    python -m launch.paper all

Every run is kept under OUT/runs and never made twice: a command that was stopped goes on where it was when it is given
again, more seeds are added to those that are there, and experiments share their runs. Each writes its figure and a
table with the probability of improvement over each baseline into OUT, and says on the figure where it used fewer seeds
or steps than the paper.

    OUT/runs/DOMAIN/features-NAME                stage 1, shared by all runs that act on these features
    OUT/runs/DOMAIN/ARM-STEPS/seeds_K..          a run of `mijax.train`
    OUT/FIGURE.png, OUT/FIGURE.md, OUT/FIGURE.csv; OUT/FIGURE_DOMAIN.png ... with --domain
"""

import argparse
import dataclasses
import pathlib
import sys
from collections.abc import Callable, Sequence

import jax
import numpy as np

from configs.paper import STEPS
from envs_mjx import registry
from envs_mjx.base import ContinuousActions
from launch.experiments import DOMAINS, EXPERIMENTS, Arm
from mijax import draw_episode, episode, figures, runtime, stage1, tables, train
from mijax.agents.variants import needs_representation, reads, stage1_of
from mijax.config import Config, ConfigError, options_of, parse_seeds, require
from mijax.learner import make_learner
from mijax.representation.dataset import collect
from mijax.representation.storage import FACTS_FILE
from mijax.results import ReportedRun, summarise
from mijax.run_folder import RunError, RunFolder
from mijax.seeds import evaluation_key
from mijax.trained import load_learner_state, stage1_in, training_of

PAPER_SEEDS = 5
TRACED_EPISODES = 100
"""Episodes of each seed behind the numbers of Fig. 32."""
SET_BY_EXPERIMENT = ("--agent", "--memory", "--resume", "--representation", "--hosts")
SAY: Callable[[str], None] = print


@dataclasses.dataclass(frozen=True)
class Request:
    """What was asked for."""

    out: pathlib.Path
    domain: str | None
    seeds: tuple[int, ...]
    steps: int | None
    extra: tuple[str, ...]
    """Further options of `mijax.train`, for all runs."""
    arms: tuple[str, ...] | None = None
    """Which of an experiment's arms, by name; None: all."""

    def place(self, name: str, ending: str) -> pathlib.Path:
        """Where an experiment's figure or table goes, by what its name ends in."""
        return self.out / (name + ("" if self.domain is None else f"_{registry.file_name(self.domain)}") + ending)

    def wants(self, arm: Arm) -> bool:
        """Whether an arm is to be run and drawn."""
        return self.arms is None or arm.name in self.arms

    def parse(self, domain: str, arm: Arm) -> train.TrainOptions:
        """The options of an arm's training, without its folder and seeds."""
        steps = () if self.steps is None else ("--steps", str(self.steps))
        return train.parse(("--domain", domain, *arm.options, *steps, *self.extra))


class Stopped(KeyboardInterrupt):
    """Ctrl-C: what is there is whole, the same command goes on."""


# ----------------------------------------------------------------------------------------------------------------- runs


def run_arm(request: Request, domain: str, arm: Arm) -> list[RunFolder]:
    """The finished runs that hold an arm's seeds: those that are there, resumed ones, and one of all missing seeds."""
    options = request.parse(domain, arm)
    place = folder_of(request, domain, arm, options)
    runs = [RunFolder.open(path) for path in sorted(place.glob("seeds_*")) if (path / "config.json").exists()]
    runs = [run for run in runs if set(run.config().get("seed_list", ())) & set(request.seeds)]
    for run in runs:
        check_same(run, options)
        if run.summary() is None:
            finish(train.parse(("--resume", str(run.path))))
    missing = [seed for seed in request.seeds if not any(seed in training_of(run).seeds for run in runs)]
    if missing:
        features = features_of(arm, options.config)
        source = None if features is None else shared_features(request, domain, features, options)
        runs.append(finish(dataclasses.replace(
            options, seeds=",".join(map(str, missing)) + ",", representation=source,
            out=place / f"seeds_{'_'.join(map(str, missing))}")))
    return runs


def folder_of(request: Request, domain: str, arm: Arm, options: train.TrainOptions) -> pathlib.Path:
    """Where an arm's runs of this many steps are."""
    return request.out / "runs" / registry.file_name(domain) / f"{arm.name}-{options.config.steps}"


def finish(options: train.TrainOptions) -> RunFolder:
    """Train to the end."""
    run = train.train(options, SAY)
    if run.summary() is None:
        raise Stopped(f"stopped in {run.path}; the same command goes on from there")
    return run


def check_same(run: RunFolder, options: train.TrainOptions) -> None:
    """Raise `RunError` if a run was made with other options than it would be now, as far as its agent reads them."""
    there, wanted = map(options_of, (training_of(run).config, options.config))
    free = ("memory", "seeds.strategy")  # resolved from `auto` when stored; not meant to change what is learnt
    continuous = isinstance(registry.make(options.config.domain).action_spec, ContinuousActions)
    other = [name for name, value in wanted.items()
             if there[name] != value and name not in free and reads(options.config, continuous, name)]
    if other:
        raise RunError(f"{run.path}: was made with --{other[0].replace('_', '-')} {there[other[0]]}, wanted "
                       f"{wanted[other[0]]}; choose another --out")


def features_of(arm: Arm, config: Config) -> str | None:
    """The shared stage 1 that an arm takes its features from; ours, too, where it only looks through psi."""
    looks = needs_representation(config) and stage1_of(config) == config.stage1
    return arm.features or ("ours" if looks else None)


def shared_features(request: Request, domain: str, features: str, options: train.TrainOptions) -> pathlib.Path:
    """The run of that stage 1, with every seed that was asked for."""
    config, path = options.config, request.out / "runs" / registry.file_name(domain) / f"features-{features}"
    if (path / "config.json").exists():
        run = RunFolder.open(path)
        if stage1_in(run.config()) != config.stage1:
            raise RunError(f"{path}: was made with other --stage1 options; choose another --out")
    else:
        run = RunFolder.create(path, {"domain": domain, "stage1": dataclasses.asdict(config.stage1)})
    env = registry.make(domain)
    for seed in request.seeds:
        with run.held([seed]):
            if not (stage1.folder_of(run, seed) / FACTS_FILE).exists():
                stage1.learn(run, env, config.stage1, seed, SAY)
    return path


def merged(arm: Arm, runs: Sequence[RunFolder], begun: dict[int, int]) -> ReportedRun:
    """Runs that hold different seeds of one arm, as one; of the seeds and after the steps that `begun` names."""
    summaries = [run.summary() or summarise(run) for run in runs]
    every = {seed: value for summary in summaries for seed, value in summary["seeds"].items()}
    metrics = {seed: run.metrics(seed) for run in runs for seed in run.seeds() if seed in begun}
    summary = summaries[0] | {"seeds": {str(seed): every[str(seed)] for seed in sorted(metrics)}}
    return ReportedRun(arm.label, arm.colour, summary, dict(sorted(metrics.items())), begun=begun)


# -------------------------------------------------------------------------------------------------------------- figures


def note_on(request: Request, domains: Sequence[str], steps: dict[str, int]) -> str:
    """What a figure says of budgets, its own and the paper's where that is larger, and of options that were given."""
    parts = []
    for domain in domains:
        own, paper = steps[domain], STEPS.get(registry.plain_name(domain), 0)
        shrunk = own < paper or len(request.seeds) < PAPER_SEEDS
        parts.append(f"{figures.display_name(domain)}: {len(request.seeds)} seed{'s' * (len(request.seeds) > 1)}, "
                     f"{own:,} steps" + (f" (paper: {PAPER_SEEDS} seeds, {paper:,} steps)" if shrunk and paper else ""))
    return "; ".join(parts) + (f". With {' '.join(request.extra)}" if request.extra else "")


def stage1_samples(request: Request, domain: str, arm: Arm) -> dict[int, int]:
    """By seed, environment steps of the random policy that an arm's features were trained on: none where an expert
    acted."""
    config = request.parse(domain, arm).config
    if config.stage1.data == "demonstrations" or (arm.features is None and "believer" not in arm.options):
        return dict.fromkeys(request.seeds, 0)
    env = registry.make(domain)
    keys = {seed: jax.random.split(stage1.representation_key(seed), 3)[0] for seed in request.seeds}
    return {seed: collect(env, key, config.stage1.episodes).size for seed, key in keys.items()}


def run_curves(name: str, request: Request, domains: Sequence[str]) -> None:
    """Train what is missing of an experiment, domain by domain, and write its figure and table after each."""
    experiment = EXPERIMENTS[name]
    groups: dict[str, list[ReportedRun]] = {}
    steps: dict[str, int] = {}
    missing: dict[str, None] = {}
    for number, domain in enumerate(domains, start=1):
        for title, every in experiment.groups(domain).items():
            arms = [arm for arm in every if request.wants(arm)]
            missing |= {arm.label: None for arm in every if arm not in arms}
            if not arms:
                continue
            groups[title] = [
                merged(arm, run_arm(request, domain, arm), stage1_samples(request, domain, arm)) for arm in arms]
            steps[domain] = request.parse(domain, arms[0]).config.steps
        note = note_on(request, domains[:number], steps)
        if missing:
            note += f". Left out: {', '.join(missing)}"
        note += began(groups)
        figures.draw_groups(groups, request.place(name, ".png"), title=experiment.title, note=note)
        write_table(name, request, experiment.title, groups, note)


def began(groups: dict[str, list[ReportedRun]]) -> str:
    """Whose curves begin where stage 1's random steps end, and how many these are, where it is one domain."""
    every = [run for runs in groups.values() for run in runs]
    numbers = sorted({number for run in every for number in run.begun.values() if number})
    if not numbers:
        return ""
    ends = " to ".join(f"{number:,}" for number in sorted({numbers[0], numbers[-1]}))
    steps = f"{ends} " if len({run.domain for run in every}) == 1 else ""
    labels = ", ".join(dict.fromkeys(run.label for run in every if any(run.begun.values())))
    return f". Dashed vertical: the {steps}random steps of stage 1 end, which come before the curve of {labels}"


def write_table(name: str, request: Request, title: str, groups: dict[str, list[ReportedRun]], note: str) -> None:
    """NAME.md and NAME.csv."""
    lines = [{"panel": panel, **line} for panel, runs in groups.items() for line in tables.comparison_table(runs)]
    tables.write_csv(request.place(name, ".csv"), lines)
    text = (f"# {title}\n\n{note}\n\n    {command_line(name, request)}\n\n"
            + "\n\n".join(f"## {panel}\n\n{tables.comparison_markdown(runs)}"
                          for panel, runs in groups.items()) + "\n")
    request.place(name, ".md").write_text(text, encoding="utf-8")
    SAY(text)


def command_line(name: str, request: Request) -> str:
    """What makes this result again."""
    parts = [f"python -m launch.paper {name}", *([] if request.domain is None else [f"--domain {request.domain}"])]
    parts += [f"--seeds {','.join(map(str, request.seeds))},"]
    parts += [] if request.steps is None else [f"--steps {request.steps}"]
    parts += [] if request.arms is None else [f"--arms {','.join(request.arms)}"]
    return " ".join([*parts, *request.extra])


def run_intrinsic(name: str, request: Request, domains: Sequence[str]) -> None:
    """Fig. 32: the intrinsic reward of one episode in each domain, and how often it peaks at the information."""
    lines, drawn, steps = [], [], {}
    for domain in domains:
        (arm,), = EXPERIMENTS[name].groups(domain).values()
        runs = run_arm(request, domain, arm)
        for run in runs:
            config = training_of(run).config
            learner, steps[domain] = make_learner(registry.make(domain), config), config.steps
            for seed in (seed for seed in run.seeds() if seed in request.seeds):
                step, state = load_learner_state(run, seed, learner)
                seen = episode.trace(learner, state, evaluation_key(seed, step), TRACED_EPISODES)
                ends = seen.reward[np.arange(TRACED_EPISODES), seen.length]
                lines.append({
                    "domain": domain, "seed": seed, "episodes": TRACED_EPISODES, "success": float(np.mean(ends > 0)),
                    "informed": float(np.mean(seen.first_information() >= 0)),
                    "peaks_at_information": seen.peaks_at_information()})
                if domain not in [name for name, *_ in drawn]:
                    informed = np.flatnonzero(seen.first_information() >= 0)
                    index = int(informed[0]) if len(informed) else 0
                    drawn.append((domain, config.information.intrinsic_weight, seen, index))
                    draw_episode.draw_episode(
                        seen, index, learner.domain, request.out / f"{name}_{registry.file_name(domain)}_episode.png",
                        weight=config.information.intrinsic_weight,
                        title=f"{figures.display_name(domain)}, seed {seed}, step {step:,}")
        note = note_on(request, list(steps), steps)
        draw_episode.draw_bonuses([(figures.display_name(d), *rest) for d, *rest in drawn],
                                  request.place(name, ".png"), title=EXPERIMENTS[name].title, note=note)
        tables.write_csv(request.place(name, ".csv"), lines)
        text = (f"# {EXPERIMENTS[name].title}\n\n{note}\n\n    {command_line(name, request)}\n\n"
                f"{tables.plain_markdown(lines)}\n\nPeaks at information: of the episodes that were told the hidden "
                "variable, the share whose intrinsic reward peaks at the step that first tells it.\n")
        request.place(name, ".md").write_text(text, encoding="utf-8")
        SAY(text)


# -------------------------------------------------------------------------------------------------------------- command


def plan(what: str, domain: str | None) -> list[tuple[str, tuple[str, ...]]]:
    """The experiments to run, in order, each with its domains. `all` goes through the domains one after the other, so
    that the cheap ones are complete first."""
    names = list(EXPERIMENTS) if what == "all" else [what]
    if domain is not None:
        chosen = [(name, (domain,)) for name in names]
        return [(name, d) for name, d in chosen if what != "all" or domain in EXPERIMENTS[name].domains]
    if what != "all":
        return [(what, EXPERIMENTS[what].domains)]
    return [(name, tuple(d for d in DOMAINS[:number] if d in EXPERIMENTS[name].domains))
            for number in range(1, len(DOMAINS) + 1) for name in names
            if DOMAINS[number - 1] in EXPERIMENTS[name].domains]


def require_meant(name: str, request: Request, domain: str) -> None:
    """Raise `ConfigError` for an experiment that would say nothing of a domain: where its arms set what their agents do
    not read, or where it draws discrete actions and they are not."""
    continuous = isinstance(registry.make(domain).action_spec, ContinuousActions)
    require(name != "fig32" or not continuous, "domain", domain, "one with discrete actions, for fig32")
    for arm in (arm for arms in EXPERIMENTS[name].groups(domain).values() for arm in arms if request.wants(arm)):
        config = request.parse(domain, arm).config
        for word in (word for word in arm.options if word.startswith("--")):
            option = word.lstrip("-").replace("-", "_").replace(".no_", ".")
            read = reads(config, continuous, option) or option.startswith("information.")  # one may switch others off
            require(read, "domain", domain, f"one whose {config.agent} reads {word}, which {name} changes")


def arm_names(what: str, domain: str | None) -> list[str]:
    """Of all curves that a command draws."""
    panels = (panel for name, domains in plan(what, domain) for d in domains
              for panel in EXPERIMENTS[name].groups(d).values())
    return list(dict.fromkeys(arm.name for panel in panels for arm in panel))


def parse(arguments: Sequence[str]) -> tuple[str, Request]:
    """The command line; what it does not know is passed on to `mijax.train`."""
    parser = argparse.ArgumentParser(
        prog="python -m launch.paper", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False)
    parser.add_argument("experiment", metavar="|".join((*EXPERIMENTS, "all")))
    parser.add_argument("--domain", help="one domain; default: those of the paper's figure")
    parser.add_argument("--seeds", default=str(PAPER_SEEDS), help="how many (5), or which ones (3,7; a single one: 3,)")
    parser.add_argument("--steps", type=int, help="environment steps of each run; default: the domain's preset")
    parser.add_argument("--arms", help="some of the experiment's curves, such as mi,base; default: all")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("runs/paper"), help="where to write")
    known, extra = parser.parse_known_args(list(arguments))
    accepted = ", ".join((*EXPERIMENTS, "all"))
    if known.experiment not in (*EXPERIMENTS, "all"):
        raise ConfigError(f"experiment: got {known.experiment!r}, accepted: {accepted}")
    require(known.steps is None or known.steps >= 1, "steps", known.steps, "a number >= 1")
    reserved = [word for word in extra if word.split("=")[0] in SET_BY_EXPERIMENT]
    require(not reserved, (reserved[0] if reserved else "").lstrip("-"), "a value",
            "nothing here, the experiment sets it")
    seeds = parse_seeds(known.seeds)
    arms = None if known.arms is None else tuple(known.arms.split(","))
    if arms is not None:
        names = arm_names(known.experiment, known.domain)
        require(set(arms) <= set(names), "arms", known.arms, f"some of {','.join(names)}")
    return known.experiment, Request(known.out, known.domain, seeds, known.steps, tuple(extra), arms)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    def work() -> None:
        what, request = parse(sys.argv[1:] if arguments is None else arguments)
        runtime.prepare(host_devices=min(runtime.cores(), len(request.seeds)))
        if request.domain is not None:
            registry.make(request.domain)  # after `prepare`: a robot's physics starts JAX
            for name, domains in plan(what, request.domain):
                for domain in domains:
                    require_meant(name, request, domain)
        request.out.mkdir(parents=True, exist_ok=True)
        for name, domains in plan(what, request.domain):
            SAY(f"== {name}: {EXPERIMENTS[name].title}: {', '.join(domains)}")
            (run_intrinsic if name == "fig32" else run_curves)(name, request, domains)

    return runtime.exit_code(work)


if __name__ == "__main__":
    runtime.leave(main())

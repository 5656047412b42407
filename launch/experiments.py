"""The paper's experiments as declarations: which agents, with which options, on which domains, in which panel."""

import dataclasses
from collections.abc import Callable, Sequence

import configs
from envs_mjx.registry import plain_name
from mijax.agents.variants import VARIANTS, stage1_of
from mijax.config import Config
from mijax.figures import display_name
from mijax.results import AGENT_COLOURS

GRID_WORLDS = ("heaven_hell", "sphinx", "carflag_2d")
DOMAINS = GRID_WORLDS + configs.ROBOTS
BONUS_WEIGHT = 0.5
"""Of the intrinsic reward where a domain's preset has none but the experiment is about it."""
_BELIEVER = stage1_of(Config(agent="believer"))
BELIEVER_FEATURES = tuple(
    word for name in ("lambda_kl", "lambda_club", "lambda_dim_s", "lambda_dim_o", "phi_shrinkage")
    for word in (f"--stage1.{name.replace('_', '-')}", f"{getattr(_BELIEVER, name):g}"))
"""Stage 1 as Believer has it (Appendix A.5), for another agent: a KL penalty in the place of all others."""


@dataclasses.dataclass(frozen=True)
class Arm:
    """One curve: an agent and the options that set it apart from its domain's preset."""

    name: str
    """Of its folder."""
    label: str
    colour: str
    options: tuple[str, ...]
    features: str | None = None
    """The shared stage 1: `ours` or `believer`; None where the agent has none of its own, or Believer's own."""


MI = Arm("mi", "Ours", AGENT_COLOURS["mi"], ("--agent", "mi"), "ours")
AGENTS = (
    MI,
    Arm("base", "DTQN", AGENT_COLOURS["base"], ("--agent", "base")),
    Arm("zp", "ZP-DRQN", AGENT_COLOURS["zp"], ("--agent", "zp")),
    Arm("ba", "BA-DTQN", AGENT_COLOURS["ba"], ("--agent", "ba")),
    Arm("ua", "UA-DTQN", AGENT_COLOURS["ua"], ("--agent", "ua")),
    Arm("believer", "B-DQN", AGENT_COLOURS["believer"], ("--agent", "believer")),
)


def agents(domain: str) -> dict[str, tuple[Arm, ...]]:
    """Fig. 3: every agent, under its name on the domain's algorithm."""
    if plain_name(domain) not in configs.ROBOTS:
        return {display_name(domain): AGENTS}
    return {display_name(domain): tuple(dataclasses.replace(arm, label=VARIANTS[arm.name].title_sac) for arm in AGENTS)}


def overlap(domain: str, sources: Sequence[str] = ("ours", "believer")) -> dict[str, tuple[Arm, ...]]:
    """Figs. 4 and 29: a memoryless agent on z_s and z_o, on z_s alone, and on the raw state."""
    def arms(source: str) -> tuple[Arm, ...]:
        options = ("--agent", "mdp", *(BELIEVER_FEATURES if source == "believer" else ()))
        return (
            Arm(f"mdp-both-{source}", "$z_s$ and $z_o$", "#0072B2", (*options, "--mdp.sees", "z_s_z_o"), source),
            Arm(f"mdp-z_s-{source}", "$z_s$ alone", "#D55E00", (*options, "--mdp.sees", "z_s"), source),
            Arm("mdp-state", "state", "#555555", ("--agent", "mdp", "--mdp.sees", "state")))

    names = {"ours": "our features", "believer": "Believer's features"}
    return {f"{display_name(domain)}, {names[source]}": arms(source) for source in sources}


def features(domain: str) -> dict[str, tuple[Arm, ...]]:
    """Fig. 29."""
    return overlap(domain, ("ours",))


def memories(domain: str) -> dict[str, tuple[Arm, ...]]:
    """Figs. 5 and 31: a transformer against a GRU."""
    gru = Arm("mi-gru", "Ours with a GRU", AGENT_COLOURS["zp"], ("--agent", "mi", "--memory", "gru"), "ours")
    return {display_name(domain): (MI, gru)}


def informed(domain: str) -> Arm:
    """Ours with its intrinsic reward, also where the preset goes without: episodes then earn up to twice its weight
    more, from sure and wrong to sure and right."""
    preset = configs.preset(domain)
    if preset.information.intrinsic_weight > 0:
        return MI
    options = ("--agent", "mi", "--information.intrinsic-weight", f"{BONUS_WEIGHT:g}")
    if preset.dqn.value_bound > 0:  # of what an episode can earn, bonus included
        options += ("--dqn.value-bound", f"{preset.dqn.value_bound + 2 * BONUS_WEIGHT:g}")
    return Arm("mi-bonus", f"Ours, bonus {BONUS_WEIGHT:g}", AGENT_COLOURS["mi"], options, "ours")


def ablations(domain: str) -> dict[str, tuple[Arm, ...]]:
    """Figs. 6 and 30: the intrinsic reward, the auxiliary task, both."""
    both = informed(domain)
    arms = (
        dataclasses.replace(both, label="both"),
        Arm("mi-auxiliary", "auxiliary task alone", AGENT_COLOURS["ua"],
            (*both.options, "--information.intrinsic-weight", "0"), "ours"),
        Arm("mi-intrinsic", "intrinsic reward alone", AGENT_COLOURS["ba"],
            (*both.options, "--information.auxiliary-weight", "0"), "ours"))
    return {display_name(domain): arms}


def parts(domain: str) -> dict[str, tuple[Arm, ...]]:
    """Not in the paper: ours on a robot with one part left out at a time."""
    def without(name: str, label: str, colour: str, *options: str) -> Arm:
        return Arm(f"mi-no-{name}", f"without {label}", colour, (*MI.options, *options), "ours")

    return {display_name(domain): (
        MI,
        without("augmentation", "turned copies", "#E69F00", "--sac.rotated-copies", "0"),
        without("auxiliary", "auxiliary task", "#009E73", "--information.auxiliary-weight", "0"),
        without("intrinsic", "intrinsic reward", "#CC79A7", "--information.intrinsic-weight", "0"),
        without("psi", "psi", "#555555", "--sac.trunk", "shared", "--information.no-start-from-psi"),
        without("imitation", "imitation", "#D55E00", "--sac.pretrain-updates", "0", "--sac.imitation-weight", "0",
                "--sac.no-imitate-successes"))}


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A figure of the paper."""

    title: str
    domains: tuple[str, ...]
    groups: Callable[[str], dict[str, tuple[Arm, ...]]]
    """From a domain to the arms of each of its panels, ours first."""


EXPERIMENTS = {
    "fig4": Experiment("Overlap test (Fig. 4)", ("heaven_hell",), overlap),
    "fig3": Experiment("All agents (Fig. 3)", DOMAINS, agents),
    "fig32": Experiment("Intrinsic reward within an episode (Fig. 32)", GRID_WORLDS,
                        lambda domain: {display_name(domain): (informed(domain),)}),
    "fig6": Experiment("Intrinsic reward and auxiliary task (Fig. 6)", ("sphinx", "carflag_2d"), ablations),
    "fig5": Experiment("GPT against GRU (Fig. 5)", ("heaven_hell", "sphinx"), memories),
    "fig29": Experiment("Learning on features (Fig. 29)", DOMAINS, features),
    "fig31": Experiment("GPT against GRU (Fig. 31)", DOMAINS, memories),
    "fig30": Experiment("Intrinsic reward and auxiliary task (Fig. 30)", DOMAINS, ablations),
    "parts": Experiment("What each part is worth", ("block_pulling",), parts),
}
"""In the order of `all`, information per minute: the memoryless agents are cheap and tell whether the features are
right; Figs. 29 to 31 mostly draw what is there already. Within it, cheap domains come first."""

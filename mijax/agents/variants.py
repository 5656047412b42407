"""The paper's agents as declarations: what each network sees and which losses it adds."""

import dataclasses

from mijax.config import Config, ConfigError, CriticInput, MemoryKind, Stage1Config, require


@dataclasses.dataclass(frozen=True)
class Variant:
    """What sets one agent apart on the shared core. All act on the history but `mdp`, which sees the state."""

    title: str
    """Name in figures on Double DQN, with the first of its memories."""
    title_sac: str
    """The same on SAC."""
    summary: str
    """One line for the help text."""
    memories: tuple[MemoryKind, ...] = ("gpt", "gru", "mlp")
    """Accepted sequence models, the agent's own first."""
    uses_representation: bool = False
    """Whether stage 1 takes part: the replay stores z_s, and the memoryless branch starts from psi."""
    informed: bool = False
    """The bonus for information on z_s and the auxiliary prediction of z_s."""
    critic: CriticInput | None = None
    """An asymmetric critic: with DQN beside Q(h, a), both bootstrapping from its target network; with SAC the only."""
    predicts_itself: bool = False
    """The auxiliary prediction of the next history summary (Eq. 6)."""
    believes: bool = False
    """The history reaches Q through samples of a belief p(z_s | h), fitted before and during learning."""
    sees_state: bool = False
    """Acts on features of the state, without a memory."""


VARIANTS = {
    "mi": Variant(
        "Ours", "Ours", "bonus for information on z_s, prediction of z_s, psi in the memoryless branch (Section 3.2)",
        uses_representation=True, informed=True),
    "base": Variant("DTQN", "TSAC", "the plain two-branch memory agent (Appendix A.1)"),
    "zp": Variant(
        "ZP-DRQN", "ZP-RSAC", "predicts its own next history summary (Appendix A.2)", memories=("gru",),
        predicts_itself=True),
    "ba": Variant(
        "BA-DTQN", "BA-TSAC", "biased asymmetric: a critic Q(s, a), with DQN beside Q(h, a) (Appendix A.3)",
        critic="state"),
    "ua": Variant(
        "UA-DTQN", "UA-TSAC", "unbiased asymmetric: a critic Q(h, s, a), with DQN beside Q(h, a) (Appendix A.4)",
        critic="history_state"),
    "believer": Variant(
        "B-DQN", "B-SAC", "learns on samples of a belief over z_s, stage 1 with a KL penalty (Appendix A.5)",
        memories=("gpt", "gru"), uses_representation=True, believes=True),
    "mdp": Variant(
        "MDP", "MDP", "no memory; sees the state, or stage 1's features of it: the overlap test (Fig. 4, Fig. 29)",
        memories=("mlp",), uses_representation=True, sees_state=True),
}


def variant(name: str) -> Variant:
    """The declaration of an agent, or an error that lists them."""
    if name not in VARIANTS:
        raise ConfigError(f"--agent: got {name!r}, accepted: {', '.join(VARIANTS)}")
    return VARIANTS[name]


def needs_representation(config: Config) -> bool:
    """Whether stage 1 has to come first."""
    declaration = variant(config.agent)
    if declaration.sees_state:
        return config.mdp.sees != "state"
    return declaration.uses_representation or config.sac.looks_through_psi


def reads(config: Config, continuous: bool, option: str) -> bool:
    """Whether a configuration's agent ever looks at an option such as `dqn.discount`, on SAC where actions are
    `continuous`."""
    declaration, begins = variant(config.agent), not continuous and _has_random_episodes(config)
    pays = declaration.informed and config.information.intrinsic_weight > 0
    read = {
        "dqn": not continuous, "dqn.pretrain_updates": begins,
        "dqn.pretrained_epsilon": begins and config.dqn.pretrain_updates > 0, "sac": continuous,
        "information": declaration.informed,
        "information.intrinsic_form": pays, "information.intrinsic_telescopes": pays, "information.folds": pays,
        "information.start_from_psi": declaration.uses_representation and not declaration.sees_state,
        "zp": declaration.predicts_itself, "believer": declaration.believes, "mdp": declaration.sees_state,
        "stage1": needs_representation(config)}
    return read.get(option, read.get(option.split(".")[0], True))


def memory_of(config: Config) -> MemoryKind:
    """The sequence model that a configuration means."""
    memories = variant(config.agent).memories
    if config.memory == "auto":
        return memories[0]
    require(config.memory in memories, "memory", config.memory, f"{', '.join(memories)} (--agent {config.agent})")
    return config.memory


def title_of(config: Config, continuous: bool = False) -> str:
    """Name in figures: the agent, on SAC where actions are `continuous`, and its memory when that is not its own."""
    declaration = variant(config.agent)
    memory = memory_of(config)
    title = declaration.title_sac if continuous else declaration.title
    return title + ("" if memory == declaration.memories[0] else f" ({memory.upper()})")


def pretrain_updates(config: Config) -> int:
    """Updates with which Double DQN begins on the random episodes of stage 1; 0 for an agent that has none."""
    return config.dqn.pretrain_updates if _has_random_episodes(config) else 0


def _has_random_episodes(config: Config) -> bool:
    declaration = variant(config.agent)
    return declaration.uses_representation and not declaration.sees_state and config.stage1.data == "random"


def stage1_of(config: Config) -> Stage1Config:
    """Stage 1 as the agent wants it: Believer has its KL penalty in the place of CLUB, DIM and shrinkage. What asks z_o
    for the simulator's variables it keeps: z_o alone is what agents see of a frame there (on the robots), and its own,
    not asked, told places with an R2 of 0.9 and 0.5 in two seeds, ours 1.0."""
    if not variant(config.agent).believes:
        return config.stage1
    asked = config.stage1.lambda_dim_o if config.stage1.lower_bound == "variables" else 0.0
    return dataclasses.replace(
        config.stage1, lambda_kl=config.believer.lambda_kl, lambda_club=0.0, lambda_dim_s=0.0, lambda_dim_o=asked,
        phi_shrinkage=0.0)

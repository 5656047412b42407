"""The paper's agents as declarations: what each network sees and which losses it adds."""

import dataclasses

from mijax.config import ConfigError


@dataclasses.dataclass(frozen=True)
class Variant:
    """What sets one agent apart on the shared core."""

    title: str
    """Name in figures, with a GPT as its memory."""
    summary: str
    """One line for the help text."""
    uses_z_s: bool
    """Whether stage 1's privileged features take part: bonus, auxiliary task, and psi as the memoryless branch."""


VARIANTS = {
    "mi": Variant(
        "Ours", "bonus for information on z_s, prediction of z_s, psi in the memoryless branch (Section 3.2)",
        uses_z_s=True),
    "base": Variant("DTQN", "the plain two-branch memory agent (paper Appendix A.1)", uses_z_s=False),
}


def variant(name: str) -> Variant:
    """The declaration of an agent, or an error that lists them."""
    if name not in VARIANTS:
        raise ConfigError(f"--agent: got {name!r}, accepted: {', '.join(VARIANTS)}")
    return VARIANTS[name]

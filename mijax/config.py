"""Every option of a run, as frozen dataclasses. Presets of the six domains are in `configs/`."""

import dataclasses
import math
import typing
from collections.abc import Mapping
from typing import Any, Literal

from envs_mjx.errors import UserError

MemoryKind = Literal["gpt", "gru", "mlp"]
MemoryName = Literal["auto", "gpt", "gru", "mlp"]
CriticInput = Literal["state", "history_state"]
"""What an asymmetric critic sees beside the action: s, or h and s."""
PrivilegedInput = Literal["z_s", "z_s_z_o", "state"]
IntrinsicForm = Literal["explained_variance", "cosine", "log_likelihood"]
LowerBound = Literal["jensen_shannon", "variables"]
StateBound = Literal["jensen_shannon", "conditional"]
EstimatorView = Literal["features", "directions", "raw"]
DataSource = Literal["random", "demonstrations"]
"""Whose episodes stage 1 learns from: a random policy's, or those of the environment's expert."""
TrunkKind = Literal["own", "shared", "psi", "z_o"]
SeedStrategy = Literal["auto", "map", "vmap", "shard"]


class ConfigError(UserError):
    """An option has a value that cannot be run; the message names the option and what is accepted.

    No ValueError: the command line parser would wrap those in a box of its own.
    """


def require(condition: bool, option: str, value: object, accepted: str) -> None:
    """Raise `ConfigError` naming `option` unless `condition` holds."""
    if not condition:
        raise ConfigError(f"--{option}: got {value!r}, accepted: {accepted}")


def _require_at_least(group: str, config: object, minimum: float, *names: str) -> None:
    for name in names:
        value = getattr(config, name)
        require(value >= minimum, f"{group}{name}".replace("_", "-"), value, f"a number >= {minimum}")


def _require_finite(options: Mapping[str, Any]) -> None:
    """Raise `ConfigError` for the first of the options, by their names, that is infinite or no number."""
    for name, value in options.items():
        numbers = value if isinstance(value, tuple) else (value,)
        finite = all(math.isfinite(number) for number in numbers if isinstance(number, float))
        require(finite, name.replace("_", "-"), value, "a finite number")


@dataclasses.dataclass(frozen=True)
class Stage1Config:
    """Representation learning (paper Section 3.1, Table 3).

    The defaults, with which environments of one's own start, are Table 3's for Heaven-Hell, but for fewer epochs.
    """

    data: DataSource = "random"
    """Whose episodes: of a random policy, or of the domain's expert (the robot tasks)."""
    episodes: int = 500
    """Episodes in the training set."""
    copies: int = 0
    """Copies of every demonstrated transition, each moved by a symmetry of the task (on the robots a random turn, half
    of the time after mirroring; drawn anew in every epoch) beside the original (Table 3)."""
    heldout_episodes: int = 100
    """Further episodes that only the probe sees."""
    epochs: int = 200
    """Passes over the training set (paper: 1000)."""
    batch_size: int = 500
    """Transitions per update; the last partial batch of an epoch is dropped."""
    learning_rate: float = 3e-3
    """Adam step size of phi, psi, the dynamics model and the estimator of CLUB."""
    final_learning_rate: float = 0.0
    """That of the first three falls to this fraction of itself, as a half cosine; 1 keeps it constant (paper), as that
    of the estimator always is."""
    warmup: float = 0.0
    """Fraction of training over which that of the first three rises from 0. Adam's first steps are as long as any, in
    directions of single batches; on camera images they can set psi far back, by luck of its start."""
    features: int = 32
    """Width of z_s and of z_o."""
    lambda_r: float = 10.0
    """Weight of the reward loss."""
    lambda_s: float = 1.0
    """Weight of the loss of the next state feature."""
    lambda_o: float = 0.5
    """Weight of the loss of the next observation feature."""
    lambda_club: float = 1.0
    """Weight of the upper bound of I(z_s; z_o), which is minimised."""
    club_ramp: float = 0.0
    """Fraction of training over which lambda_club grows, geometrically from a hundredth of itself; 0 is the paper's
    constant. At its full weight from the start, CLUB on camera images stops all learning before it has begun."""
    lambda_dim_s: float = 0.0
    """Weight of the lower bound of I(s; z_s), which is maximised."""
    state_bound: StateBound = "jensen_shannon"
    """Which bound that is. jensen_shannon: Deep InfoMax, the paper's, which asks that states are told apart.
    conditional: of I(s; z_s | o), which asks only that states are told apart which show the same observation: for what
    is hidden, and for nothing that can be seen. For domains whose observations repeat within a batch."""
    lambda_dim_o: float = 1.0
    """Weight of the lower bound of I(o; z_o), which is maximised."""
    lower_bound: LowerBound = "jensen_shannon"
    """Where the bound of I(o; z_o) comes from. jensen_shannon: Deep InfoMax, the paper's, which asks that observations
    are told apart; on a camera's images the gripper's height and yaw are enough for that, whatever else they show.
    variables: a linear map tells from z_o what can be seen of the domain's variables (places, angles), which a
    simulator knows as numbers in training."""
    estimator_updates: int = 5
    """Updates of CLUB's q(z_o | z_s) per update of the encoders."""
    estimator_view: EstimatorView = "features"
    """How q sees z_s. features: each brought to variance 1. directions: each principal direction of a batch is, so that
    what leaks into directions of little variance is seen as well, down to a ten-thousandth of the whole. In both cases
    each feature of z_o is brought to variance 1 as well. raw: z_s and z_o as they are (paper), with which the encoders
    may outrun q: on Heaven-Hell CLUB then fell to -3e18 by the paper's other numbers."""
    lambda_kl: float = 0.0
    """Weight of Believer's penalty KL[N(phi(s), 1) || N(0, 1)]; above 0, training draws z_s from that Gaussian."""
    rewarded: int = 0
    """Rewarded transitions added to every batch, for the reward loss alone, which then weighs rewarded and unrewarded
    ones alike. For rewards so rare that a batch hardly holds one; 0 is the paper's loss."""
    phi_shrinkage: float = 0.1
    """How far each weight of phi is pulled towards 0 in an update, in units of the step size (a proximal L1 penalty).
    Position that z_o already carries then leaves z_s exactly, below what CLUB's q can see. 0 is the paper's plain Adam,
    whose z_s leaks it; 0.3 erases z_s altogether (measured on Heaven-Hell)."""

    def __post_init__(self) -> None:
        _require_finite({f"stage1.{name}": value for name, value in dataclasses.asdict(self).items()})
        _require_at_least("stage1.", self, 1, "episodes", "heldout_episodes", "epochs", "batch_size", "features",
                          "estimator_updates")
        _require_at_least("stage1.", self, 0, "lambda_r", "lambda_s", "lambda_o", "lambda_club", "lambda_dim_s",
                          "lambda_dim_o", "lambda_kl", "rewarded", "phi_shrinkage", "copies")
        require(self.copies == 0 or self.data == "demonstrations", "stage1.copies", self.copies,
                "0, unless --stage1.data is demonstrations")
        require(self.state_bound == "jensen_shannon" or self.data == "random", "stage1.state-bound", self.state_bound,
                "jensen_shannon, unless --stage1.data is random: moments of demonstrations hardly look alike")
        require(self.heldout_episodes >= 2, "stage1.heldout-episodes", self.heldout_episodes,
                "at least 2: probes are fitted on one half and scored on the other")
        require(self.learning_rate > 0, "stage1.learning-rate", self.learning_rate, "a number > 0")
        require(0 <= self.final_learning_rate <= 1, "stage1.final-learning-rate", self.final_learning_rate,
                "a number in [0, 1]")
        require(0 <= self.club_ramp <= 1, "stage1.club-ramp", self.club_ramp, "a number in [0, 1]")
        require(0 <= self.warmup < 1, "stage1.warmup", self.warmup, "a number in [0, 1)")


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """The networks of the agent (paper Appendix A.7).

    The defaults are half as wide as the paper's: on Heaven-Hell they learn as well at a quarter of the cost.
    """

    layers: int = 1
    """Transformer blocks."""
    heads: int = 2
    """Attention heads per block."""
    gru_width: int = 64
    """Hidden units of the GRU, when the memory is one (paper: 128)."""
    action_embedding: int = 32
    """Width of the embedded previous action (paper: 64 for vectors, 16 for images)."""
    observation_embedding: int = 32
    """Width of the embedded observation (paper: 64 for vectors, 100 for images)."""
    critic_hidden: tuple[int, ...] = (128, 128)
    """Hidden layers of the Q head (paper: 256, 256)."""
    actor_hidden: tuple[int, ...] = (128, 128)
    """Hidden layers of SAC's actor (paper: 256, 256)."""
    auxiliary_hidden: tuple[int, ...] = (64, 64)
    """Hidden layers of the heads that predict z_s (paper: 128, 128)."""
    dropout: float = 0.1
    """Dropout in the transformer's residual branches, in gradient passes only: never while acting, in targets or in the
    bonus. Without it the agent learns the replay's episodes by heart, and its greedy policy comes and goes."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of the arithmetic; parameters stay float32."""

    def __post_init__(self) -> None:
        for name in ("critic_hidden", "actor_hidden", "auxiliary_hidden"):
            widths = getattr(self, name)
            require(all(width >= 1 for width in widths), f"network.{name.replace('_', '-')}", widths, "numbers >= 1")
        _require_at_least("network.", self, 1, "layers", "heads", "gru_width", "action_embedding",
                          "observation_embedding")
        require(0 <= self.dropout <= 0.9, "network.dropout", self.dropout, "a number in [0, 0.9]")


@dataclasses.dataclass(frozen=True)
class DQNConfig:
    """Double DQN on whole episodes, for discrete actions (paper Appendix A.6, Table 2).

    The defaults are what measurement found on Heaven-Hell; the paper's values stand beside them. What was changed
    (results/what_matters.md): returns with traces, few updates per step (the paper's ratio shows each step to the
    learner 816 times, and a memory network learns such a small replay by heart), a discount that leaves a gap between
    actions.
    """

    learning_rate: float = 1e-3
    """Adam step size (paper: 3e-4)."""
    final_learning_rate: float = 0.02
    """The step size falls linearly to this fraction of itself; 1 keeps it constant (paper: 1). It would be there after
    as many updates as the run's steps have, those of the warm-up counted, which have none: it ends a little above."""
    discount: float = 0.97
    """gamma of the learner (paper: 0.99). In the three grid worlds the belief-optimal policy is the same for both."""
    trace_decay: float = 0.9
    """lambda of the returns: of Watkins' Q(lambda), but for `trace_tolerance`; 0 gives the one-step target (paper)."""
    trace_tolerance: float = 0.1
    """A return goes on through an action whose value is within this of the best, in units of reward. With 0 only
    through the best one (Watkins): where several are as good, as while an agent wanders, nearly every return is then
    cut, the best of several noisy values is believed at every step, and wandering pays."""
    target_rate: float = 0.01
    """tau: how far the target network moves towards the online network after every update (paper: 0.005)."""
    batch_episodes: int = 32
    """Episodes per update, an even number (paper: 64)."""
    updates_per_step: float = 0.1
    """Gradient updates per environment step (paper: 0.25)."""
    replay_steps: int = 1_000_000
    """Capacity of the replay, in steps of full-length episodes."""
    warmup_episodes: int = 40
    """Random episodes before the first update (paper's program: 10). None where the replay starts with
    those of stage 1."""
    pretrain_updates: int = 0
    """Updates on the random episodes that stage 1 learnt from, before the agent acts: its replay then starts with them,
    as they were paid for. For agents with a stage 1 of random episodes alone. 0: the replay starts empty (paper)."""
    pretrained_epsilon: float = 0.4
    """Where in its schedule exploration starts after such updates."""
    epsilon_final: float = 0.02
    """Exploration at the end of its schedule (the paper's 1 / horizon)."""
    epsilon_steps: int = 25_000
    """Environment steps over which epsilon falls linearly from 1 (the paper: a tenth of a budget of 500 000)."""
    bootstrap_at_time_limit: bool = False
    """Whether the value of the last state counts when the time limit ends an episode."""
    value_bound: float = 0.0
    """The largest magnitude of a bootstrapped value, where it is known what an episode can earn at most (bonus
    included); targets cannot run away beyond it. 0: none (paper)."""

    def __post_init__(self) -> None:
        _require_at_least("dqn.", self, 1, "batch_episodes", "replay_steps", "warmup_episodes", "epsilon_steps")
        _require_at_least("dqn.", self, 0, "value_bound", "trace_tolerance", "pretrain_updates")
        require(self.learning_rate > 0, "dqn.learning-rate", self.learning_rate, "a number > 0")
        require(self.updates_per_step > 0, "dqn.updates-per-step", self.updates_per_step, "a number > 0")
        require(self.batch_episodes % 2 == 0, "dqn.batch-episodes", self.batch_episodes, "an even number")
        for name in ("discount", "trace_decay", "target_rate", "epsilon_final", "final_learning_rate",
                     "pretrained_epsilon"):
            value = getattr(self, name)
            require(0 <= value <= 1, f"dqn.{name}".replace("_", "-"), value, "a number in [0, 1]")

    def updates_in(self, steps: int) -> int:
        """Gradient updates while an agent takes so many environment steps; without those before its first."""
        return max(1, round(steps * self.updates_per_step))


@dataclasses.dataclass(frozen=True)
class SACConfig:
    """Soft actor-critic on whole episodes, for continuous actions (paper Appendix A.6, Table 2).

    The paper's values stand beside ours where they differ.
    """

    learning_rate: float = 3e-4
    """Adam step size of the actor, the critics, f and the temperature."""
    final_learning_rate: float = 1.0
    """The step size falls linearly to this fraction of itself, as that of DQN; 1 keeps it constant."""
    discount: float = 0.99
    """gamma of the learner."""
    trace_decay: float = 0.0
    """lambda of the returns that the critics learn, with uncorrected traces; 0 gives the one-step target. The entropy
    of the steps that a return goes on through is left out of it."""
    target_rate: float = 0.005
    """tau: how far the target network moves towards the online network after every update."""
    initial_temperature: float = 0.01
    """alpha at the start; it is learnt."""
    target_entropy: float = -1.0
    """What the actor's entropy is held at, in nats per dimension of the action."""
    batch_episodes: int = 32
    """Episodes per update, an even number (paper's table: 64, its program: 32)."""
    updates_per_step: float = 1.0
    """Gradient updates per environment step."""
    replay_steps: int = 100_000
    """Capacity of the replay, in steps of full-length episodes."""
    warmup_episodes: int = 2
    """Random episodes before the first update."""
    demonstrations: int = 0
    """Episodes of the environment's expert in the replay from the start, for good (paper: 80 on the robots)."""
    demonstration_share: float = 0.0
    """Probability with which an episode of a batch is drawn among the demonstrations alone (paper: 0)."""
    pretrain_updates: int = 0
    """Updates on the demonstrations, and the few random episodes, before the agent acts (paper: 0); rounded up to what
    belongs to num-envs x steps-per-iteration steps."""
    imitation_weight: float = 0.0
    """Weight of the squared distance of the actor's mean action from a demonstration's (paper: 0). With any, its scale
    is fitted to the distance that is left, with weight 1."""
    imitation_until: float = 1.0
    """Fraction of the run's updates over which both weights fall linearly ..."""
    imitation_final: float = 0.0
    """... to this fraction of themselves, which stays."""
    imitate_successes: bool = False
    """Whether the mean also comes near the actions of the agent's own episodes that return as much as the median
    demonstration: 80 demonstrations show few scenes. The scale keeps to the demonstrations."""
    greedy_environments: int = 0
    """In how many of the environments the agent acts by its mean action while it learns (paper: 0): as it is evaluated.
    Where the mean action leads nowhere, noise hides it; the critics never see how such an episode ends."""
    rotated_copies: int = 0
    """Copies of each episode, moved by a symmetry of the task that is drawn once per copy, that are sampled beside the
    original (paper: 4 on the robots)."""
    trunk: TrunkKind = "shared"
    """How frames are encoded. own: by a whole encoder in each branch (paper). shared: once per update, for the actor,
    the critics, their targets and f, with a last layer of its own for each branch; the trunk starts from psi where the
    agent does. psi: the trunk is psi's body and stays so, for every agent, as phi's is the state's for a critic that
    sees states; the replay stores their features, in every copy of an episode, and no update looks at a frame. z_o: as
    psi, but agents see no more of a frame than psi's output, z_o."""
    critic_norm: bool = True
    """Whether the critics' hidden layers are normalised, which keeps values of unseen actions in bounds (paper: no)."""
    bootstrap_at_time_limit: bool = False
    """Whether the value of the last state counts when the time limit ends an episode."""

    def __post_init__(self) -> None:
        _require_at_least("sac.", self, 1, "batch_episodes", "replay_steps", "warmup_episodes")
        _require_at_least("sac.", self, 0, "demonstrations", "rotated_copies", "pretrain_updates", "imitation_weight",
                          "greedy_environments")
        for name in ("learning_rate", "updates_per_step", "initial_temperature"):
            require(getattr(self, name) > 0, f"sac.{name}".replace("_", "-"), getattr(self, name), "a number > 0")
        require(self.batch_episodes % 2 == 0, "sac.batch-episodes", self.batch_episodes, "an even number")
        for name in ("discount", "trace_decay", "target_rate", "final_learning_rate", "demonstration_share",
                     "imitation_until", "imitation_final"):
            value = getattr(self, name)
            require(0 <= value <= 1, f"sac.{name}".replace("_", "-"), value, "a number in [0, 1]")
        for name in ("demonstration_share", "pretrain_updates", "imitation_weight"):
            value = getattr(self, name)
            require(self.demonstrations > 0 or value == 0, f"sac.{name}".replace("_", "-"), value,
                    "0, unless there are --sac.demonstrations")
        require(self.imitation_weight > 0 or not self.imitate_successes, "sac.imitate-successes",
                self.imitate_successes, "False, unless there is an --sac.imitation-weight")

    @property
    def looks_through_psi(self) -> bool:
        """Whether psi, as stage 1 left it, is all that any agent sees frames through."""
        return self.trunk in ("psi", "z_o")

    def updates_in(self, steps: int) -> int:
        """Gradient updates of a run of so many environment steps; with those before its first."""
        return self.pretrain_updates + max(1, round(steps * self.updates_per_step))


@dataclasses.dataclass(frozen=True)
class InformationConfig:
    """What the privileged features z_s are used for in stage 2 (paper Section 3.2)."""

    auxiliary_weight: float = 0.5
    """Weight of the memory branch's prediction of z_s."""
    auxiliary_in_variances: bool = True
    """Whether that error counts in fractions of Tr Var(z_s), so that one weight suits features of any scale; otherwise
    as the squared norm of Eq. 5 (paper)."""
    intrinsic_weight: float = 0.5
    """alpha: weight of the information bonus in the total reward."""
    intrinsic_form: IntrinsicForm = "log_likelihood"
    """How the bonus measures the information gained about z_s in one step: by the ratio of Eq. 4, which pays for
    becoming sure; by the share of the variance of z_s that is explained, which pays nothing where the hidden value is
    the one that was expected; or by the paper's cosines."""
    intrinsic_telescopes: bool = True
    """Whether the guess before a step is compared with z_s before it, so that the bonus of an episode adds up to what
    is known at its end. Otherwise with z_s after it (paper): the same for a z_s that stays, while one that also holds
    what is seen pays for going to and fro."""
    folds: int = 1
    """Models f: 1, or 2 that are each trained on half of the episodes and pay the bonus on the other half."""
    start_from_psi: bool = True
    """Whether the memoryless branch starts from stage 1's psi; otherwise from random weights."""

    def __post_init__(self) -> None:
        _require_at_least("information.", self, 0, "auxiliary_weight", "intrinsic_weight")
        require(self.folds in (1, 2), "information.folds", self.folds, "1 or 2")


@dataclasses.dataclass(frozen=True)
class SelfPredictionConfig:
    """ZP-DRQN and ZP-RSAC alone (paper Appendix A.2)."""

    weight: float = 1.0
    """Weight of the prediction of the next history summary (Table 2)."""

    def __post_init__(self) -> None:
        _require_at_least("zp.", self, 0, "weight")


@dataclasses.dataclass(frozen=True)
class BelieverConfig:
    """B-DQN and B-SAC alone (paper Appendix A.5)."""

    history_width: int = 16
    """Width of the history's summary x (Table 2: X-Dim)."""
    latent_width: int = 16
    """Width of the latent of the history VAE (Table 2: Z-Dim)."""
    samples: int = 8
    """Beliefs sampled per history; the paper does not say how many."""
    updates: int = 2000
    """Updates of the history VAE on random episodes, as many as stage 1's, before learning starts."""
    lambda_kl: float = 0.01
    """Weight of the KL penalty in stage 1, which takes the place of all other penalties there."""
    weight: float = 1.0
    """Weight of the VAE's loss, in nats, while learning: the history model is fine-tuned."""

    def __post_init__(self) -> None:
        _require_at_least("believer.", self, 1, "history_width", "latent_width", "samples")
        _require_at_least("believer.", self, 0, "updates", "lambda_kl", "weight")


@dataclasses.dataclass(frozen=True)
class MDPConfig:
    """The overlap test's memoryless agent alone (paper Section 5.2.1)."""

    sees: PrivilegedInput = "z_s_z_o"
    """What it acts on: z_s, z_s beside z_o, or the state itself."""


@dataclasses.dataclass(frozen=True)
class EvaluationConfig:
    """Greedy evaluation during training."""

    every: int = 1000
    """Environment steps between evaluations."""
    episodes: int = 20
    """Episodes per evaluation."""
    discount: float = 0.99
    """gamma of the discounted return that is reported, whatever the agent learns with."""

    def __post_init__(self) -> None:
        _require_at_least("evaluation.", self, 1, "every", "episodes")
        require(0 < self.discount <= 1, "evaluation.discount", self.discount, "a number in (0, 1]")


@dataclasses.dataclass(frozen=True)
class SeedsConfig:
    """How several seeds share the machine."""

    strategy: SeedStrategy = "auto"
    """map: one after the other on one device; vmap: one batched program; shard: spread over the devices. auto: vmap on
    an accelerator; on a CPU, map for one seed and shard over one host device per core for several."""


@dataclasses.dataclass(frozen=True)
class CheckpointConfig:
    """What a run keeps on disk to go on from."""

    every: int = 10
    """Evaluations between checkpoints."""
    keep: int = 2
    """Checkpoints kept, the newest."""

    def __post_init__(self) -> None:
        _require_at_least("checkpoint.", self, 1, "every")
        _require_at_least("checkpoint.", self, 2, "keep")


MOST_STEPS = 2**31 - 1
"""Steps are counted in 32 bits."""


@dataclasses.dataclass(frozen=True)
class Config:
    """A whole run."""

    domain: str = "heaven_hell"
    """A registered environment, or `package.module:EnvClass`; its arguments may follow: `name,argument=value,...`."""
    agent: str = "mi"
    """mi (ours), base (DTQN or TSAC), zp, ba, ua, believer or mdp: see mijax.agents.variants."""
    memory: MemoryName = "auto"
    """The sequence model of the memory branch. auto: the agent's own, for most a gpt; mlp: no memory."""
    steps: int = 100_000
    """Environment steps of stage 2, its random ones at the start included; the last evaluation comes after them, when
    another `evaluation.every` steps are whole."""
    num_envs: int = 4
    """Environments stepped side by side."""
    steps_per_iteration: int = 5
    """Steps in each environment between two rounds of updates."""
    stage1: Stage1Config = dataclasses.field(default_factory=Stage1Config)
    network: NetworkConfig = dataclasses.field(default_factory=NetworkConfig)
    dqn: DQNConfig = dataclasses.field(default_factory=DQNConfig)
    sac: SACConfig = dataclasses.field(default_factory=SACConfig)
    information: InformationConfig = dataclasses.field(default_factory=InformationConfig)
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)
    zp: SelfPredictionConfig = dataclasses.field(default_factory=SelfPredictionConfig)
    believer: BelieverConfig = dataclasses.field(default_factory=BelieverConfig)
    mdp: MDPConfig = dataclasses.field(default_factory=MDPConfig)
    seeds: SeedsConfig = dataclasses.field(default_factory=SeedsConfig)
    checkpoint: CheckpointConfig = dataclasses.field(default_factory=CheckpointConfig)

    def __post_init__(self) -> None:
        _require_finite(options_of(self))
        _require_at_least("", self, 1, "steps", "num_envs", "steps_per_iteration")
        require(self.steps <= MOST_STEPS, "steps", self.steps, f"a number <= {MOST_STEPS}")
        steps = self.iteration_steps
        require(self.evaluation.every % steps == 0, "evaluation.every", self.evaluation.every,
                f"a multiple of num-envs x steps-per-iteration = {steps}")
        require(self.sac.greedy_environments < self.num_envs, "sac.greedy-environments", self.sac.greedy_environments,
                f"a number below num-envs = {self.num_envs}")

    @property
    def iteration_steps(self) -> int:
        """Environment steps of one learner iteration, over all environments."""
        return self.num_envs * self.steps_per_iteration

    def updates_per_iteration(self, group: str, updates_per_step: float) -> int:
        """Gradient updates of one learner iteration; `ConfigError` unless a whole number, at least 1."""
        steps = self.iteration_steps
        updates = updates_per_step * steps
        whole = updates >= 1 and abs(updates - round(updates)) < 1e-9
        require(whole, f"{group}.updates-per-step", updates_per_step,
                f"a whole number of updates in num-envs x steps-per-iteration = {steps} steps")
        return round(updates)


def options_of(config: Config) -> dict[str, Any]:
    """Every option by its name on the command line, with underscores: {"dqn.learning_rate": 0.0003, ...}."""
    flat = {}
    for name, value in dataclasses.asdict(config).items():
        flat |= {f"{name}.{inner}": x for inner, x in value.items()} if isinstance(value, dict) else {name: value}
    return flat


def config_from_dict(values: Mapping[str, Any]) -> Config:
    """The configuration that `dataclasses.asdict` once turned into `values`; `ConfigError` for an unknown field."""
    return _build(Config, values, "")


def _build(kind: Any, values: Mapping[str, Any], prefix: str) -> Any:
    types = typing.get_type_hints(kind)
    unknown = sorted(set(values) - set(types))
    if unknown:
        raise ConfigError(f"--{prefix}{unknown[0]}: this version has no such option, accepted: {', '.join(types)}")
    built = {}
    for name, value in values.items():
        if dataclasses.is_dataclass(types[name]):
            value = _build(types[name], value, f"{prefix}{name}.")
        if typing.get_origin(types[name]) is Literal:
            accepted = typing.get_args(types[name])
            require(value in accepted, f"{prefix}{name}".replace("_", "-"), value, ", ".join(accepted))
        built[name] = tuple(value) if isinstance(value, list) else value
    return kind(**built)


def parse_seeds(text: str) -> tuple[int, ...]:
    """`5` -> (0, 1, 2, 3, 4); `3,7` -> (3, 7); `3,` -> (3,)."""
    parts = [part.strip() for part in text.split(",") if part.strip()]
    valid = bool(parts) and all(part.isdecimal() for part in parts)
    require(valid, "seeds", text, "a number of seeds such as 5, or a list such as 3,7")
    numbers = tuple(int(part) for part in parts)
    if "," not in text:
        require(numbers[0] >= 1, "seeds", text, "at least one seed")
        return tuple(range(numbers[0]))
    require(len(set(numbers)) == len(numbers), "seeds", text, "different seeds")
    return numbers

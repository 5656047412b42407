"""The overlap test of the paper (Section 5.2.1) made automatic: what can be decoded from z_s and from z_o?

Probes are fitted on one half of the held-out episodes and scored on the other, so that chance correlations of a few
episodes do not count. P1: z_s and z_o together hold everything. P2: z_s holds what is hidden and nothing that can be
seen, z_o the reverse. Letters: N transitions, F features, V variables, W columns of targets.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from envs_mjx.base import Environment, Variable
from mijax.config import Stage1Config
from mijax.losses.club import club_all_pairs
from mijax.losses.information import LEAST_LOG_VARIANCE, log_likelihood_bonus
from mijax.representation.dataset import Transitions, collect
from mijax.representation.model import evaluate, networks_for
from mijax.representation.train import History, encode_frames, seen_by_estimator
from mijax.types import Representation

ROUND_OFF = 1e-5
"""A direction of feature space counts, and is scaled to variance 1, if its standard deviation exceeds this fraction of
the root mean square length of the features, however little of their variance it is. Sums of 128 float32 products differ
by about 1e-6 of their size between inputs that should give the same: that is below, and no leak."""
DECODED = 0.99
"""A variable is there if its score reaches this: R2, or accuracy."""
LEAK_R2 = 0.05
"""A real variable is absent up to this R2."""
LEAK_ACCURACY = 0.2
"""A category is absent up to this fraction of the way from the commonest class's share to 1: 0.6 for two equal classes.
Fifty episodes hold fifty draws of a hidden variable, so that chance alone moves an accuracy by several hundredths."""
REWARD_DECODED = 0.9
"""The dynamics model must explain this fraction of the variance of rewards, which are rare events."""
RIDGE = 1e-6
"""Ridge penalty per row, on directions of variance 1."""
MLP_WIDTH, MLP_STEP_SIZE = 64, 1e-2
"""Two hidden layers, and the first step size of Adam."""
MLP_PASSES, MLP_BATCH = 300, 2048
"""Passes over the rows that a network is fitted to, so many of them at a time. Full batches left the goal of
CarFlag-2D, with 23 000 rows, at R2 0.95 to 0.98 where these find 0.985; the other domains have fewer rows than one."""


@dataclasses.dataclass(frozen=True)
class Decoding:
    """How well a variable is decoded from features, on episodes the probe was not fitted to."""

    variable: str
    source: str
    """`z_s`, `z_o` or `both`; of a hidden variable, `z_o` means where the observation does not reveal it."""
    hidden: bool
    measure: str
    """`accuracy` or `R2`."""
    linear: float
    mlp: float
    chance: float
    """Share of the commonest class; 0 for R2."""

    @property
    def best(self) -> float:
        """The better of both probes."""
        return max(self.linear, self.mlp)

    @property
    def informed(self) -> float:
        """The way from chance to certainty, in [0, 1]."""
        return max(0.0, (self.best - self.chance) / (1 - self.chance)) if self.chance < 1 else 0.0

    @property
    def is_present(self) -> bool:
        """Whether either probe decodes the variable."""
        return self.best >= DECODED

    @property
    def is_absent(self) -> bool:
        """Whether neither probe finds a trace of it."""
        if self.measure == "R2":
            return self.best <= LEAK_R2
        return self.informed <= LEAK_ACCURACY


@dataclasses.dataclass(frozen=True)
class ProbeReport:
    """All that the probe measured; every number is a plain float, so that it can be written as JSON."""

    domain: str
    decodings: tuple[Decoding, ...]
    errors: dict[str, float]
    """Held out: `reward_r2`, and next-feature errors and CLUB (nats); empty without the networks of training."""
    geometry: dict[str, float]
    """`variance` Tr Var(z_s); `hidden_share` of it between values of the hidden variables; `rest`, how far z_s varies
    while they stay, as a fraction of its standard deviation: the size of a leak; `cosine` mean and `cosine_max` largest
    cosine between the mean z_s of two hidden values."""
    bonus: dict[str, float]
    """What an episode can earn on average, with weight 1 and by learning all, by form of the intrinsic reward."""
    p1_failures: tuple[str, ...]
    p2_failures: tuple[str, ...]

    @property
    def hidden(self) -> float:
        """How well z_s holds what is hidden, in [0, 1]: of the variable it holds worst."""
        return min((d.informed for d in self.decodings if d.hidden and d.source == "z_s"), default=0.0)

    @property
    def leak(self) -> float:
        """How well z_s gives away what can be seen anyway, in [0, 1]: of the variable it gives away best."""
        return max((d.informed for d in self.decodings if not d.hidden and d.source == "z_s"), default=0.0)

    @property
    def tested(self) -> bool:
        """Whether the environment declares variables, so that there is something to decode."""
        return bool(self.decodings)

    @property
    def p1(self) -> bool:
        """z_s and z_o together hold everything."""
        return self.tested and not self.p1_failures

    @property
    def p2(self) -> bool:
        """They hold different things."""
        return self.tested and not self.p2_failures

    def as_dict(self) -> dict[str, Any]:
        """For probe.json."""
        return dataclasses.asdict(self) | {"p1": self.p1, "p2": self.p2}


def probe(
    representation: Representation, env: Environment, config: Stage1Config, key: jax.Array,
    history: History | None = None
) -> ProbeReport:
    """Test a representation on `config.heldout_episodes` episodes like those of training, drawn with `key`.

    Where training moves copies by a symmetry, each of these episodes is moved by one.

    Args:
        representation: the encoders.
        env: where they were trained.
        config: for the number of episodes.
        key: not the key of training, whose episodes would come again.
        history: what training left, for the errors of the dynamics model; None leaves them out.
    """
    data_key, mlp_key = jax.random.split(key)
    data = collect(env, data_key, config.heldout_episodes, config.data, moved=config.copies > 0)
    return probe_on(data, representation, env, mlp_key, history)


def probe_on(
    data: Transitions, representation: Representation, env: Environment, key: jax.Array, history: History | None = None,
    networks: bool = True
) -> ProbeReport:
    """`probe` on transitions that were collected elsewhere; `key` draws the weights of the small networks.

    Without `networks` there are linear probes alone: quick, for a first look.
    """
    encoders = networks_for(env, representation.z_s_mean.shape[-1])
    all_z_s = encode_frames(encoders.phi, representation.phi, data.states)
    all_z_o = encode_frames(encoders.psi, representation.psi, data.observations)
    z_s, z_o = all_z_s[data.state], all_z_o[data.observation]
    decodings = _decodings(env.variables, data, np.asarray(z_s), np.asarray(z_o),
                            key if networks else None)
    errors = {} if history is None else _errors(
        env, history, data, z_s, z_o, all_z_s[data.next_state], all_z_o[data.next_observation])
    geometry, bonus = _geometry(env.variables, np.asarray(data.ground_truth), np.asarray(z_s, np.float64),
                                np.asarray(representation.z_s_mean, np.float64))
    p1, p2 = _verdicts(decodings, errors)
    return ProbeReport(env.name, decodings, errors, geometry, bonus, p1, p2)


def _decodings(
    variables: tuple[Variable, ...], data: Transitions, z_s: np.ndarray, z_o: np.ndarray,
    key: jax.Array | None
) -> tuple[Decoding, ...]:
    """Each variable from each source; of hidden ones, z_o counts only where it does not show them."""
    everywhere, unknown = np.ones(data.size, bool), ~np.asarray(data.reveals)
    hidden = tuple(i for i, v in enumerate(variables) if v.hidden)
    seen = tuple(i for i, v in enumerate(variables) if not v.hidden)
    both = np.concatenate([z_s, z_o], axis=1)
    jobs = (("z_s", z_s, everywhere, hidden + seen), ("z_o", z_o, unknown, hidden), ("z_o", z_o, everywhere, seen),
            ("both", both, everywhere, hidden + seen))
    truth, episode = np.asarray(data.ground_truth, np.float64), np.asarray(data.episode)
    result = []
    fitted = episode % 2 == 0
    for number, (source, z, rows, wanted) in enumerate(jobs):
        enough = (rows & fitted).any() and (rows & ~fitted).any()  # not where every observation shows what is hidden
        if wanted and enough:
            result += _decode(source, z[rows], truth[rows], fitted[rows], [variables[i] for i in wanted],
                              wanted, None if key is None else jax.random.fold_in(key, number))
    return tuple(sorted(result, key=lambda d: ([v.name for v in variables].index(d.variable), d.source)))


def _decode(
    source: str, z: np.ndarray, truth: np.ndarray, fitted: np.ndarray, variables: list[Variable],
    columns: tuple[int, ...], key: jax.Array | None
) -> list[Decoding]:
    """Linear and MLP probes of some variables from (N, F) features: fitted where (N,) `fitted`, scored elsewhere.

    Without a key the linear probe stands for both.
    """
    x = whiten(z, fitted)
    parts = [np.eye(v.num_values)[truth[:, i].astype(int)] if v.num_values else truth[:, i : i + 1]
             for v, i in zip(variables, columns, strict=True)]
    y = np.concatenate(parts, axis=1)
    center, scale = y[fitted].mean(0), y[fitted].std(0)
    y = (y - center) / np.where(scale > 0, scale, 1.0)
    linear = _fit_linear(x, y, fitted)
    guesses = {"linear": linear, "mlp": linear if key is None else _fit_mlp(x, y, fitted, key)}
    guesses = {name: guess * scale + center for name, guess in guesses.items()}
    bounds = np.cumsum([0, *(p.shape[1] for p in parts)])
    result = []
    for v, i, begin, end in zip(variables, columns, bounds[:-1], bounds[1:], strict=True):
        actual = truth[~fitted, i]
        scores = {name: _score(v, guess[~fitted, begin:end], actual) for name, guess in guesses.items()}
        chance = float(np.bincount(actual.astype(int)).max() / len(actual)) if v.num_values else 0.0
        result.append(Decoding(variable=v.name, source=source, hidden=v.hidden, chance=chance,
                               measure="accuracy" if v.num_values else "R2", **scores))
    return result


def whiten(z: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """(N, F) -> (N, K) float64 principal directions of variance 1 on `fitted` rows, those beyond round-off only."""
    z = z.astype(np.float64)
    center = z[fitted].mean(0)
    _, deviations, directions = np.linalg.svd((z[fitted] - center) / np.sqrt(fitted.sum()), full_matrices=False)
    keep = deviations > ROUND_OFF * np.sqrt(np.mean(np.sum(z[fitted] ** 2, axis=1)))
    return (z - center) @ directions[keep].T / deviations[keep]


def _fit_linear(x: np.ndarray, y: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """(N, W) predictions of ridge least squares."""
    gram = x[fitted].T @ x[fitted] + RIDGE * fitted.sum() * np.eye(x.shape[1])
    return x @ np.linalg.solve(gram, x[fitted].T @ y[fitted])


def _fit_mlp(x: np.ndarray, y: np.ndarray, fitted: np.ndarray, key: jax.Array) -> np.ndarray:
    """(N, W) predictions of a small network, fitted by least squares."""
    widths = (x.shape[1], MLP_WIDTH, MLP_WIDTH, y.shape[1])
    if x.shape[1] == 0:
        return np.zeros_like(y)
    weights = [(jax.random.normal(k, (i, o)) * np.sqrt(2 / i).astype(np.float32), jnp.zeros((1, o)))
               for k, i, o in zip(jax.random.split(key, 3), widths[:-1], widths[1:], strict=True)]
    # Grid worlds have few distinct rows.
    rows, inverse = np.unique(np.concatenate([x, y], axis=1), axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    weight = np.bincount(inverse, fitted / fitted.sum(), len(rows))
    known = weight > 0
    every, known_rows, known_weight = _padded(rows), _padded(rows[known]), _padded(weight[known])
    inputs = x.shape[1]
    guess = _train_mlp(weights, known_rows[:, :inputs], known_rows[:, inputs:], known_weight, every[:, :inputs])
    return np.asarray(guess, np.float64)[inverse]


def _padded(rows: np.ndarray) -> jax.Array:
    """float32, with zeros after the last row up to a power of two, which keeps the number of compilations small."""
    result = np.zeros((1 << max(5, int(len(rows) - 1).bit_length()), *rows.shape[1:]), np.float32)
    result[: len(rows)] = rows
    return jnp.asarray(result)


def _apply_mlp(weights: list[tuple[jax.Array, jax.Array]], x: jax.Array) -> jax.Array:
    for matrix, bias in weights[:-1]:
        x = jax.nn.relu(x @ matrix + bias)
    return x @ weights[-1][0] + weights[-1][1]


@jax.jit
def _train_mlp(
    weights: list[tuple[jax.Array, jax.Array]], x: jax.Array, y: jax.Array, weight: jax.Array, asked: jax.Array
) -> jax.Array:
    """(M, W) predictions for (M, F) `asked`, fitted to N rows of (N,) `weight`, which sum to 1."""
    parts = max(1, len(x) // MLP_BATCH)
    optimizer = optax.adam(optax.cosine_decay_schedule(MLP_STEP_SIZE, MLP_PASSES * parts))

    def step(carry: tuple, rows: jax.Array) -> tuple[tuple, None]:
        def loss(weights: list) -> jax.Array:
            return parts * weight[rows] @ jnp.sum(jnp.square(_apply_mlp(weights, x[rows]) - y[rows]), axis=1)

        weights, state = carry
        updates, state = optimizer.update(jax.grad(loss)(weights), state)
        return (optax.apply_updates(weights, updates), state), None

    def one_pass(carry: tuple, key: jax.Array) -> tuple[tuple, None]:
        return jax.lax.scan(step, carry, jax.random.permutation(key, len(x)).reshape(parts, -1))

    keys = jax.random.split(jax.random.key(0), MLP_PASSES)
    (weights, _), _ = jax.lax.scan(one_pass, (weights, optimizer.init(weights)), keys)
    return _apply_mlp(weights, asked)


def _score(variable: Variable, guess: np.ndarray, actual: np.ndarray) -> float:
    """Accuracy of (N, classes) scores, or R2 of an (N, 1) estimate, not below 0."""
    if variable.num_values:
        return float(np.mean(guess.argmax(1) == actual))
    total = np.sum((actual - actual.mean()) ** 2)
    return float(max(0.0, 1 - np.sum((guess[:, 0] - actual) ** 2) / total)) if total > 0 else 0.0


def _errors(
    env: Environment, history: History, data: Transitions, z_s: jax.Array, z_o: jax.Array, next_z_s: jax.Array,
    next_z_o: jax.Array
) -> dict[str, float]:
    """Of the dynamics model and of CLUB's estimator, on held-out transitions; errors in fractions of the variance."""
    networks = networks_for(env, z_s.shape[-1])
    reward, guess_s, guess_o = evaluate(
        networks.dynamics, history.dynamics, z_s, z_o, networks.encode_action(data.action))
    weight = jnp.full(data.size, 1 / data.size, jnp.float32)
    given, guessed = seen_by_estimator(history.estimator_view, z_s, z_o, weight)
    mean, log_variance = evaluate(networks.estimator, history.estimator, given)
    goes_on = ~np.asarray(data.terminal)

    def error(guess: jax.Array, actual: jax.Array, rows: np.ndarray) -> float:
        g, a = np.asarray(guess, np.float64)[rows], np.asarray(actual, np.float64)[rows]
        total = np.sum((a - a.mean(0)) ** 2)
        return float(np.sum((g - a) ** 2) / total) if total > 0 else 0.0

    return {
        "reward_r2": 1 - error(reward, data.reward, np.ones(data.size, bool)),
        "next_z_s_error": error(guess_s, next_z_s, goes_on),
        "next_z_o_error": error(guess_o, next_z_o, goes_on),
        "club": float(club_all_pairs(guessed, mean, log_variance, weight)[0]),
    }


def _geometry(
    variables: tuple[Variable, ...], truth: np.ndarray, z_s: np.ndarray, mean: np.ndarray
) -> tuple[dict[str, float], dict[str, float]]:
    """How z_s differs between hidden values, and what learning it can earn."""
    hidden = truth[:, [i for i, v in enumerate(variables) if v.hidden]]
    _, group = np.unique(hidden, axis=0, return_inverse=True)
    group = group.reshape(-1)
    count = np.bincount(group)
    centers = np.stack([np.bincount(group, z_s[:, f]) for f in range(z_s.shape[1])], axis=1) / count[:, None]
    variance = float(np.sum(z_s.var(0)))
    between = float(np.sum((count / len(group)) @ (centers - z_s.mean(0)) ** 2))
    unit = centers / np.maximum(np.linalg.norm(centers, axis=1, keepdims=True), 1e-12)
    cosines = (unit @ unit.T)[np.triu_indices(len(unit), 1)]
    lengths = np.linalg.norm(z_s, axis=1) * np.linalg.norm(mean)
    prior_cosine = np.mean(z_s @ mean / np.maximum(lengths, 1e-12))
    share = between / variance if variance > 0 else 0.0
    geometry = {"variance": variance, "hidden_share": share, "rest": float(np.sqrt(max(1 - share, 0.0))),
                "cosine": float(cosines.mean()) if len(cosines) else 1.0,
                "cosine_max": float(cosines.max()) if len(cosines) else 1.0}
    # Before information f predicts the mean, after it z_s itself. Explained variance sums to 1 times what the hidden
    # variables explain: the rest of z_s, if any, is seen without gathering information.
    told = jnp.asarray(centers, jnp.float32)
    sure = jnp.full(len(told), LEAST_LOG_VARIANCE)
    unsure = jnp.full(len(told), np.log(max(share, np.exp(LEAST_LOG_VARIANCE))))
    gained = log_likelihood_bonus(
        told, told, jnp.broadcast_to(jnp.asarray(z_s.mean(0), jnp.float32), told.shape), sure, unsure,
        max(variance, 1e-12))
    return geometry, {"cosine": float(1 - prior_cosine), "explained_variance": share,
                      "log_likelihood": float((count / len(group)) @ np.asarray(gained))}


def _verdicts(
    decodings: tuple[Decoding, ...], errors: dict[str, float]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Reasons why P1 and P2 fail."""
    p1 = [f"{d.variable} is not decoded from both ({d.measure} {d.best:.2f} < {DECODED})"
          for d in decodings if d.source == "both" and not d.is_present]
    if errors.get("reward_r2", 1.0) < REWARD_DECODED:
        p1.append(f"rewards are not predicted (R2 {errors['reward_r2']:.2f} < {REWARD_DECODED})")
    p2 = []
    for d in decodings:
        home = "z_s" if d.hidden else "z_o"
        if d.source == home and not d.is_present:
            p2.append(f"{d.variable} is not decoded from {home} ({d.measure} {d.best:.2f} < {DECODED})")
        elif d.source not in (home, "both") and not d.is_absent:
            p2.append(f"{d.variable} leaks into {d.source} ({d.measure} {d.best:.2f})")
    return tuple(p1), tuple(p2)


def format_report(report: ProbeReport) -> str:
    """A table for the terminal, with one line each for P1 and P2 at the end."""
    lines = [f"{report.domain}: decoded from features of held-out episodes, linear probe / small MLP",
             f"  {'':<14}{'':<10}" + "".join(f"{source:>17}" for source in ("z_s", "z_o", "both"))]
    for name in dict.fromkeys(d.variable for d in report.decodings):
        found = {d.source: d for d in report.decodings if d.variable == name}
        first = next(iter(found.values()))
        cells = (found.get(source) for source in ("z_s", "z_o", "both"))
        texts = "".join(f"{f'{d.linear:.3f} / {d.mlp:.3f}' if d else '-':>17}" for d in cells)
        kind = f"  chance {first.chance:.2f}" if first.measure == "accuracy" else ""
        lines.append(f"  {name:<14}{first.measure:<10}{texts}{kind}{'  (hidden)' if first.hidden else ''}")
    if report.errors:
        lines.append("  held out      " + ", ".join(f"{name} {value:.4g}" for name, value in report.errors.items()))
    lines.append("  z_s           " + ", ".join(f"{name} {value:.4g}" for name, value in report.geometry.items()))
    lines.append("  bonus/episode " + ", ".join(f"{name} {value:.3g}" for name, value in report.bonus.items()))
    if not report.tested:
        return "\n".join([*lines, "  P1 and P2 not tested: the environment declares no variables to decode"])
    for name, failures in (("P1", report.p1_failures), ("P2", report.p2_failures)):
        lines.append(f"  {name} {'fail: ' + '; '.join(failures) if failures else 'pass'}")
    return "\n".join(lines)

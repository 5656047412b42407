"""Greedy episodes, seen from inside: what the history explains of z_s, the bonus, the values, the attention.

Letters: N episodes, L = horizon + 1 tokens, A actions, F features, H attention heads.
"""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from envs_mjx.base import DiscreteActions, Environment, EnvState, TimeStep
from envs_mjx.grid import draw
from envs_mjx.grid.world import GridWorld
from mijax.figures import RING, STYLE
from mijax.learner import Learner, LearnerState
from mijax.losses import information as info
from mijax.nets.encoders import encoder_for
from mijax.results import AGENT_COLOURS
from mijax.types import Representation, Tokens

_INFORMATION = "#8cbef0"


@dataclasses.dataclass(frozen=True)
class Trace:
    """N greedy episodes; token t is what was known on arriving at step t. What follows an episode's end is meaningless.

    Without a representation there is no bonus and nothing to explain; without a transformer, no attention. The values
    of continuous actions are those of the actions taken, by the more cautious critic.
    """

    env_state: EnvState  # leaves (N, L, ...)
    observation: np.ndarray  # (N, L, *observation_shape)
    state: np.ndarray  # (N, L, *state_shape)
    truth: np.ndarray  # (N, L, V) float32, the environment's variables
    reward: np.ndarray  # (N, L) float32, the task's, on arriving
    reveals: np.ndarray  # (N, L) bool, whether the observation shows what is otherwise hidden
    length: np.ndarray  # (N,) int32, steps
    action: np.ndarray  # (N, L) int32, or of continuous actions (N, L, A) float32, taken after token t
    q: np.ndarray  # (N, L, A), or of continuous actions (N, L, 1)
    bonus: np.ndarray | None  # (N, L) with weight 1, on arriving; 0 at the start
    explained: np.ndarray | None  # (N, L) fraction of the variance of z_s that f(h_t) explains
    explained_by_agent: np.ndarray | None  # (N, L) the same of the memory branch (the auxiliary task)
    attention: np.ndarray | None  # (N, H, L, L) of the last block: token (row) looks at token (column)

    def peaks(self) -> np.ndarray:
        """(N,) int32: the step of each episode at which the bonus is largest."""
        assert self.bonus is not None
        steps = np.arange(self.bonus.shape[1])
        return np.where(steps <= self.length[:, None], self.bonus, -np.inf).argmax(1)

    def first_information(self) -> np.ndarray:
        """(N,) int32: the first step that reveals what is hidden; -1 if none does."""
        seen = self.reveals & (np.arange(self.reveals.shape[1]) <= self.length[:, None])
        return np.where(seen.any(1), seen.argmax(1), -1)

    def peaks_at_information(self) -> float:
        """Of the episodes that reveal something, the fraction whose bonus peaks the moment they first do; NaN: none."""
        informed = self.first_information()
        return float(np.mean((self.peaks() == informed)[informed >= 0])) if (informed >= 0).any() else float("nan")


def trace(learner: Learner, state: LearnerState, key: jax.Array, episodes: int) -> Trace:
    """Play greedily with the averaged network and look inside on the way."""
    return Trace(**jax.device_get(jax.jit(lambda state, key: _trace(learner, state, key, episodes))(state, key)))


def _trace(learner: Learner, state: LearnerState, key: jax.Array, num: int) -> dict[str, Any]:
    env, agent = learner.env, learner.agent
    key_reset, key_steps = jax.random.split(key)
    env_state, first = jax.vmap(env.reset)(jax.random.split(key_reset, num))

    def step(carry: tuple, key: jax.Array) -> tuple[tuple, tuple]:
        env_state, timestep, memory, previous = carry
        memory, action = agent.act(state.agent.target, memory, timestep.observation, previous)
        later, arrived = jax.vmap(env.step)(jax.random.split(key, num), env_state, action)
        return (later, arrived, memory, action), (env_state, timestep, previous, action)

    carry = env_state, first, agent.initial_memory(num), agent.no_action(num)
    (last_state, last, _, last_action), steps = jax.lax.scan(step, carry, jax.random.split(key_steps, env.horizon))
    ending = last_state, last, last_action, last_action
    whole = jax.tree.map(lambda a, b: jnp.moveaxis(jnp.concatenate([a, b[None]]), 0, 1), steps, ending)
    env_state, timestep, previous, action = cast(tuple[EnvState, TimeStep, jax.Array, jax.Array], whole)
    length = jnp.argmax(timestep.done, axis=1).astype(jnp.int32)
    tokens = _tokens(learner, state.representation, timestep, previous, length)
    tokens, q, predicted, attention = _look_inside(learner, state, tokens, action)
    return {
        "env_state": env_state, "observation": timestep.observation, "state": timestep.state,
        "truth": jax.vmap(jax.vmap(learner.domain.ground_truth))(env_state), "reward": timestep.reward,
        "reveals": jax.vmap(jax.vmap(env.reveals))(env_state), "length": length, "action": action, "q": q,
        "attention": attention,
    } | _information(learner, state, tokens, predicted)


def _look_inside(
    learner: Learner, state: LearnerState, tokens: Tokens, action: jax.Array
) -> tuple[Tokens, jax.Array, jax.Array | None, jax.Array | None]:
    """The tokens as f looks at them, and of whole episodes the values, the predicted z_s and the attention."""
    agent, variables = learner.agent, {"params": state.agent.target}
    if isinstance(learner.env.action_spec, DiscreteActions):
        outputs, seen = agent.network.apply(variables, tokens, mutable=["intermediates"])
        q, predicted = outputs.q, outputs.z_s
    else:
        tokens = agent.network.apply(variables, tokens, method="look")
        if agent.looks_once and state.representation is not None:  # the critics see phi's body of the state
            phi = encoder_for(learner.env.state_spec, learner.config.stage1.features)
            body = phi.apply({"params": state.representation.phi}, tokens.states, method="body")
            tokens = dataclasses.replace(tokens, states=body)
        encoded, seen = agent.network.apply(variables, tokens, method="encode", mutable=["intermediates"])
        taken = action.reshape(-1, action.shape[-1])
        values = agent.network.apply(variables, encoded.critic, taken, method="values")
        q = jnp.min(values, axis=0).reshape(*action.shape[:2], 1)
        predicted = encoded.heads[0].z_s if encoded.heads else None
    found = seen.get("intermediates", {})
    attention = jax.tree.leaves(found.get("actor", found))  # an actor's own memory, not its critics'
    return tokens, q, predicted, attention[-1] if attention else None


def _tokens(learner: Learner, representation: Representation | None, timestep: TimeStep, previous: jax.Array,
            length: jax.Array) -> Tokens:
    """One episode per row."""
    z_s, position = None, jnp.broadcast_to(jnp.arange(previous.shape[1])[None], previous.shape[:2])
    if representation is not None:
        phi = encoder_for(learner.env.state_spec, learner.config.stage1.features)
        z_s = cast(jax.Array, phi.apply({"params": representation.phi}, timestep.state))
    return Tokens(
        frames=timestep.observation.reshape(-1, *timestep.observation.shape[2:]), frame=None, z_s=z_s,
        previous_action=previous, reward=timestep.reward, terminated=timestep.terminated,
        truncated=timestep.truncated, segment=(position <= length[:, None]).astype(jnp.int32), position=position,
        states=timestep.state.reshape(-1, *timestep.state.shape[2:]))


def _information(
    learner: Learner, state: LearnerState, tokens: Tokens, predicted: jax.Array | None
) -> dict[str, jax.Array | None]:
    """The bonus, and what f and the agent explain of z_s. Of two models f, their mean."""
    representation, z_s = state.representation, tokens.z_s
    result: dict[str, jax.Array | None] = {"bonus": None, "explained": None, "explained_by_agent": None}
    if representation is None or z_s is None:
        return result

    def explained(guess: jax.Array) -> jax.Array:
        return 1 - jnp.sum(jnp.square(z_s - guess), axis=-1) / representation.z_s_variance

    if predicted is not None:
        result["explained_by_agent"] = explained(representation.destandardise(predicted))
    model = learner.agent.information_model
    if model is not None:
        guesses = [cast(jax.Array, model.apply({"params": params}, tokens)) for params in state.agent.params["f"]]
        f = representation.destandardise(sum(guesses[1:], guesses[0]) / len(guesses))
        f_t, f_tm1 = f[:, 1:], f[:, :-1]
        if learner.config.information.intrinsic_form == "cosine":
            bonus = info.cosine_bonus(z_s[:, 1:], f_t, f_tm1)
        else:
            bonus = info.explained_variance_bonus(z_s[:, 1:], f_t, f_tm1, representation.z_s_variance)
        result |= {"bonus": jnp.pad(bonus, ((0, 0), (1, 0))), "explained": explained(f)}
    return result


def draw_episode(trace: Trace, index: int, env: Environment, path: pathlib.Path, *, title: str = "",
                 weight: float = 1.0) -> None:
    """Draw one episode: its path, and over its steps the bonus, what is explained of z_s, the values, the attention.

    Args:
        trace: of several episodes.
        index: which of them.
        env: a grid world is drawn; of others only the steps are.
        path: of the PNG.
        title: printed above.
        weight: alpha, of the bonus in the total reward.
    """
    steps = np.arange(trace.length[index] + 1)
    peak = None if trace.bonus is None else int(trace.peaks()[index])
    series = [_draw_rewards, *([_draw_explained] if trace.bonus is not None else []), _draw_values]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(11, 0.6 + 2.1 * max(len(series), 3)), layout="constrained")
        left, right = np.ravel(figure.subfigures(1, 2, width_ratios=(1, 1.25), squeeze=False))
        squares = [_draw_path] if isinstance(env, GridWorld) else []
        squares += [_draw_attention] if trace.attention is not None else []
        for axis, draw in zip(np.ravel(left.subplots(max(len(squares), 1), 1)), squares, strict=False):
            draw(axis, trace, index, env, peak)
        if not squares:
            left.axes[0].set_axis_off()
        axes = np.ravel(right.subplots(len(series), 1, sharex=True))
        for axis, draw in zip(axes, series, strict=True):
            draw(axis, trace, index, env, weight)
            for step in steps[trace.reveals[index][steps]]:
                axis.axvspan(step - 0.5, step + 0.5, color=_INFORMATION, alpha=0.35, linewidth=0)
        if peak is not None:
            assert trace.bonus is not None
            axes[0].plot(peak, weight * trace.bonus[index, peak], **RING)
            axes[0].margins(y=0.15)
        axes[-1].set_xlabel("step (blue: the observation shows what is otherwise hidden)")
        axes[-1].set_xlim(-0.5, steps[-1] + 0.5)
        axes[-1].xaxis.set_major_locator(MaxNLocator(10, integer=True))
        figure.suptitle(title, fontsize=12, fontweight="bold", ha="left", x=0.01)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)


def draw_bonuses(episodes: Sequence[tuple[str, float, Trace, int]], path: pathlib.Path, *, title: str,
                 note: str = "") -> None:
    """Draw the intrinsic reward within one episode of each of some agents, side by side (paper Fig. 32).

    Args:
        episodes: of each panel its title, the weight of the bonus, a trace and which of its episodes.
        path: of the PNG.
        title: of the figure.
        note: printed under it.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(max(4.2, 0.8 + 3.4 * len(episodes)), 3.2), layout="constrained")
        for axis, (name, weight, seen, index) in zip(
                np.ravel(figure.subplots(1, len(episodes), squeeze=False)), episodes, strict=True):
            assert seen.bonus is not None
            steps = np.arange(seen.length[index] + 1)
            axis.plot(steps, weight * seen.bonus[index][steps], color=AGENT_COLOURS["mi"], marker=".")
            peak = int(seen.peaks()[index])
            axis.plot(peak, weight * seen.bonus[index, peak], **RING)
            for step in steps[seen.reveals[index][steps]]:
                axis.axvspan(step - 0.5, step + 0.5, color=_INFORMATION, alpha=0.35, linewidth=0)
            axis.margins(y=0.15)
            axis.set(title=name, xlabel="step (blue: information shown)", ylabel="intrinsic reward")
            axis.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        figure.suptitle(title, fontsize=12, fontweight="bold", ha="left", x=0.01)
        if note:
            figure.supxlabel(note, x=0.01, ha="left", fontsize=7.5, color="#666666")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)


def _draw_rewards(axis: Axes, trace: Trace, index: int, env: Environment, weight: float) -> None:
    del env
    steps = np.arange(trace.length[index] + 1)
    if trace.bonus is not None:
        axis.plot(steps, weight * trace.bonus[index][steps], color=AGENT_COLOURS["mi"], marker=".",
                  label=f"intrinsic (weight {weight:g})")
    axis.plot(steps, trace.reward[index][steps], color=AGENT_COLOURS["base"], marker=".", linewidth=1,
              label="of the task")
    axis.set_ylabel("reward")
    axis.legend(loc="best", fontsize=8)


def _draw_explained(axis: Axes, trace: Trace, index: int, env: Environment, weight: float) -> None:
    del env, weight
    steps = np.arange(trace.length[index] + 1)
    for values, name, line in ((trace.explained, "f, which pays the bonus", "-"),
                               (trace.explained_by_agent, "the agent's memory branch", (0, (3, 2)))):
        if values is not None:
            axis.plot(steps, values[index][steps], color=AGENT_COLOURS["mi"], linestyle=line, label=name)
    axis.axhline(1, color="#333333", linewidth=0.9, linestyle=(0, (4, 3)))
    axis.set_ylim(max(-1.6, axis.get_ylim()[0]), 1.1)
    axis.set_ylabel("$z_s$ explained")
    axis.legend(loc="best", fontsize=8)


def _draw_values(axis: Axes, trace: Trace, index: int, env: Environment, weight: float) -> None:
    del weight
    steps = np.arange(trace.length[index])
    q, colours = trace.q[index][steps], list(AGENT_COLOURS.values())
    names = getattr(env.action_spec, "names", ()) or tuple(map(str, range(q.shape[1])))
    for action, name in enumerate(names):
        axis.plot(steps, q[:, action], color=colours[action % len(colours)], linewidth=1.1, label=name)
    chosen = trace.action[index][steps]
    axis.scatter(steps, q[steps, chosen], c=[colours[a % len(colours)] for a in chosen], s=22, zorder=3)
    axis.set_ylabel("Q(h, a), dot: taken")
    axis.legend(loc="best", fontsize=8, ncols=2)


def _draw_path(axis: Axes, trace: Trace, index: int, env: Environment, peak: int | None) -> None:
    assert isinstance(env, GridWorld)
    rows, columns = env.tables.shape
    first = jax.tree.map(lambda x: x[index, 0], trace.env_state)
    axis.imshow(draw.background(env, first), extent=(-0.5, columns - 0.5, rows - 0.5, -0.5), interpolation="nearest")
    cells = trace.env_state.cell[index][: trace.length[index] + 1]
    # Each step a little beside the last, so that ways back do not hide ways forth.
    shift = np.linspace(-0.14, 0.14, len(cells))
    x, y = cells % columns + shift, cells // columns - shift
    axis.plot(x, y, color="#333333", linewidth=1, alpha=0.6)
    axis.scatter(x, y, c=np.arange(len(cells)), cmap="viridis", s=26, zorder=3, edgecolors="white", linewidths=0.5)
    axis.annotate("start", (x[0], y[0]), textcoords="offset points", xytext=(5, 6), fontsize=7.5)
    if peak is not None:
        axis.plot(x[peak], y[peak], **RING)
    axis.set_xticks([])
    axis.set_yticks([])
    axis.grid(False)
    axis.set_title("path, dark to light; blue: information, green: goal", color="#555555", fontsize=8)


def _draw_attention(axis: Axes, trace: Trace, index: int, env: Environment, peak: int | None) -> None:
    del env
    assert trace.attention is not None
    count = trace.length[index] + 1
    weights = trace.attention[index].mean(0)[:count, :count]
    image = axis.imshow(np.where(np.tril(np.ones_like(weights)) > 0, weights, np.nan), cmap="Blues", vmin=0,
                        interpolation="nearest", aspect="auto")
    axis.figure.colorbar(image, ax=axis, shrink=0.8)
    if peak is not None:
        axis.plot(peak, count - 1, **RING)
    axis.grid(False)
    axis.set_title("attention, mean over heads: where each step (row) looks", color="#555555", fontsize=8)
    axis.set_xlabel("step looked at")
    axis.set_ylabel("step")

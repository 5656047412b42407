"""Figures of greedy episodes seen from inside (paper Fig. 32): see `mijax.episode`."""

import pathlib
from collections.abc import Sequence

import jax
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from envs_mjx.base import Environment
from envs_mjx.grid import draw
from envs_mjx.grid.world import GridWorld
from mijax.episode import Trace
from mijax.figures import RING, STYLE
from mijax.results import AGENT_COLOURS

_INFORMATION = "#8cbef0"


def draw_episode(
    seen: Trace, index: int, env: Environment, path: pathlib.Path, *, title: str = "", weight: float = 1.0
) -> None:
    """Draw one episode: its path, and over its steps the bonus, what is explained of z_s, the values, the attention.

    Args:
        seen: several episodes.
        index: which of them.
        env: a grid world is drawn; of others only the steps are.
        path: of the PNG.
        title: printed above.
        weight: alpha, of the bonus in the total reward.
    """
    steps = np.arange(seen.length[index] + 1)
    peak = None if seen.bonus is None else int(seen.peaks()[index])
    series = [_draw_rewards, *([_draw_explained] if seen.bonus is not None else []), _draw_values]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(11, 0.6 + 2.1 * max(len(series), 3)), layout="constrained")
        left, right = np.ravel(figure.subfigures(1, 2, width_ratios=(1, 1.25), squeeze=False))
        squares = [_draw_path] if isinstance(env, GridWorld) else []
        squares += [_draw_attention] if seen.attention is not None else []
        for axis, panel in zip(np.ravel(left.subplots(max(len(squares), 1), 1)), squares, strict=False):
            panel(axis, seen, index, env, peak)
        if not squares:
            left.axes[0].set_axis_off()
        axes = np.ravel(right.subplots(len(series), 1, sharex=True))
        for axis, panel in zip(axes, series, strict=True):
            panel(axis, seen, index, env, weight)
            for step in steps[seen.reveals[index][steps]]:
                axis.axvspan(step - 0.5, step + 0.5, color=_INFORMATION, alpha=0.35, linewidth=0)
        if peak is not None:
            assert seen.bonus is not None
            axes[0].plot(peak, weight * seen.bonus[index, peak], **RING)
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


def _draw_rewards(axis: Axes, seen: Trace, index: int, env: Environment, weight: float) -> None:
    del env
    steps = np.arange(seen.length[index] + 1)
    if seen.bonus is not None:
        axis.plot(steps, weight * seen.bonus[index][steps], color=AGENT_COLOURS["mi"], marker=".",
                  label=f"intrinsic (weight {weight:g})")
    axis.plot(steps, seen.reward[index][steps], color=AGENT_COLOURS["base"], marker=".", linewidth=1,
              label="of the task")
    axis.set_ylabel("reward")
    axis.legend(loc="best", fontsize=8)


def _draw_explained(axis: Axes, seen: Trace, index: int, env: Environment, weight: float) -> None:
    del env, weight
    steps = np.arange(seen.length[index] + 1)
    for values, name, line in ((seen.explained, "f, which pays the bonus", "-"),
                               (seen.explained_by_agent, "the agent's memory branch", (0, (3, 2)))):
        if values is not None:
            axis.plot(steps, values[index][steps], color=AGENT_COLOURS["mi"], linestyle=line, label=name)
    axis.axhline(1, color="#333333", linewidth=0.9, linestyle=(0, (4, 3)))
    axis.set_ylim(max(-1.6, axis.get_ylim()[0]), 1.1)
    axis.set_ylabel("$z_s$ explained")
    axis.legend(loc="best", fontsize=8)


def _draw_values(axis: Axes, seen: Trace, index: int, env: Environment, weight: float) -> None:
    del weight
    steps = np.arange(seen.length[index])
    q, colours = seen.q[index][steps], list(AGENT_COLOURS.values())
    names = getattr(env.action_spec, "names", ()) or tuple(map(str, range(q.shape[1])))
    for action, name in enumerate(names):
        axis.plot(steps, q[:, action], color=colours[action % len(colours)], linewidth=1.1, label=name)
    chosen = seen.action[index][steps]
    axis.scatter(steps, q[steps, chosen], c=[colours[a % len(colours)] for a in chosen], s=22, zorder=3)
    axis.set_ylabel("Q(h, a), dot: taken")
    axis.legend(loc="best", fontsize=8, ncols=2)


def _draw_path(axis: Axes, seen: Trace, index: int, env: Environment, peak: int | None) -> None:
    assert isinstance(env, GridWorld)
    rows, columns = env.tables.shape
    first = jax.tree.map(lambda x: x[index, 0], seen.env_state)
    axis.imshow(draw.background(env, first), extent=(-0.5, columns - 0.5, rows - 0.5, -0.5), interpolation="nearest")
    cells = seen.env_state.cell[index][: seen.length[index] + 1]
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


def _draw_attention(axis: Axes, seen: Trace, index: int, env: Environment, peak: int | None) -> None:
    del env
    assert seen.attention is not None
    count = seen.length[index] + 1
    weights = seen.attention[index].mean(0)[:count, :count]
    image = axis.imshow(np.where(np.tril(np.ones_like(weights)) > 0, weights, np.nan), cmap="Blues", vmin=0,
                        interpolation="nearest", aspect="auto")
    axis.figure.colorbar(image, ax=axis, shrink=0.8)
    if peak is not None:
        axis.plot(peak, count - 1, **RING)
    axis.grid(False)
    axis.set_title("attention, mean over heads: where each step (row) looks", color="#555555", fontsize=8)
    axis.set_xlabel("step looked at")
    axis.set_ylabel("step")

"""brax's PPO with a privileged critic on one of our domains: one more asymmetric baseline, in a run folder like ours.

    pip install -e '.[robot]'
    python -m examples.brax_ppo --domain heaven_hell --steps 3000000 --seeds 3 --out runs/heaven_hell-ppo
    python -m mijax.report runs/heaven_hell-mi-gpt runs/heaven_hell-ppo

The policy is brax's network without memory, on a window of the last observations and actions; the critic sees the state
too. Greedy episodes are played and counted as our agents' are.
"""

import dataclasses
import functools
import importlib.metadata
import pathlib
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import tyro
from brax.training.agents.ppo import networks
from brax.training.agents.ppo import train as ppo

from envs_mjx.adapters.brax import POLICY_KEY, VALUE_KEY, AsBrax, on_recent_jax, wrap
from envs_mjx.base import DiscreteActions
from envs_mjx.contract import check_contract
from envs_mjx.grid.optimal import optimum
from mijax import report, runtime
from mijax.config import EvaluationConfig, parse_seeds, require
from mijax.progress import ProgressDisplay
from mijax.results import load, summarise
from mijax.rollout import evaluate
from mijax.run_folder import RunFolder
from mijax.seeds import evaluation_key
from mijax.train import FINAL_EPISODES, CompileClock


@dataclasses.dataclass(frozen=True)
class PPOOptions:
    """Train brax's PPO with a privileged critic on a domain."""

    domain: str = "heaven_hell"
    """A registered environment, or `package.module:EnvClass`."""
    steps: int = 3_000_000
    """Environment steps; rounded up to whole updates between evaluations."""
    seeds: str = "1"
    """How many seeds (5: seeds 0 to 4), or which ones (3,7; a single one with a comma: 3,)."""
    out: pathlib.Path | None = None
    """Run folder to make; default runs/DOMAIN-ppo."""
    history: int = 20
    """Observations that the policy sees, each with the action before it; 1: the present one alone."""
    critic: Literal["history_state", "state", "history"] = "history_state"
    """What the critic sees: the policy's input and the state, the state alone, which is biased, or, as in plain PPO,
    the policy's input alone."""
    num_envs: int = 32
    """Environments side by side."""
    unroll: int = 32
    """Steps in each of them between two rounds of updates."""
    minibatches: int = 4
    """Into which those steps are dealt."""
    epochs: int = 4
    """Passes over them."""
    learning_rate: float = 3e-4
    """Adam step size."""
    entropy_cost: float = 0.03
    """Weight of the policy's entropy. With 0.01, Heaven-Hell was still half solved after 2 000 000 steps (one seed):
    the policy asked, then went to one side only."""
    discount: float = 0.97
    """gamma of the learner, as our agents'."""
    hidden: tuple[int, ...] = (128, 128)
    """Hidden layers of the policy and of the critic."""
    evaluations: int = 50
    """Greedy evaluations, evenly spaced, after one at the start."""
    episodes: int = 20
    """Episodes of each."""

    def __post_init__(self) -> None:
        for name in ("steps", "history", "num_envs", "unroll", "minibatches", "epochs", "evaluations", "episodes"):
            require(getattr(self, name) >= 1, name.replace("_", "-"), getattr(self, name), "a number >= 1")
        require(self.num_envs % self.minibatches == 0, "num-envs", self.num_envs,
                f"a multiple of the {self.minibatches} minibatches")


@dataclasses.dataclass(frozen=True)
class Player:
    """brax's policy as what `mijax.rollout.evaluate` plays: greedy, its window of the episode in place of a memory."""

    env: AsBrax
    act_in_box: Callable[[Any, jax.Array], jax.Array]
    """From parameters and (B, history * width) to (B, action_size)."""

    def no_action(self, batch: int) -> jax.Array:
        """The previous action of episodes that have not started."""
        spec = self.env.env.action_spec
        return (jnp.full((batch,), -1, jnp.int32) if isinstance(spec, DiscreteActions)
                else jnp.zeros((batch, spec.size)))

    def initial_memory(self, batch: int) -> jax.Array:
        """(B, history, width) float32: nothing seen yet."""
        return jnp.broadcast_to(self.env.empty_window()[None], (batch, *self.env.empty_window().shape))

    def act(
        self, params: Any, memory: jax.Array, observation: jax.Array, previous_action: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """New memory and greedy actions."""
        window = jax.vmap(self.env.shift)(memory, observation, jax.vmap(self.env.encode)(previous_action))
        return window, self.env.to_action(self.act_in_box(params, window.reshape((len(window), -1))))

    def value(
        self, params: Any, memory: jax.Array, observation: jax.Array, previous_action: jax.Array
    ) -> jax.Array:
        """(B,) NaN: the critic needs the state, which a policy does not see."""
        del params, memory, previous_action
        return jnp.full((len(observation),), jnp.nan)


def train(options: PPOOptions, say: Callable[[str], None] = print) -> RunFolder:
    """Train every seed, one after the other; returns the run folder."""
    seeds = parse_seeds(options.seeds)
    env = AsBrax(options.domain, history=options.history,
                 critic="history_state" if options.critic == "history" else options.critic)
    check_contract(env.env)
    out = options.out or pathlib.Path("runs") / f"{options.domain.replace(':', '.')}-ppo"
    stored = {name: value for name, value in dataclasses.asdict(options).items() if name not in ("out", "seeds")}
    run = RunFolder.create(out, stored | {
        "agent": "ppo", "memory": f"window {options.history}", "seed_list": list(seeds),
        "brax": importlib.metadata.version("brax")})
    say(f"{run.path}: brax's PPO, critic of {options.critic}, on {env.env.name}, seeds {list(seeds)}")
    final = {seed: train_seed(options, env, run, seed) for seed in seeds}
    best = optimum(env.env, EvaluationConfig().discount)
    values = None if best is None else {
        "return": best.undiscounted_return, "discounted_return": best.discounted_return, "success": best.success,
        "length": best.length}
    run.write_summary(summarise(run, optimum=values, final=final))
    say(report.write_report(load([run.path]), run.path))
    return run


def train_seed(options: PPOOptions, env: AsBrax, run: RunFolder, seed: int) -> dict[str, float]:
    """Train one seed and write its metrics; returns the means of a last, longer evaluation."""
    factory = functools.partial(
        networks.make_ppo_networks, policy_hidden_layer_sizes=options.hidden, value_hidden_layer_sizes=options.hidden,
        policy_obs_key=POLICY_KEY, value_obs_key=POLICY_KEY if options.critic == "history" else VALUE_KEY)
    with on_recent_jax(), ProgressDisplay(f"ppo, seed {seed}", options.steps) as progress:
        diary = Diary(options, env, run, seed, progress)
        make_policy, params, _ = ppo.train(
            env, options.steps, wrap_env_fn=wrap,  # pyright: ignore[reportArgumentType]  (it is called with keywords)
            episode_length=env.episode_length, num_envs=options.num_envs, unroll_length=options.unroll,
            num_minibatches=options.minibatches, batch_size=options.num_envs // options.minibatches,
            num_updates_per_batch=options.epochs, learning_rate=options.learning_rate,
            entropy_cost=options.entropy_cost, discounting=options.discount, network_factory=factory, seed=seed,
            num_evals=options.evaluations + 1, run_evals=False, policy_params_fn=diary, max_devices_per_host=1)
    return diary.play(make_policy, params, FINAL_EPISODES, options.steps)


class Diary:
    """What brax calls before the first update and then evenly spaced: plays greedy episodes and writes a line."""

    def __init__(
        self, options: PPOOptions, env: AsBrax, run: RunFolder, seed: int, progress: ProgressDisplay,
    ) -> None:
        self._options, self._env, self._run, self._seed, self._progress = options, env, run, seed, progress
        self._programs: dict[int, Callable] = {}  # by number of episodes
        self._clock, self._since = CompileClock(), time.perf_counter()

    def __call__(self, step: int, make_policy: Callable, params: Any) -> None:
        """A line of metrics after `step` environment steps."""
        trained, compiled = time.perf_counter() - self._since, self._clock.lap()
        started = time.perf_counter()
        results = self.play(make_policy, params, self._options.episodes, step)
        evaluated, compiled_too = time.perf_counter() - started, self._clock.lap()
        self._run.append(self._seed, {
            "step": step, **{f"evaluation/{name}": value for name, value in results.items()},
            "wall/compile": compiled + compiled_too, "wall/training": max(trained - compiled, 0.0),
            "wall/evaluation": max(evaluated - compiled_too, 0.0)})
        shown = {name: results[name] for name in ("return", "success", "length")}
        self._progress.update(min(step, self._options.steps), shown)
        self._since = time.perf_counter()

    def play(self, make_policy: Callable, params: Any, episodes: int, step: int) -> dict[str, float]:
        """Means over greedy episodes, each number of them compiled once."""

        def in_box(params: Any, seen: jax.Array) -> jax.Array:
            return make_policy(params, deterministic=True)({POLICY_KEY: seen}, jax.random.PRNGKey(0))[0]

        if episodes not in self._programs:
            player, discount = Player(self._env, in_box), EvaluationConfig().discount
            self._programs[episodes] = jax.jit(lambda params, key: jax.tree.map(
                jnp.mean, evaluate(self._env.env, player, params, episodes, key, discount)))
        results = jax.device_get(self._programs[episodes](params, evaluation_key(self._seed, step)))
        return {name: float(value) for name, value in results.items() if name != "value"}


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    def work() -> None:
        options = tyro.cli(PPOOptions, args=arguments, prog="python -m examples.brax_ppo")
        runtime.prepare()
        train(options)

    return runtime.exit_code(work)


if __name__ == "__main__":
    sys.exit(main())

"""brax's PPO with a privileged critic on one of our domains: one more asymmetric baseline, in a run folder like ours.

    pip install 'mijax[robot]'
    python -m examples.brax_ppo --domain heaven_hell --steps 500000 --seeds 3 --out runs/heaven_hell-ppo
    python -m mijax.report runs/heaven_hell-mi-gpt runs/heaven_hell-ppo

The policy is brax's network without memory, on a window of the last observations and actions; the critic sees the state
too. Greedy episodes are played and counted as our agents' are.
"""

import dataclasses
import functools
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

from envs_mjx import registry
from envs_mjx.adapters.brax import POLICY_KEY, VALUE_KEY, AsBrax, on_recent_jax, wrap
from envs_mjx.base import DiscreteActions
from envs_mjx.grid.optimal import optimum
from mijax import report, runtime
from mijax.config import Config, ConfigError, EvaluationConfig, parse_seeds, require
from mijax.metrics import ProgressDisplay, RunError, RunFolder
from mijax.results import load, summarise
from mijax.rollout import evaluate
from mijax.seeds import evaluation_key
from mijax.train import FINAL_EPISODES, CompileClock


@dataclasses.dataclass(frozen=True)
class PPOOptions:
    """Train brax's PPO with a privileged critic on a domain."""

    domain: str = "heaven_hell"
    """A registered environment, or `package.module:EnvClass`."""
    steps: int = 500_000
    """Environment steps; rounded up to whole updates between evaluations."""
    seeds: str = "1"
    """How many seeds (5: seeds 0 to 4), or which ones (3,7; a single one with a comma: 3,)."""
    out: pathlib.Path | None = None
    """Run folder to make; default runs/DOMAIN-ppo."""
    history: int = 20
    """Observations that the policy sees, each with the action before it; 1: the present one alone."""
    critic: Literal["state", "history_state"] = "history_state"
    """What the critic sees: the state alone, which is biased, or the policy's input beside it."""
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
    entropy_cost: float = 1e-2
    """Weight of the policy's entropy."""
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
    config: Config
    copies: int = 0

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
    seeds, env = parse_seeds(options.seeds), AsBrax(options.domain, history=options.history, critic=options.critic)
    registry.check_contract(env.env)
    out = options.out or pathlib.Path("runs") / f"{options.domain.replace(':', '.')}-ppo"
    stored = dataclasses.asdict(options) | {"agent": "ppo", "memory": f"window {options.history}",
                                            "seed_list": list(seeds), "out": str(out)}
    run = RunFolder.create(out, stored)
    say(f"{run.path}: brax's PPO with a critic of {options.critic} on {env.env.name}, seeds {list(seeds)}")
    final = {seed: train_seed(options, env, run, seed) for seed in seeds}
    best = optimum(env.env, 0.99)
    values = None if best is None else {
        "return": best.undiscounted_return, "discounted_return": best.discounted_return, "success": best.success,
        "length": best.length}
    run.write_summary(summarise(run, optimum=values, final=final))
    say(report.write_report(load([run.path]), run.path))
    return run


def train_seed(options: PPOOptions, env: AsBrax, run: RunFolder, seed: int) -> dict[str, float]:
    """Train one seed and write its metrics; returns the means of the last evaluation."""
    config = Config(domain=options.domain, evaluation=EvaluationConfig(episodes=options.episodes))
    clock, last, final = CompileClock(), [time.perf_counter()], {}
    play: dict[int, Callable] = {}

    def play_greedily(step: int, make_policy: Callable, params: Any, episodes: int) -> dict[str, float]:
        def in_box(params: Any, seen: jax.Array) -> jax.Array:
            return make_policy(params, deterministic=True)({POLICY_KEY: seen}, jax.random.PRNGKey(0))[0]

        player = Player(env, in_box, config)
        if episodes not in play:
            play[episodes] = jax.jit(lambda params, key: jax.tree.map(
                jnp.mean, evaluate(env.env, player, params, episodes, key)))
        results = jax.device_get(play[episodes](params, evaluation_key(seed, step)))
        return {name: float(value) for name, value in results.items() if name != "value"}

    def after_epoch(step: int, make_policy: Callable, params: Any) -> None:
        """brax calls this before the first update, and then evenly spaced."""
        trained, compiled = time.perf_counter() - last[0], clock.lap()
        started = time.perf_counter()
        row = play_greedily(step, make_policy, params, options.episodes)
        evaluated, compiled_too = time.perf_counter() - started, clock.lap()
        run.append(seed, {
            "step": step, **{f"evaluation/{name}": value for name, value in row.items()},
            "wall/compile": compiled + compiled_too, "wall/training": max(trained - compiled, 0.0),
            "wall/evaluation": max(evaluated - compiled_too, 0.0)})
        progress.update(min(step, options.steps), {name: row[name] for name in ("return", "success", "length")})
        if step >= options.steps:
            final.update(play_greedily(step, make_policy, params, FINAL_EPISODES))
        last[0] = time.perf_counter()
        clock.lap()

    factory = functools.partial(
        networks.make_ppo_networks, policy_hidden_layer_sizes=options.hidden, value_hidden_layer_sizes=options.hidden,
        policy_obs_key=POLICY_KEY, value_obs_key=VALUE_KEY)
    with on_recent_jax(), ProgressDisplay(f"ppo, seed {seed}", options.steps) as progress:
        ppo.train(
            env, options.steps, wrap_env_fn=wrap,  # pyright: ignore[reportArgumentType]  (it is called with keywords)
            episode_length=env.episode_length, num_envs=options.num_envs,
            unroll_length=options.unroll, num_minibatches=options.minibatches,
            batch_size=options.num_envs // options.minibatches, num_updates_per_batch=options.epochs,
            learning_rate=options.learning_rate, entropy_cost=options.entropy_cost, discounting=options.discount,
            network_factory=factory, seed=seed, num_evals=options.evaluations + 1, run_evals=False,
            policy_params_fn=after_epoch, max_devices_per_host=1)
    return final


def main(arguments: Sequence[str] | None = None) -> int:
    """The command."""
    try:
        options = tyro.cli(PPOOptions, args=arguments, prog="python -m examples.brax_ppo")
        runtime.prepare()
        train(options)
    except (ConfigError, RunError, registry.UnknownDomain, registry.ContractError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

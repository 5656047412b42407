"""The jitted loop: environment steps and gradient updates in a static schedule.

`init(key)` makes the whole state of one seed and `run_chunk(state)` advances it by a fixed number of iterations. One
iteration is always the same work: K steps in each of E environments, then updates_per_step * E * K updates. Seeds,
devices, checkpoints and logging are wrapped around these two functions.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
from flax import struct
from jax.typing import DTypeLike

from envs_mjx.base import DiscreteActions, Environment, EnvState, TimeStep, shows_again
from mijax.agents.core import Agent, AgentState
from mijax.agents.factory import make_agent
from mijax.agents.state_shown import StateShown
from mijax.agents.variants import variant
from mijax.augmentation import draw_copies, show_copy, show_tokens
from mijax.config import Config
from mijax.frames import FrameTable
from mijax.nets.actor_critic import without_blank
from mijax.nets.encoders import encoder_for
from mijax.packing import Layout, fit_folds, gather_rows, one_per_row, row_choices, stack_folds
from mijax.replay import Replay, StepRecord, fill, init_replay, returns_of, sample_episodes, write
from mijax.representation.dataset import random_episodes
from mijax.rollout import (
    Actor,
    Episodes,
    EpisodeTotals,
    Recorder,
    collect_step,
    draw_symmetry,
    evaluate,
    start_episodes,
)
from mijax.types import Metrics, Representation, Tokens

MOMENTS_AT_ONCE = 17
"""Of a demonstration, that are shown and encoded in all copies at once: a third of a robot's episode. A whole one took
0.4 GiB more, when a run held most."""


@struct.dataclass
class LearnerState:
    """Everything of one seed: saved and restored, it continues bit for bit."""

    agent: AgentState
    representation: Representation | None
    episodes: Episodes
    replay: Replay
    key: jax.Array  # typed PRNG key; every iteration folds its number into it
    iteration: jax.Array  # () int32, the next one; below 0 before the end of pre-training


@dataclasses.dataclass(frozen=True)
class Learner:
    """One agent on one environment."""

    domain: Environment
    env: Environment  # what the agent acts in: the domain, or the domain with its state shown
    config: Config
    agent: Agent
    observations: FrameTable | None  # all that the environment can show; the replay then stores which, not what
    moments: bool = False  # whether the replay stores moments, which are shown again when they are sampled
    pack: bool = True  # choose the number of packed rows at run time; a branch that `vmap` would turn into all of them

    def init(self, key: jax.Array, representation: Representation | None) -> LearnerState:
        """Fresh networks, and a replay of demonstrations, of stage 1's random episodes, or of new ones."""
        key_agent, key_start, key_warmup, key_run = jax.random.split(key, 4)
        num_envs = self.config.num_envs
        episodes = start_episodes(self.env, self.agent, num_envs, key_start, self.agent.copies > 0)
        first = self._first(representation, episodes)
        capacity = max(num_envs + self.demonstrations, self.agent.options.replay_steps // self.env.horizon)
        replay = init_replay(first, capacity, self.env.horizon, kept=self.demonstrations)
        if self.demonstrations:
            replay = self._demonstrate(replay, representation, jax.random.fold_in(key, 4))
        if self.remembers:
            replay = self._remember(replay, representation)
        state = LearnerState(
            agent=self.agent.init(key_agent, representation),
            representation=representation,
            episodes=episodes,
            replay=write(replay, first, episodes.position),
            key=key_run,
            iteration=jnp.full((), -self.pretrain_iterations, jnp.int32),
        )
        if self.agent.declaration.believes:
            state = dataclasses.replace(state, agent=self._believe(state, jax.random.fold_in(key, 5)))
        if not self.warmup_steps:
            return state
        return self._collect(state, jnp.ones(()), jax.random.split(key_warmup, self.warmup_steps // num_envs))[0]

    def _first(self, representation: Representation | None, episodes: Episodes) -> StepRecord:
        """What the replay stores of where episodes stand."""
        return self.recorder(representation)(
            episodes.timestep, episodes.previous_action, episodes.env_state, episodes.symmetry)

    def _demonstrate(self, replay: Replay, representation: Representation | None, key: jax.Array) -> Replay:
        """The replay with the successful episodes of an expert, some of them twice if it fails at times; if it always
        fails, with episodes of length 0 (see `has_demonstrations`)."""
        key_episodes, key_symmetry = jax.random.split(key)
        shown = self.env.demonstrations(key_episodes, self.demonstrations)
        assert shown is not None
        intended = shown.action if shown.intended is None else shown.intended
        records = self._record_episodes(representation, key_symmetry, shown.env_state, None, shown.action, intended)
        order = jnp.argsort(~shown.success, stable=True)
        order = order[jnp.arange(self.demonstrations) % jnp.maximum(jnp.sum(shown.success), 1)]
        records, length = jax.tree.map(lambda x: x[order], (records, shown.length))
        return fill(replay, records, jnp.where(jnp.any(shown.success), length + 1, 0))

    def _remember(self, replay: Replay, representation: Representation | None) -> Replay:
        """The replay with the random episodes that stage 1 learnt from."""
        assert representation is not None
        key = jax.random.wrap_key_data(representation.data_key)
        episodes = random_episodes(self.env, key, self.config.stage1.episodes)
        kept = min(self.config.stage1.episodes, replay.capacity)
        episodes = jax.tree.map(lambda x: x[:kept], episodes)
        records = self._record_episodes(
            representation, key, episodes.env_state, episodes.timestep, episodes.action, episodes.action)
        return fill(replay, records, episodes.length + 1)

    def _record_episodes(
        self, representation: Representation | None, key: jax.Array, env_state: EnvState, timestep: TimeStep | None,
        action: jax.Array, intended: jax.Array
    ) -> StepRecord:
        """What the replay stores of N whole episodes, (N, T + 1, ...), from their N T actions, those that were meant,
        and their moments; `timestep`: what these showed, None where they are to be shown again."""
        record, none = self.recorder(representation), self.agent.no_action(1)

        def store(episode: tuple) -> StepRecord:
            env_state, timestep, *actions, symmetry = episode
            previous, intended = (jnp.concatenate([none, action.astype(none.dtype)]) for action in actions)
            symmetry = jnp.broadcast_to(symmetry[None], (previous.shape[0], 2)) if self.agent.copies else None
            return jax.lax.map(one, (env_state, timestep, previous, symmetry, intended), batch_size=MOMENTS_AT_ONCE)

        def one(moment: tuple) -> StepRecord:
            env_state, timestep, previous, symmetry, intended = jax.tree.map(lambda x: x[None], moment)
            shown = jax.vmap(self.env.show)(env_state) if timestep is None else timestep
            return jax.tree.map(lambda x: x[0], record(shown, previous, env_state, symmetry, intended))

        return jax.lax.map(store, (env_state, timestep, action, intended, draw_symmetry(key, action.shape[0])))

    def has_demonstrations(self, state: LearnerState) -> bool:
        """Whether those that a fresh state should have in its replay are there."""
        kept = state.replay.length[self.config.num_envs :][: self.demonstrations]
        return bool(jnp.all(kept > 0))

    def _believe(self, state: LearnerState, key: jax.Array) -> AgentState:
        """Fit Believer's history VAE (paper Appendix A.5, Stage 2) to what stage 1 learns from, as the paper's agents
        have the same data (5.1): the demonstrations, or as many random episodes."""
        replay = state.replay
        demonstrated = self.demonstrations > 0 and self.config.stage1.data == "demonstrations"
        if not (demonstrated or self.remembers):
            replay = self._remember(jax.tree.map(jnp.zeros_like, replay), state.representation)

        def update(agent: AgentState, key: jax.Array) -> tuple[AgentState, None]:
            return self.update(agent, replay, state.representation, key, fits_belief=True)[0], None

        agent, _ = jax.lax.scan(update, state.agent, jax.random.split(key, self.config.believer.updates))
        return dataclasses.replace(agent, optimizer=self.agent.optimizer.init(agent.params))

    @property
    def warmup_steps(self) -> int:
        """Random environment steps before the first update: at least `warmup_episodes` full-length episodes."""
        if self.remembers:
            return 0
        rounds = -(-self.agent.options.warmup_episodes // self.config.num_envs)
        return rounds * self.config.num_envs * self.env.horizon

    @property
    def remembers(self) -> bool:
        """Whether the replay starts with the random episodes of stage 1."""
        return self.agent.group == "dqn" and self.agent.pretrain_updates > 0

    @property
    def demonstrations(self) -> int:
        """Episodes of an expert in the replay from the start."""
        return self.config.sac.demonstrations if self.agent.group == "sac" else 0

    @property
    def imitates(self) -> bool:
        """Whether demonstrations are imitated."""
        return self.demonstrations > 0 and self.config.sac.imitation_weight > 0

    @property
    def updates_per_iteration(self) -> int:
        """Gradient updates of one iteration."""
        return self.config.updates_per_iteration(self.agent.group, self.agent.options.updates_per_step)

    @property
    def pretrain_iterations(self) -> int:
        """Iterations of updates alone, before the first step: as many as hold the agent's `pretrain_updates`."""
        return -(-self.agent.pretrain_updates // self.updates_per_iteration)

    @property
    def iterations_per_chunk(self) -> int:
        """Iterations between two evaluations."""
        return self.config.evaluation.every // self.config.iteration_steps

    def environment_steps(self, state: LearnerState) -> jax.Array:
        """() int32: environment steps so far, the warm-up included."""
        return self.warmup_steps + jnp.maximum(state.iteration, 0) * self.config.iteration_steps

    def epsilon(self, environment_steps: jax.Array) -> jax.Array:
        """() exploration after so many steps."""
        return self.agent.epsilon(environment_steps)

    def run_chunk(
        self, state: LearnerState, iterations: jax.Array | int | None = None, acts: jax.Array | bool = True
    ) -> tuple[LearnerState, Metrics]:
        """Advance by `iterations`; metrics are means over them.

        Args:
            state: of one seed.
            iterations: () int32, at least 1; default: up to the next evaluation.
            acts: () bool, whether the environments are stepped: not in pre-training. Both may be traced, so that one
                compiled program serves all; under `vmap` they are not to be mapped, as every branch would then run.
        """
        iterations = self.iterations_per_chunk if iterations is None else iterations
        steps = jnp.where(acts, self.config.steps_per_iteration, 0)

        def iterate(_: jax.Array, carry: tuple) -> tuple[LearnerState, EpisodeTotals, Metrics]:
            state, totals, losses = carry
            key_collect, key_update = jax.random.split(jax.random.fold_in(state.key, state.iteration))
            epsilon = self.epsilon(self.environment_steps(state))
            keys = jax.random.split(key_collect, self.config.steps_per_iteration)
            state, added = self._collect(state, epsilon, keys, steps)
            state, metrics = self._learn(state, key_update)
            state = dataclasses.replace(state, iteration=state.iteration + 1)
            return state, *jax.tree.map(jnp.add, (totals, losses), (added, metrics))

        losses = jax.tree.map(
            lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(self._learn, state, state.key)[1])
        state, totals, losses = jax.lax.fori_loop(0, iterations, iterate, (state, EpisodeTotals.zero(), losses))
        metrics = jax.tree.map(lambda x: x / iterations, losses) | totals.metrics()
        return state, metrics | {"train/epsilon": self.epsilon(self.environment_steps(state))}

    def collect_chunk(self, state: LearnerState) -> tuple[EpisodeTotals, Replay]:
        """The environment steps of one chunk without its updates: what acting, stepping and storing cost."""
        keys = jax.random.split(state.key, self.iterations_per_chunk * self.config.steps_per_iteration)
        state, totals = self._collect(state, self.epsilon(self.environment_steps(state)), keys)
        return totals, state.replay

    def evaluate(self, state: LearnerState, key: jax.Array, num_episodes: int, actor: Actor | None = None) -> Metrics:
        """Greedy episodes of the averaged network: per-episode results, each (num_episodes,); `actor`: played by
        another than the agent."""
        discount = self.config.evaluation.discount
        return evaluate(self.env, actor or self.agent, state.agent.target, num_episodes, key, discount)

    def recorder(self, representation: Representation | None) -> Recorder:
        """What the replay stores, z_s among it when there is a representation."""
        phi = encoder_for(self.env.state_spec, self.config.stage1.features)
        psi = encoder_for(self.env.observation_spec, self.config.stage1.features)
        spec, copies = self.env.action_spec, self.agent.copies
        action_type = _integer_for(spec.num) if isinstance(spec, DiscreteActions) else jnp.float32
        table, declaration = self.observations, self.agent.declaration

        def in_copies(
            timestep: TimeStep, actions: Any, env_state: EnvState, symmetry: jax.Array | None
        ) -> tuple[TimeStep, Any]:
            """What every copy shows, and the actions there: (E, 1 + copies, ...) each, where there are copies."""
            if symmetry is None:
                return timestep, actions
            moved = jax.vmap(jax.vmap(functools.partial(show_copy, self.env), (None, 0, None, None)), (0, None, 0, 0))
            return moved(symmetry, jnp.arange(copies + 1, dtype=jnp.int32), env_state, actions)

        def record(
            timestep: TimeStep, previous_action: jax.Array, env_state: EnvState = None,
            symmetry: jax.Array | None = None, intended: jax.Array | None = None,
        ) -> StepRecord:
            intended = (previous_action if intended is None else intended) if self.imitates else None
            z_s, observation, state = None, env_state if self.moments else timestep.observation, timestep.state
            if representation is not None and not declaration.sees_state:
                copied, actions = in_copies(timestep, (previous_action, intended), env_state, symmetry)
                if declaration.uses_representation:
                    z_s = cast(jax.Array, phi.apply({"params": representation.phi}, copied.state))
                if self.agent.looks_once:
                    seen = without_blank(copied.observation, self.env.observation_spec)
                    outlet = None if self.config.sac.trunk == "z_o" else "body"
                    observation, state = (
                        cast(jax.Array, encoder.apply({"params": params}, x, method=method)).astype(jnp.float16)
                        for encoder, params, x, method in ((psi, representation.psi, seen, outlet),
                                                           (phi, representation.phi, copied.state, "body")))
                    previous_action, intended = actions
            if table is not None:
                observation = table.index_of(timestep.observation).astype(_integer_for(len(table)))
            return StepRecord(
                observation=observation,
                previous_action=previous_action.astype(action_type),
                reward=timestep.reward,
                terminated=timestep.terminated,
                truncated=timestep.truncated,
                z_s=z_s,
                state=None if declaration.critic is None or self.moments else state,
                intended=intended,
                symmetry=symmetry,
            )

        return record

    def _collect(
        self, state: LearnerState, epsilon: jax.Array, keys: jax.Array, steps: jax.Array | None = None
    ) -> tuple[LearnerState, EpisodeTotals]:
        """One step in every environment for each of (K,) keys, or for the first `steps` of them, () int32."""
        record = self.recorder(state.representation)
        params = state.agent.params["agent"]

        def step(number: jax.Array, carry: tuple[Episodes, Replay, EpisodeTotals]) -> tuple:
            return collect_step(self.env, self.agent, params, record, epsilon, *carry, keys[number])

        carry = (state.episodes, state.replay, EpisodeTotals.zero())
        episodes, replay, totals = jax.lax.fori_loop(0, len(keys) if steps is None else steps, step, carry)
        return dataclasses.replace(state, episodes=episodes, replay=replay), totals

    def _learn(self, state: LearnerState, key: jax.Array) -> tuple[LearnerState, Metrics]:
        """The updates of one iteration."""
        def update(agent: AgentState, key: jax.Array) -> tuple[AgentState, Metrics]:
            return self.update(agent, state.replay, state.representation, key)

        agent, metrics = jax.lax.scan(update, state.agent, jax.random.split(key, self.updates_per_iteration))
        return dataclasses.replace(state, agent=agent), jax.tree.map(jnp.mean, metrics)

    def update(
        self, agent: AgentState, replay: Replay, representation: Representation | None, key: jax.Array,
        fits_belief: bool = False,
    ) -> tuple[AgentState, Metrics]:
        """One gradient update on a batch of episodes, packed into as few rows as they need; `fits_belief`: of
        Believer's history model alone.
        """
        apply: Callable = self.agent.fit_belief if fits_belief else self.agent.update
        batch = self.agent.options.batch_episodes
        key_sample, key_loss = jax.random.split(key)
        share = self.config.sac.demonstration_share if self.demonstrations else 0.0
        slots = sample_episodes(replay, key_sample, batch, share)
        if not self.pack:
            return apply(agent, self._read(replay, slots, one_per_row(batch), batch, key), representation, key_loss)
        layout = fit_folds(replay.length[slots], replay.data.reward.shape[1])
        choices = row_choices(batch // 2)

        def with_rows(rows: int) -> tuple[AgentState, Metrics]:
            tokens = self._read(replay, slots, stack_folds(layout, rows), 2 * rows, key)
            return apply(agent, tokens, representation, key_loss)

        branch = jnp.searchsorted(jnp.asarray(choices), layout.num_rows)
        return jax.lax.switch(branch, [functools.partial(with_rows, rows) for rows in choices])

    def _read(self, replay: Replay, slots: jax.Array, layout: Layout, rows: int, key: jax.Array) -> Tokens:
        """(B,) episodes in so many rows, shown again where the replay stores moments."""
        copies = self.agent.copies
        copy = draw_copies(copies, slots.shape[0], jax.random.fold_in(key, 2)) if copies else None
        tokens = gather_rows(replay, slots, layout, rows, self.observations, copy if self.agent.looks_once else None)
        if self.imitates:
            episode = jnp.maximum(tokens.segment - 1, 0)
            expert = (slots >= self.config.num_envs) & (slots < self.config.num_envs + self.demonstrations)
            tokens = dataclasses.replace(tokens, demonstrated=expert[episode])
            if self.config.sac.imitate_successes:
                enough = jnp.median(returns_of(replay, replay.finished[: self.demonstrations]))
                succeeded = returns_of(replay, slots) >= enough
                tokens = dataclasses.replace(tokens, succeeded=succeeded[episode])
        if self.moments:
            return show_tokens(self.env, tokens, copy, self.agent.declaration.critic is not None)
        return tokens


def make_learner(env: Environment, config: Config, pack: bool = True) -> Learner:
    """The learner that a configuration describes."""
    domain, env = env, StateShown(env) if variant(config.agent).sees_state else env
    agent, listed = make_agent(env, config), env.all_observations()
    table = None if listed is None or agent.looks_once else FrameTable(listed)
    moments = table is None and not agent.looks_once and shows_again(domain)
    return Learner(domain, env, config, agent, table, moments, pack)


def _integer_for(count: int) -> DTypeLike:
    """The smallest type that holds -1 and 0 .. count - 1."""
    return next(kind for kind in (jnp.int8, jnp.int16, jnp.int32) if count - 1 <= jnp.iinfo(kind).max)

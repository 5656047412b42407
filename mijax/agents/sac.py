"""Soft actor-critic over whole episodes with memory-based actor and critics (paper Section 3.2, Appendix A)."""

import dataclasses
from collections.abc import Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import optax

from envs_mjx.base import ArraySpec, ContinuousActions, Environment
from mijax.agents.core import (
    Agent,
    Heads,
    adam,
    episode_mean,
    make_information_model,
    may_follow,
    transitions,
)
from mijax.agents.variants import Variant, memory_of, variant
from mijax.config import Config, SACConfig
from mijax.losses import sac
from mijax.losses.returns import traced_returns
from mijax.nets.actor_critic import (
    ActorCritic,
    BeliefActorCritic,
    Encoded,
    PrivilegedActorCritic,
    TwoBranchActorCritic,
)
from mijax.nets.belief import BeliefBranches, BeliefReader
from mijax.nets.encoders import encoder_for
from mijax.nets.privileged import PrivilegedFeatures
from mijax.nets.two_branch import HistoryEncoder, MemoryState, TwoBranch
from mijax.types import Metrics, Params, Representation, Tokens


@dataclasses.dataclass(frozen=True)
class SAC(Agent):
    """Acts on a Gaussian over the history, squashed by tanh; draws from it while it learns."""

    network: ActorCritic

    @property
    def options(self) -> SACConfig:
        """The group `sac`."""
        return self.config.sac

    @property
    def group(self) -> str:
        """sac"""
        return "sac"

    @property
    def copies(self) -> int:
        """As many as the configuration says."""
        return self.options.rotated_copies

    @property
    def pretrain_updates(self) -> int:
        """On the demonstrations, where there are any."""
        return self.options.pretrain_updates if self.options.demonstrations else 0

    @property
    def looks_once(self) -> bool:
        """Where psi, or its body, is the trunk and stays as it is."""
        return self.options.looks_through_psi and not self.declaration.sees_state

    @property
    def target_entropy(self) -> float:
        """In nats, of all dimensions."""
        return self.options.target_entropy * self.network.action_size

    def imitation_fade(self, updates: jax.Array) -> jax.Array:
        """() share of its weight that imitation has after so many updates."""
        options = self.options
        over = max(1, round(options.imitation_until * options.updates_in(self.config.steps)))
        fade = optax.linear_schedule(1.0, options.imitation_final, over)
        return jnp.asarray(fade(updates), jnp.float32)

    def further_parameters(self) -> dict[str, Params]:
        """The temperature."""
        return {"log_temperature": jnp.log(jnp.float32(self.options.initial_temperature))}

    def start_from(self, agent: Params, representation: Representation) -> Params:
        """psi in every memoryless branch: its body in the trunk and its output layer in each branch, or all of it. On a
        trunk that is psi as a whole, the layer of each branch begins as the identity."""
        if self.declaration.sees_state:
            if self.config.mdp.sees != "state":
                return agent | {"features": {"phi": representation.phi, "psi": representation.psi}}
            return agent
        from_psi = self.declaration.uses_representation and self.config.information.start_from_psi
        psi, bottom, started = dict(representation.psi), representation.psi, {}
        if self.options.trunk == "z_o":
            features = self.config.stage1.features
            bottom = {"kernel": jnp.eye(features), "bias": jnp.zeros((features,))}
        elif "trunk" in agent:
            bottom = psi.pop("output")
        if from_psi:
            branches = (name for name in ("actor", "critic", "history") if name in agent)
            started = {name: agent[name] | {"bottom": bottom} for name in branches}
        if "trunk" in agent and (from_psi or self.looks_once):
            started["trunk"] = psi
        return agent | started

    def example_tokens(self) -> Tokens:
        """One token of zeros; its state is what the critics see of it."""
        tokens = super().example_tokens()
        if not self.looks_once:
            return tokens
        return dataclasses.replace(tokens, states=jnp.zeros((1, *_body_spec(self.env.state_spec).shape)))

    def example_of_f(self, agent: Params) -> Tokens:
        """A token of zeros after the trunk: f looks through it too, but does not train it."""
        return self._look(agent, self.example_tokens())

    def epsilon(self, environment_steps: jax.Array) -> jax.Array:
        """() 0: the actor explores by itself."""
        return jnp.zeros_like(environment_steps, jnp.float32)

    def act(
        self, params: Params, memory: MemoryState, observation: jax.Array, previous_action: jax.Array
    ) -> tuple[MemoryState, jax.Array]:
        """tanh of the mean: actions of (B,) episodes after one more observation; the state is no argument.

        Args:
            params: parameters of the actor and the critics.
            memory: what the episodes remember.
            observation: (B, *observation_shape).
            previous_action: (B, A) float32, zeros at the start of an episode.

        Returns:
            The new memory and (B, A) float32 actions in [-1, 1].
        """
        memory, mean, _ = self._call("step", params, memory, observation, previous_action)
        return memory, jnp.tanh(mean)

    def value(
        self, params: Params, memory: MemoryState, observation: jax.Array, previous_action: jax.Array
    ) -> jax.Array:
        """(B,) min_i Q_i(h, mean action) of episodes at their first observation; NaN where the critics want the state.

        The memory is the actor's, so later values would need the whole episode.
        """
        del memory
        batch = observation.shape[0]
        if self.declaration.critic is not None:
            return jnp.full((batch,), jnp.nan)
        zeros = jnp.zeros((batch, 1), jnp.int32)
        tokens = Tokens(
            frames=observation, frame=None, previous_action=previous_action[:, None], reward=zeros.astype(jnp.float32),
            terminated=zeros > 0, truncated=zeros > 0, segment=zeros + 1, position=zeros, z_s=None)
        encoded: Encoded = self._encode(params, self._look(params, tokens))
        mean, _ = self._call("policy", params, encoded.actor)
        return jnp.min(self._call("values", params, encoded.critic, jnp.tanh(mean)), axis=0)

    def explore(
        self, params: Params, memory: MemoryState, observation: jax.Array, previous_action: jax.Array,
        epsilon: jax.Array, key: jax.Array,
    ) -> tuple[MemoryState, jax.Array]:
        """A draw from the actor, or its mean in the greedy environments, which are the first; uniform in [-1, 1] with
        probability `epsilon` (the warm-up)."""
        memory, mean, log_scale = self._call("step", params, memory, observation, previous_action)
        key_gate, key_uniform, key_noise = jax.random.split(key, 3)
        draws = jnp.arange(mean.shape[0])[:, None] >= self.options.greedy_environments
        noise = jnp.where(draws, jax.random.normal(key_noise, mean.shape), 0.0)
        drawn = jnp.tanh(mean + jnp.exp(log_scale) * noise)
        uniform = jax.random.uniform(key_uniform, mean.shape, minval=-1.0, maxval=1.0)
        return memory, jnp.where(jax.random.uniform(key_gate, (mean.shape[0], 1)) < epsilon, uniform, drawn)

    def look(self, agent: Params, tokens: Tokens) -> Tokens:
        """The tokens with the trunk's features in the place of their frames: done once per update, or before."""
        if self.looks_once:
            dtype = jnp.dtype(self.config.network.dtype)
            return dataclasses.replace(tokens, frames=jnp.asarray(tokens.frames).astype(dtype))
        return self._look(agent, tokens)

    def _look(self, agent: Params, tokens: Tokens) -> Tokens:
        return cast(Tokens, self._call("look", agent, tokens))

    def loss(
        self, params: Params, target: Params, tokens: Tokens, representation: Representation | None, updates: jax.Array,
        key: jax.Array,
    ) -> tuple[jax.Array, Metrics]:
        """The losses of critics, actor and temperature, the weighted auxiliary losses and f's; () and its parts."""
        key_agent, key_f, key_action, key_next = jax.random.split(key, 4)
        agent, tokens = params["agent"], self.labelled(tokens, representation)
        looked = self.look(agent, tokens)
        fixed = dataclasses.replace(looked, frames=jax.lax.stop_gradient(looked.frames))
        online = self._encode(agent, looked, key_agent)
        steady = online if self._exact else self._encode(agent, fixed)
        averaged = self._encode(target, fixed)
        bonus = jnp.zeros_like(tokens.reward)
        loss, metrics = self._auxiliary(online.heads, averaged.heads, tokens, representation)
        if self.information_model is not None:
            loss_f, bonus, parts = self._information(params["f"], fixed, representation, key_f)
            loss, metrics = loss + loss_f, metrics | parts
        log_temperature = params["log_temperature"]
        loss_actor, log_prob, parts = self._actor(agent, online, log_temperature, tokens, key_action)
        loss, metrics = loss + loss_actor, metrics | parts
        if tokens.demonstrated is not None:
            loss_imitation, loss_scale, parts = self._imitation(agent, online, tokens)
            fade = self.imitation_fade(updates)
            loss += fade * (self.options.imitation_weight * loss_imitation + loss_scale)
            metrics |= parts
        next_action, next_log_prob = self._draw(agent, steady.actor, key_next)
        q_next = jnp.min(self._call("values", target, averaged.critic, next_action), axis=0)
        soft_value = (q_next - jnp.exp(log_temperature) * next_log_prob).reshape(tokens.segment.shape)
        loss_critic, parts = self._critic(agent, online, jax.lax.stop_gradient(soft_value), bonus, tokens)
        loss, metrics = loss + loss_critic, metrics | parts
        loss_temperature, parts = sac.temperature_loss(
            log_temperature, log_prob, self.target_entropy, transitions(tokens))
        metrics |= {"actor/entropy": parts["entropy"], "actor/temperature": jnp.exp(log_temperature)}
        return loss + loss_temperature, metrics

    def heads(self, agent: Params, tokens: Tokens, key: jax.Array) -> Sequence[Heads]:
        """Of the actor's and the critics' branches, or of the one they share."""
        return self._encode(agent, self.look(agent, tokens), key).heads

    def _call(self, method: str, params: Params, *arguments: Any) -> Any:
        return self.network.apply({"params": params}, *arguments, method=method)

    def _encode(self, agent: Params, looked: Tokens, key: jax.Array | None = None) -> Encoded:
        """With dropout only where there is a key."""
        rngs = None if key is None else {"dropout": key}
        return cast(Encoded, self.network.apply(
            {"params": agent}, looked, key is None or self._exact, rngs=rngs, method="encode"))

    def _draw(self, agent: Params, seen: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """(N, A) actions of the actor, and (N,) their log densities."""
        mean, log_scale = self._call("policy", agent, seen)
        return sac.sample_tanh_gaussian(mean, log_scale, jax.random.normal(key, mean.shape))

    def _actor(
        self, agent: Params, online: Encoded, log_temperature: jax.Array, tokens: Tokens, key: jax.Array
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """The actor's loss where an action was taken, and (R, L - 1) log pi of its own; the critics only advise."""
        shape = tokens.segment.shape
        action, log_prob = self._draw(agent, online.actor, key)
        q = self._call("values", jax.lax.stop_gradient(agent), jax.lax.stop_gradient(online.critic), action)
        log_prob, q = log_prob.reshape(shape)[:, :-1], q.reshape(-1, *shape)[..., :-1]
        loss = sac.actor_loss(log_prob, q, jnp.exp(log_temperature), transitions(tokens))
        return loss, log_prob, {"loss/actor": loss}

    def _imitation(self, agent: Params, online: Encoded, tokens: Tokens) -> tuple[jax.Array, jax.Array, Metrics]:
        """The losses of the mean, over the transitions of what is imitated, and of the scale, over those of
        demonstrations: it does not fit itself to episodes that the actor drew from it."""
        mean, log_scale = (
            x.reshape(*tokens.segment.shape, -1)[:, :-1] for x in self._call("policy", agent, online.actor))
        # In a turned copy of an episode actions may leave the actor's range.
        intended = jnp.clip(cast(jax.Array, tokens.intended)[:, 1:], -1.0, 1.0)
        valid, action = transitions(tokens), jnp.tanh(mean)
        near = demonstrated = valid & cast(jax.Array, tokens.demonstrated)[:, :-1]
        if tokens.succeeded is not None:
            near |= valid & tokens.succeeded[:, :-1]
        loss, loss_scale = (sac.imitation_loss(action, intended, near),
                            sac.scale_loss(action, log_scale, intended, demonstrated))
        return loss, loss_scale, {"loss/imitation": loss, "loss/scale": loss_scale,
                                  "actor/distance": sac.imitation_loss(action, intended, demonstrated)}

    def _critic(
        self, agent: Params, online: Encoded, soft_value: jax.Array, bonus: jax.Array, tokens: Tokens
    ) -> tuple[jax.Array, Metrics]:
        """The critics' loss over the transitions token l -> l + 1 of the same segment."""
        valid, shape = transitions(tokens), tokens.segment.shape
        taken = jnp.roll(tokens.previous_action, -1, axis=1).reshape(-1, self.network.action_size)
        q = self._call("values", agent, online.critic, taken).reshape(-1, *shape)[..., :-1]
        target = traced_returns(
            r_t=tokens.reward[:, 1:] + bonus[:, 1:],
            discount_t=self._discounts(tokens),
            v_t=soft_value[:, 1:],
            trace_t=self.options.trace_decay * may_follow(valid),
        )
        loss, parts = sac.critic_loss(q, target, valid)
        return loss, {"loss/td": loss, "q/mean": parts["q"], "q/error": parts["td_error"],
                      "train/bonus": episode_mean(bonus[:, 1:], valid, tokens)}


def _network(env: Environment, config: Config, declaration: Variant) -> ActorCritic:
    """Actor and critics, by the agent's declaration."""
    size = cast(ContinuousActions, env.action_spec).size
    features, spec, net = config.stage1.features, env.observation_spec, config.network
    dtype, norm = jnp.dtype(net.dtype), config.sac.critic_norm
    if declaration.sees_state:
        seen = PrivilegedFeatures(env.state_spec, spec, features, config.mdp.sees)
        return PrivilegedActorCritic(size, net, spec, norm, features=seen)
    trunk = encoder_for(spec, features, dtype) if config.sac.trunk != "own" else None
    whole = config.sac.trunk == "z_o"
    branch_spec = spec if trunk is None else ArraySpec((features,)) if whole else _body_spec(spec)
    state_spec = _body_spec(env.state_spec) if config.sac.looks_through_psi else env.state_spec
    history = HistoryEncoder(size, env.horizon + 1, memory_of(config), net)
    if declaration.believes:
        reads = net, branch_spec, features, trunk is not None
        return BeliefActorCritic(
            size, net, spec, norm, trunk, whole, actor=BeliefReader(*reads),
            history=BeliefBranches(*reads, top=history, believer=config.believer))

    def branch() -> TwoBranch:
        return TwoBranch(
            history.clone(), branch_spec, features, bottom_psi=declaration.uses_representation,
            predicts_state=declaration.informed, predicts_itself=declaration.predicts_itself,
            after_trunk=trunk is not None)

    return TwoBranchActorCritic(
        size, net, spec, norm, trunk, whole, actor=branch(), critic=None if declaration.critic == "state" else branch(),
        critic_sees=declaration.critic, state_spec=state_spec, actor_moves_trunk=declaration.critic == "state")


def _body_spec(spec: ArraySpec) -> ArraySpec:
    """What the body of an encoder makes of an array."""
    example, body = jnp.zeros((1, *spec.shape), spec.dtype), encoder_for(spec, 1)
    looked, _ = jax.eval_shape(lambda: body.init_with_output(jax.random.key(0), example, method="body"))
    return ArraySpec(looked.shape[1:])


def make_sac(env: Environment, config: Config) -> SAC:
    """The agent that a configuration names, for an environment with continuous actions."""
    declaration = variant(config.agent)
    network, model = _network(env, config, declaration), None
    if declaration.informed:
        model = make_information_model(config, cast(TwoBranchActorCritic, network).actor.top)
    return SAC(env, config, declaration, network, model, adam(config.sac, config.sac.updates_in(config.steps)))

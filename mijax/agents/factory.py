"""The agent that a configuration names: Double DQN for discrete actions, SAC for continuous ones."""

import jax

from envs_mjx.base import DiscreteActions, Environment, shows_again
from mijax.agents.core import Agent
from mijax.agents.dqn import make_dqn
from mijax.agents.sac import make_sac
from mijax.agents.variants import memory_of, needs_representation
from mijax.config import Config, require


def make_agent(env: Environment, config: Config) -> Agent:
    """The agent that a configuration names, for an environment; `ConfigError` where they do not fit."""
    net = config.network
    width = net.action_embedding + net.observation_embedding
    require(memory_of(config) != "gpt" or width % net.heads == 0, "network.heads", net.heads,
            f"a divisor of the transformer's width {width} (action-embedding + observation-embedding)")
    require(config.agent != "believer" or len(net.auxiliary_hidden) > 0, "network.auxiliary-hidden", "none",
            "at least one width, as Believer embeds its beliefs with the last one")
    agent = make_dqn(env, config) if isinstance(env.action_spec, DiscreteActions) else make_sac(env, config)
    config.updates_per_iteration(agent.group, agent.options.updates_per_step)
    require(agent.copies == 0 or shows_again(env), "sac.rotated-copies", agent.copies,
            f"0, as {env.name} cannot show a moment again")
    demonstrations = 0 if isinstance(env.action_spec, DiscreteActions) else config.sac.demonstrations
    require(demonstrations == 0 or has_expert(env), "sac.demonstrations", demonstrations,
            f"0, as {env.name} has no expert")
    if isinstance(env.action_spec, DiscreteActions):
        require(not config.sac.looks_through_psi, "sac.trunk", config.sac.trunk,
                f"own or shared: {env.name} is not for SAC")
    if needs_representation(config):
        require(config.stage1.data == "random" or has_expert(env), "stage1.data", config.stage1.data,
                f"random, as {env.name} has no expert")
    return agent


def has_expert(env: Environment) -> bool:
    """Whether the environment offers demonstrations."""
    return jax.eval_shape(lambda: env.demonstrations(jax.random.key(0), 1)) is not None

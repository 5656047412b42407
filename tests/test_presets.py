"""The presets of the six domains, and the paper's numbers in their place."""

import pytest

import configs
from configs.paper import paper
from mijax.config import Config

RANDOM, DEMONSTRATIONS = "random", "demonstrations"
TABLE_3 = {  # episodes, copies, learning rate, lambda_r, lambda_s, lambda_o, lambda_club, lambda_dim_s, lambda_dim_o
    "heaven_hell": (RANDOM, 500, 0, 0.003, 10.0, 1.0, 0.5, 1.0, 0.0, 1.0),
    "sphinx": (RANDOM, 500, 0, 0.001, 10.0, 0.5, 0.03, 0.3, 0.0, 0.5),
    "carflag_2d": (RANDOM, 1000, 0, 0.001, 1.0, 1.0, 5.0, 10.0, 0.0, 1.0),
    "block_pulling": (DEMONSTRATIONS, 80, 4, 0.001, 10.0, 0.1, 1.0, 10.0, 0.1, 1.0),
    "block_pushing": (DEMONSTRATIONS, 80, 12, 0.001, 100.0, 1.0, 1.0, 0.001, 0.01, 1.0),
    "drawer_opening": (DEMONSTRATIONS, 80, 6, 0.001, 100.0, 1.0, 1.0, 1.0, 0.001, 1.0)}


TABLE_2 = {  # steps, critic's step size, alpha, embeddings of action and observation
    "heaven_hell": (500_000, 3e-4, 10.0, 64, 64), "sphinx": (500_000, 3e-5, 10.0, 16, 100),
    "carflag_2d": (1_000_000, 3e-5, 0.0, 16, 100), "block_pulling": (40_000, 3e-4, 0.1, 16, 64),
    "block_pushing": (40_000, 3e-4, 0.1, 16, 64), "drawer_opening": (40_000, 3e-4, 0.1, 16, 64)}


def of_the_paper(domain: str, steps: int | None = None) -> Config:
    return paper(configs.preset(domain), vector_observation=domain == "heaven_hell", steps=steps)


@pytest.mark.parametrize("domain", TABLE_2)
def test_the_papers_stage_2_is_table_2(domain: str) -> None:
    config = of_the_paper(domain)
    options = config.sac if domain in configs.ROBOTS else config.dqn
    assert TABLE_2[domain] == (config.steps, options.learning_rate, config.information.intrinsic_weight,
                               config.network.action_embedding, config.network.observation_embedding)
    assert (options.discount, options.target_rate, options.batch_episodes) == (0.99, 0.005, 64)
    assert options.updates_per_step == (1.0 if domain in configs.ROBOTS else 0.25)
    assert (options.trace_decay, options.final_learning_rate) == (0, 1)
    if domain in configs.ROBOTS:
        assert config.sac.replay_steps == 100_000
        assert (config.sac.imitation_weight, config.sac.pretrain_updates, config.sac.trunk) == (0, 0, "own")
    else:
        assert config.dqn.epsilon_steps == config.steps // 10
        assert (config.dqn.warmup_episodes, config.dqn.pretrain_updates) == (10, 0)
    network = config.network
    assert (network.layers, network.heads, network.gru_width, network.dropout) == (1, 2, 128, 0.1)
    assert (network.critic_hidden, network.actor_hidden) == ((256, 256), (256, 256))
    assert network.auxiliary_hidden == (128, 128)
    information = config.information
    assert (information.auxiliary_weight, information.auxiliary_in_variances) == (0.5, False)
    assert (information.intrinsic_form, information.intrinsic_telescopes) == ("cosine", False)


def test_a_shorter_budget_explores_for_a_tenth_of_it() -> None:
    config = of_the_paper("heaven_hell", steps=20_000)
    assert (config.steps, config.dqn.epsilon_steps) == (20_000, 2_000)


@pytest.mark.parametrize("domain", TABLE_3)
def test_the_papers_stage_1_is_table_3(domain: str) -> None:
    stage1 = of_the_paper(domain).stage1
    assert TABLE_3[domain] == (
        stage1.data, stage1.episodes, stage1.copies, stage1.learning_rate, stage1.lambda_r, stage1.lambda_s,
        stage1.lambda_o, stage1.lambda_club, stage1.lambda_dim_s, stage1.lambda_dim_o)
    assert (stage1.epochs, stage1.batch_size) == (1000, 500)
    assert (stage1.final_learning_rate, stage1.warmup, stage1.phi_shrinkage, stage1.rewarded) == (1, 0, 0, 0)
    assert (stage1.estimator_view, stage1.state_bound, stage1.lower_bound) == (
        "features", "jensen_shannon", "jensen_shannon")


@pytest.mark.parametrize("domain", TABLE_3)
def test_a_preset_is_of_its_domain(domain: str) -> None:
    assert configs.preset(domain).domain == domain

"""The presets of the six domains, and the paper's numbers in their place."""

import pytest

import configs
from configs.paper import paper

RANDOM, DEMONSTRATIONS = "random", "demonstrations"
TABLE_3 = {  # episodes, copies, learning rate, lambda_r, lambda_s, lambda_o, lambda_club, lambda_dim_s, lambda_dim_o
    "heaven_hell": (RANDOM, 500, 0, 0.003, 10.0, 1.0, 0.5, 1.0, 0.0, 1.0),
    "sphinx": (RANDOM, 500, 0, 0.001, 10.0, 0.5, 0.03, 0.3, 0.0, 0.5),
    "carflag_2d": (RANDOM, 1000, 0, 0.001, 1.0, 1.0, 5.0, 10.0, 0.0, 1.0),
    "block_pulling": (DEMONSTRATIONS, 80, 4, 0.001, 10.0, 0.1, 1.0, 10.0, 0.1, 1.0),
    "block_pushing": (DEMONSTRATIONS, 80, 12, 0.001, 100.0, 1.0, 1.0, 0.001, 0.01, 1.0),
    "drawer_opening": (DEMONSTRATIONS, 80, 6, 0.001, 100.0, 1.0, 1.0, 1.0, 0.001, 1.0)}


@pytest.mark.parametrize("domain", TABLE_3)
def test_the_papers_stage_1_is_table_3(domain: str) -> None:
    stage1 = paper(configs.preset(domain), vector_observation=domain == "carflag_2d").stage1
    assert TABLE_3[domain] == (
        stage1.data, stage1.episodes, stage1.copies, stage1.learning_rate, stage1.lambda_r, stage1.lambda_s,
        stage1.lambda_o, stage1.lambda_club, stage1.lambda_dim_s, stage1.lambda_dim_o)
    assert (stage1.epochs, stage1.batch_size) == (1000, 500)


@pytest.mark.parametrize("domain", TABLE_3)
def test_a_preset_is_of_its_domain(domain: str) -> None:
    assert configs.preset(domain).domain == domain

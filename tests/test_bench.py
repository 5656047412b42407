"""The bench runs and reports every measurement; its timings are not tested. The count of arithmetic is."""

import json

import jax
import jax.numpy as jnp
import pytest

from launch import bench
from launch.arithmetic import operations
from mijax.agents.variants import VARIANTS


def test_products_loops_and_dead_code_are_counted():
    x, w = jnp.ones((3, 5)), jnp.ones((5, 7))
    assert operations(lambda x, w: x @ w, x, w) == 2 * 3 * 5 * 7
    assert operations(lambda x, w: (x @ w, x)[1], x, w) == 0
    assert operations(jax.jit(jax.grad(lambda w: jnp.sum(jnp.square(x @ w)))), w) == 2 * (2 * 3 * 5 * 7)
    square = jnp.ones((4, 4))
    assert operations(lambda y: jax.lax.fori_loop(0, 6, lambda _, z: z @ square, y), square) == 6 * 2 * 4**3


def test_a_convolution_is_counted():
    image, kernel = jnp.ones((2, 6, 6, 3)), jnp.ones((2, 2, 3, 8))
    convolve = lambda x, k: jax.lax.conv_general_dilated(  # noqa: E731
        x, k, (1, 1), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC"))
    assert operations(convolve, image, kernel) == 2 * (2 * 5 * 5 * 8) * 3 * 4


WHAT = {
    "environments": ["environment, batch 1", "environment, batch 8"], "acting": ["acting, batch 4"],
    "stage1": ["stage 1"],
    "stage2": ["stage 2, full length", "stage 2, trained agent's replay", "stage 2, paper's sizes, full length",
               "stage 2, paper's sizes, trained agent's replay"],
    "agents": ["agent zp, gru, full length"], "seeds": ["1 seed by map", "2 seeds by shard"]}


@pytest.mark.lenient  # optax promotes int32 step counts
@pytest.mark.parametrize("parts", [("environments", "acting"), pytest.param(tuple(WHAT), marks=pytest.mark.slow)])
def test_quick_bench_reports_every_part_as_json(parts, capsys, monkeypatch):
    monkeypatch.setattr(bench, "VARIANTS", {name: VARIANTS[name] for name in ("zp", "mdp")})
    assert bench.main(["--json", "--quick", "--domains", "heaven_hell", "--only", *parts]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["matmul_gflops"] > 0
    first, *results = report["results"]
    assert first["what"] == "float32 matmul 64"
    assert [result["what"] for result in results] == [what for part in parts for what in WHAT[part]]
    for result in results:
        assert result["domain"] == "heaven_hell"
        assert result["per_second"] > 0
        if not result["what"].startswith(("environment", "1 seed", "2 seeds")):
            assert result["gflop"] > 0
            assert result["matmul_fraction"] > 0


@pytest.mark.slow  # two processes compile the environment
@pytest.mark.lenient
def test_quick_bench_of_a_robot(capsys):
    assert bench.main(["--json", "--quick", "--only", "environments", "stage2", "--domains", "block_pulling"]) == 0
    _, environment, physics, moments, *updates = json.loads(capsys.readouterr().out)["results"]
    assert environment["what"].startswith("environment, batch ")
    assert min(result["per_second"] for result in (environment, physics, moments, *updates)) > 0
    assert "second process" in environment["detail"]
    assert [update["what"] for update in updates] == ["stage 2, trunk psi", "stage 2, trunk shared"]

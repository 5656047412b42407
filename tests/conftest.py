"""How every test runs: two devices on the CPU, loud shapes and types, compiled programs kept on disk."""

import os
import pathlib
from collections.abc import Iterator

REPOSITORY = pathlib.Path(__file__).resolve().parents[1]

# These are read when jax is first imported, and are inherited by the commands that tests start.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# A cache of its own for each process: one could read what another is still writing.
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", str(REPOSITORY / ".cache" / "jax" / os.environ.get("PYTEST_XDIST_WORKER", "alone")))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
os.environ.setdefault("MPLBACKEND", "Agg")
# Programs are compiled for a few calls each: without LLVM's optimisations that takes three quarters of the time, and
# without XLA's own fusion emitters, code in one part, three fifths of what is left (UA-TSAC's loop: 26 s, 15 s).
for flag, value in (("--xla_force_host_platform_device_count", 2), ("--xla_backend_optimization_level", 0),
                    ("--xla_cpu_use_fusion_emitters", "false"), ("--xla_cpu_parallel_codegen_split_count", 1)):
    if flag not in os.environ.get("XLA_FLAGS", ""):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}={value}".strip()

import jax  # noqa: E402
import pytest  # noqa: E402

LONG = ("test_train.py", "test_bench.py", "test_learner.py", "test_variants.py", "test_sac.py", "test_export.py",
        "test_representation.py", "test_dqn.py", "test_paper.py", "test_robot_tasks.py", "test_page.py")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files first: workers take whole files, and none is to end with a long one alone."""
    items.sort(key=lambda item: LONG.index(item.path.name) if item.path.name in LONG else len(LONG))


@pytest.fixture(autouse=True)
def loud_shapes_and_types(request: pytest.FixtureRequest) -> Iterator[None]:
    """A broadcast between ranks is an error, and so is an implicit promotion of types unless the test is `lenient`."""
    lenient = request.node.get_closest_marker("lenient") is not None
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("standard" if lenient else "strict"):
        yield


@pytest.fixture(autouse=True, scope="module")
def programs_of_one_file() -> Iterator[None]:
    """Compiled programs are let go with their file: kept, they filled 5.5 GiB of a process by the end."""
    yield
    jax.clear_caches()

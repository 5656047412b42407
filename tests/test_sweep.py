"""Sweeps: what a file means, and that no death of a process loses or repeats a job."""

import contextlib
import io
import json
import os
import pathlib
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable

import pytest
import tiny_runs
import yaml
from commands import failure_of
from rich.console import Console

from launch import sweep
from launch.job import available_cores
from launch.sweep import Job, Local, OnRay, Sweep
from mijax.config import ConfigError
from mijax.run_folder import RunFolder

SPEC = """
options: {steps: 2000, num_envs: 4}
grid:
  domain: [heaven_hell, "examples.signpost:Signpost"]
  agent: [base]
  dqn.learning-rate: [1.0e-3, 3.0e-4]
seeds: 3
seeds_per_job: 2
"""


def test_the_example_is_one():
    found = sweep.read(pathlib.Path(__file__).parents[1] / "examples" / "sweep.yaml", pathlib.Path("out"))
    assert [job.name for job in found.jobs] == [
        f"{memory}-information.auxiliary-weight={weight}" for memory in ("gpt", "gru") for weight in (0.5, 0.0)]


def written(tmp_path: pathlib.Path, text: str) -> pathlib.Path:
    path = tmp_path / "spec.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_every_combination_is_a_job(tmp_path: pathlib.Path):
    found = sweep.read(written(tmp_path, SPEC), tmp_path)
    assert len(found.jobs) == len({job.name for job in found.jobs}) == 2 * 2 * 2
    assert (found.cpus, found.gpus, found.retries) == (1, 0.0, 2)
    first = found.jobs[0]
    assert first.name == "heaven_hell-base-dqn.learning-rate=0.001-seeds=0_1"
    assert first.arguments == ("--steps", "2000", "--num-envs", "4", "--domain", "heaven_hell", "--agent", "base",
                               "--dqn.learning-rate", "0.001", "--seeds", "0,1,")
    assert found.jobs[1].arguments[-1] == "2,"
    assert all("/" not in job.name and ":" not in job.name for job in found.jobs)


@pytest.mark.parametrize(("text", "message"), [
    ("grid: 3", "a mapping `grid`"),
    ("grid: {agent: [mi]}\nsteps: 3", "the keys options, grid, seeds"),
    ("grid: {agent: mi}", "spec grid.agent: got 'mi', accepted: a list of values"),
    ("grid: {agent: [mi]}\nretries: -1", "spec retries: got -1, accepted: a number >= 0"),
    ("grid: {agent: [mi]}\nresources: {tpus: 1}", "the keys cpus, gpus"),
    ("grid: {agent: [mi]}\nresources: {cpus: 0}", "spec resources.cpus: got 0"),
    ("grid: {agent: [mi]}\nresources: [1]", "spec resources: got .*, accepted: a mapping"),
    ("grid: {agent: [mi]}\noptions: [steps]", "spec options: got .*, accepted: a mapping"),
    ("grid: {agent: [mi, base, mi]}", "spec: got 'mi', accepted: every job once"),
    ("grid: {dqn.discount: [0.9, 0.90]}", "spec: got 'dqn.discount=0.9', accepted: every job once"),
    ("grid: {out: [a]}", "spec out: got 'out', accepted: nothing here"),
    ("options: {hosts: auto}\ngrid: {agent: [mi]}", "spec hosts: got 'hosts', accepted: nothing here"),
    ("grid: {agent: [mi]}\nseeds_per_job: 0", "spec seeds_per_job: got 0"),
    ("grid: {dqn.learning-rate: [fast]}", "dqn.learning-rate=fast: options .* are not accepted"),
    ("grid: {dqn.learning-rate: [-1.0]}", "dqn.learning-rate"),
    ("grid: [", "cannot be read"),
])
def test_a_bad_file_is_refused_before_anything_runs(tmp_path: pathlib.Path, text: str, message: str):
    with pytest.raises(ConfigError, match=message):
        sweep.read(written(tmp_path, text), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("arguments", "message"), [
    (["--workers", "0"], "workers: got 0"), (["--address", "auto"], "address: got 'auto', accepted: nothing"),
    (["--job", "1", "--backend", "ray"], "job: got 1, accepted: nothing, it belongs to --backend local")])
def test_bad_options(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]):
    assert message in failure_of(sweep.main, capsys, "spec.yaml", *arguments)


class Scripted(Job):
    """A job whose process runs a script in place of a training, as often as it is started."""

    def command(self, cores: object) -> list[str]:
        begin = f"""
            import os, pathlib, signal, sys, time
            path = pathlib.Path({str(self.path)!r})
            path.mkdir(exist_ok=True)
            starts = path / "starts"
            starts.write_text((starts.read_text() if starts.exists() else "") + "x")
            def end(): (path / "summary.json").write_text("{{}}")
        """
        return [sys.executable, "-c", textwrap.dedent(begin) + textwrap.dedent(self.arguments[0])]

    @property
    def starts(self) -> int:
        """How often it was started."""
        return len((self.path / "starts").read_text())


DIES_ONCE = "os.kill(os.getpid(), signal.SIGKILL) if len(starts.read_text()) < 2 else end()"
FAILS = "sys.exit('error: --steps: got 0, accepted: a number >= 1')"
WAITS = "print('working', flush=True)\ntime.sleep(600)"


def run(*jobs: Job, retries: int = 2) -> dict[str, str]:
    return dict(sweep.watch(Sweep(jobs, 1, 0.0, retries), Local(Sweep(jobs, 1, 0.0, retries), 2),
                            Console(file=io.StringIO())))


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep, "REFRESH_SECONDS", 0.05)


def test_a_killed_job_goes_on_and_a_failed_one_does_not(tmp_path: pathlib.Path):
    dies, fails, keeps_dying = (Scripted(name, (script,), tmp_path) for name, script in (
        ("dies", DIES_ONCE), ("fails", FAILS), ("keeps_dying", "os.kill(os.getpid(), signal.SIGKILL)")))
    assert run(dies, fails, keeps_dying) == {"dies": "done", "fails": "failed", "keeps_dying": "failed"}
    assert (dies.starts, fails.starts, keeps_dying.starts) == (2, 1, 3)
    assert sweep.last_words(fails) == "error: --steps: got 0, accepted: a number >= 1"
    assert run(dies) == {"dies": "done"}
    assert dies.starts == 2


def test_stopping_asks_the_running_jobs_to_save_and_starts_no_other(tmp_path: pathlib.Path):
    jobs = [Scripted(name, (WAITS,), tmp_path) for name in ("one", "two", "three")]
    backend = Local(Sweep(tuple(jobs), 1, 0.0, 2), 2)
    deadline = time.monotonic() + 60
    while sweep.last_words(jobs[0]) != "working" or sweep.last_words(jobs[1]) != "working":
        assert time.monotonic() < deadline
        time.sleep(0.05)
    backend.stop()
    assert backend.states == {"one": "stopped", "two": "stopped", "three": "waiting"}


def test_one_job_of_a_sweep_for_the_queue_of_a_cluster(
        tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    class Dealt(Scripted):
        def command(self, cores: object) -> list[str]:
            assert not cores  # two jobs of an array on one machine must not take the same one
            return super().command(cores)

    jobs = tuple(Dealt(name, ("end()",), tmp_path) for name in ("one", "two"))
    monkeypatch.setattr(sweep, "read", lambda spec, out: Sweep(jobs, 1, 0.0, 2))
    assert sweep.main(["spec.yaml", "--job", "1"]) == 0
    assert [job.done for job in jobs] == [False, True]
    capsys.readouterr()
    assert sweep.main(["spec.yaml", "--list"]) == 0
    assert capsys.readouterr().out == "0 one\n1 two: done\n"
    refused = failure_of(sweep.main, capsys, "spec.yaml", "--job", "2")
    assert "job: got 2, accepted: 0 to 1, which --list shows" in refused
    assert sweep.main(["spec.yaml", "--job", "1"]) == 0
    assert jobs[1].starts == 1


def test_a_job_goes_on_with_its_own_run(tmp_path: pathlib.Path):
    job = Job("a", ("--domain", "sphinx"), tmp_path)
    assert job.command([0, 1])[3:] == ["0,1", str(os.getpid()), "--domain", "sphinx", "--out", str(tmp_path / "a")]
    job.path.mkdir()
    (job.path / "config.json").write_text(json.dumps({"domain": "sphinx"}))
    assert job.command([])[3:] == ["", str(os.getpid()), "--resume", str(tmp_path / "a")]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a feature of Linux")
def test_a_job_dies_with_the_process_that_started_it(tmp_path: pathlib.Path):
    core = available_cores()[0]
    child = f"from launch.job import prepare; import os, sys, time; prepare([{core}], int(sys.argv[1])); " \
            "print(os.getpid(), *os.sched_getaffinity(0), flush=True); time.sleep(600)"
    starter = f"import os, subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}, str(os.getpid())])"
    parent = subprocess.Popen([sys.executable, "-c", starter], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid, cores = parent.stdout.readline().split(maxsplit=1)
    assert cores.split() == [str(core)]
    parent.send_signal(signal.SIGKILL)
    parent.communicate()
    deadline = time.monotonic() + 30
    while is_alive(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not is_alive(pid)


def is_alive(pid: str) -> bool:
    """Whether a process works, and does not only wait to be collected."""
    try:
        status = pathlib.Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return False
    return status.rpartition(")")[2].split()[0] != "Z"


def test_a_job_that_has_no_cores_of_its_own_keeps_to_so_many_threads(tmp_path: pathlib.Path):
    job = Scripted("counts", ("from mijax import runtime\nprint(runtime.cores())\nend()",), tmp_path)
    assert sweep.run_job(job, 0, threads=1) == "done"
    assert sweep.last_words(job) == "1"


TWELVE = {
    "options": tiny_runs.OPTIONS | {"domain": "heaven_hell", "memory": "gru", "steps": 2000, "seeds.strategy": "map"},
    "grid": {"agent": ["base", "mi"], "dqn.learning-rate": [1e-3, 3e-4]},
    "seeds": 3,
    "seeds_per_job": 1,
}


def workers_of(run: pathlib.Path) -> list[int]:
    """The process that has started a run and waits for it, if there is one."""
    commands = []
    for path in pathlib.Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            commands.append(path.read_text().split("\0"))
    jobs = [words[words.index("launch.job"):] for words in commands if "launch.job" in words]
    return [int(parent) for _, _, parent, *options in jobs if str(run) in options]


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="finds workers in /proc")
def test_a_ray_cluster_loses_a_worker_and_a_node(tmp_path: pathlib.Path):
    """Twelve trainings end, and with the same numbers as where nothing was lost."""
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]

    spec = written(tmp_path, yaml.safe_dump(TWELVE))
    calm, stormy = (sweep.read(spec, tmp_path / name) for name in ("calm", "stormy"))
    assert set(sweep.watch(calm, Local(calm), Console(file=io.StringIO())).values()) == {"done"}
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    node = cluster.add_node(num_cpus=1)
    ray.init(address=cluster.address, log_to_driver=False)
    states: dict[str, str] = {}
    thread = threading.Thread(
        target=lambda: states.update(sweep.watch(stormy, OnRay(stormy), Console(file=io.StringIO()))))

    def wait_for(happened: Callable[[], object]) -> None:
        deadline = time.monotonic() + 600
        while not happened():
            assert time.monotonic() < deadline
            assert thread.is_alive()
            time.sleep(0.1)

    def midway() -> list[int]:
        begun = [job.path for job in stormy.jobs if not job.done and sweep.progress(job)[0] > 0]
        return [pid for path in begun for pid in workers_of(path)]

    def done() -> int:
        return sum(job.done for job in stormy.jobs)

    try:
        thread.start()
        wait_for(lambda: done() >= 2 and midway())
        os.kill(midway()[0], signal.SIGKILL)
        wait_for(lambda: done() >= 5)
        cluster.remove_node(node)
        thread.join(1200)
        assert states == {job.name: "done" for job in stormy.jobs}
    finally:
        ray.shutdown()
        cluster.shutdown()
    for one, other in zip(calm.jobs, stormy.jobs, strict=True):
        seed, = RunFolder.open(one.path).seeds()
        assert tiny_runs.comparable(one.path, seed) == tiny_runs.comparable(other.path, seed)
        assert tiny_runs.comparable(one.path, seed)[-1]["step"] == 2000

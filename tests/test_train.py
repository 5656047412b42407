"""The train command: options, both stages on a tiny run, kill and resume, bad input."""

import dataclasses
import json
import os
import pathlib
import re
import shutil
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import orbax.checkpoint as ocp
import pytest
from tiny_runs import TINY, comparable

from mijax import train
from mijax.config import Config, ConfigError, config_from_dict, parse_seeds
from mijax.hosts import Host
from mijax.run_folder import RunFolder

pytestmark = pytest.mark.lenient


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "mijax.train", *arguments]


def without_seconds(seeds: dict[str, dict]) -> dict[str, dict]:
    """What a summary says of its seeds, but for the seconds."""
    return {seed: {name: value for name, value in result.items() if name != "wall"} for seed, result in seeds.items()}


def free_port() -> int:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return server.getsockname()[1]


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """Both stages of `mi`, two seeds, never interrupted."""
    path = tmp_path_factory.mktemp("runs") / "whole"
    arguments = ["--domain", "heaven_hell", "--seeds", "0,3", "--steps", "1200", "--seeds.strategy", "map", *TINY]
    assert train.main([*arguments, "--out", str(path)]) == 0
    return path


def test_a_run_leaves_what_it_promises(whole_run: pathlib.Path) -> None:
    run = RunFolder.open(whole_run)
    summary = json.loads((whole_run / "summary.json").read_text())
    assert {p.name for p in whole_run.iterdir()} >= {"config.json", "versions.json", "summary.json", "curve.png"}
    assert run.seeds() == (0, 3)
    for seed in run.seeds():
        result = summary["seeds"][str(seed)]
        assert set(result["wall"]) >= {"compile", "environment", "update", "evaluation", "stage1"}
        assert result["wall"]["stage1"] > 0
        assert 0 <= result["success"] <= 1
        assert result["length"] <= 50 * (1 + 1e-6)  # a float32 mean
        assert [row["step"] for row in run.metrics(seed)] == [400, 600, 800, 1000, 1200]
        assert (run.seed_path(seed) / "representation" / "probe.json").exists()


def same_file(run: pathlib.Path, other: pathlib.Path, seed: int, name: str) -> bool:
    """Whether two runs have the same bytes of a seed's stage 1."""
    first, second = ((path / f"seed_{seed}" / "representation" / name).read_bytes() for path in (run, other))
    return first == second


def test_seed_three_alone_is_seed_three_of_many(whole_run: pathlib.Path, tmp_path: pathlib.Path) -> None:
    alone = tmp_path / "alone"
    arguments = ["--seeds", "3,", "--steps", "1200", "--seeds.strategy", "map", *TINY, "--out", str(alone)]
    assert train.main(arguments) == 0
    assert comparable(alone, 3) == comparable(whole_run, 3)
    assert same_file(alone, whole_run, 3, "representation.msgpack")


def test_killed_and_resumed_is_never_interrupted(whole_run: pathlib.Path, tmp_path: pathlib.Path,
                                                 capsys: pytest.CaptureFixture[str]) -> None:
    """On the representations of the run that it equals, taken over with what their probes found; under the strategy
    that is the default here, a device for each seed, where that run had them one after the other."""
    path = tmp_path / "killed"
    arguments = ["--seeds", "0,3", "--steps", "1200", *TINY, "--out", str(path), "--representation", str(whole_run)]
    process = subprocess.Popen(command(*arguments), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 240
    rows = path / "seed_0" / "metrics.jsonl"
    while time.monotonic() < deadline and process.poll() is None:
        if rows.exists() and rows.read_text().count("\n") >= 3:
            break
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL, "it ended before the kill"
    assert len(RunFolder.open(path).metrics(0)) >= 3
    assert train.main(["--resume", str(path)]) == 0
    assert "going on from step" in capsys.readouterr().out
    for seed in (0, 3):
        assert comparable(path, seed) == comparable(whole_run, seed)
        assert same_file(path, whole_run, seed, "probe.json")


def test_two_hosts_share_the_seeds(whole_run: pathlib.Path, tmp_path: pathlib.Path) -> None:
    """Each writes its own seed's files, and the last the summary: the run is what one host makes of it."""
    path, port = tmp_path / "shared", free_port()
    arguments = ["--domain", "heaven_hell", "--seeds", "0,3", "--steps", "1200", *TINY, "--out", str(path),
                 "--representation", str(whole_run)]
    hosts = [subprocess.Popen(command(*arguments, "--hosts", f"127.0.0.1:{port},{index},2"), text=True,
                              stdout=subprocess.PIPE, stderr=subprocess.STDOUT) for index in range(2)]
    try:
        said = [host.communicate(timeout=400)[0] for host in hosts]
    finally:
        for host in hosts:
            host.kill()
    assert [host.returncode for host in hosts] == [0, 0], said
    assert "seeds [0]" in said[0]
    assert "seeds [3]" in said[1]
    assert sum("whoever ends last writes the summary" in text for text in said) == 1
    for seed in (0, 3):
        assert comparable(path, seed) == comparable(whole_run, seed)
    there, alone = (json.loads((run / "summary.json").read_text())["seeds"] for run in (path, whole_run))
    assert without_seconds(there) == without_seconds(alone)


@pytest.mark.parametrize(("count", "shares"), [(1, [(4, 5, 9)]), (2, [(4, 9), (5,)]), (3, [(4,), (5,), (9,)])])
def test_hosts_share_seeds_out(count: int, shares: list[tuple[int, ...]]) -> None:
    assert [Host(index, count).share((4, 5, 9)) for index in range(count)] == shares


def test_what_hosts_cannot_do(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str],
                              monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith(("SLURM_", "OMPI_", "KUBERNETES_"))]:
        monkeypatch.delenv(name)  # else this machine is one of several hosts
    arguments = ["--agent", "base", "--steps", "1200", *TINY, "--out", str(tmp_path / "run")]
    assert train.main([*arguments, "--hosts", "auto"]) == 1
    assert "--hosts auto: the hosts did not meet: " in capsys.readouterr().err
    monkeypatch.setattr(train, "meet", lambda _: Host(1, 2))
    assert train.main([*arguments, "--hosts", "auto"]) == 1
    assert "--hosts: got auto, accepted: at most 1 hosts" in capsys.readouterr().err.replace("'", "")
    monkeypatch.setattr(train, "FOLDER_SECONDS", 0)
    assert train.main([*arguments, "--seeds", "2", "--hosts", "auto"]) == 1
    assert "host 0 has not begun this run" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_corrupt_checkpoint_falls_back_to_the_one_before(whole_run: pathlib.Path, tmp_path: pathlib.Path,
                                                           capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "corrupt"
    shutil.copytree(whole_run, path)
    newest = path / "seed_0" / "checkpoints" / "1200"
    for file in newest.rglob("*"):
        if file.is_file() and file.stat().st_size > 200:
            file.write_bytes(b"\0" * 10)
    assert train.main(["--resume", str(path)]) == 0
    assert "corrupt" in capsys.readouterr().out
    assert comparable(path, 0) == comparable(whole_run, 0)


def test_a_full_disk_at_a_checkpoint_is_one_line_and_costs_nothing_older(
    whole_run: pathlib.Path, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_space(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    path = tmp_path / "full"
    shutil.copytree(whole_run, path)
    (path / "summary.json").unlink()
    for seed in (0, 3):
        shutil.rmtree(path / f"seed_{seed}" / "checkpoints" / "1200")
    with monkeypatch.context() as patched:
        patched.setattr(ocp.CheckpointManager, "save", no_space)
        assert train.main(["--resume", str(path)]) == 1
    error = capsys.readouterr().err
    assert re.search(r"1200: the checkpoint could not be written: .*No space left on device", error)
    assert len(error.splitlines()) == 1
    assert train.main(["--resume", str(path)]) == 0
    for seed in (0, 3):
        assert comparable(path, seed) == comparable(whole_run, seed)


@pytest.mark.parametrize("asked", [signal.SIGINT, signal.SIGTERM])
def test_an_orderly_stop_saves_and_says_how_to_go_on(asked: signal.Signals, tmp_path: pathlib.Path,
                                                     capsys: pytest.CaptureFixture[str]) -> None:
    """Meanwhile no other process can go on with the run, or change what it is asked for."""
    path = tmp_path / "stopped"
    arguments = ["--agent", "base", "--steps", "100000", *TINY, "--checkpoint.every", "1000", "--out", str(path)]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(command(*arguments), stdout=subprocess.PIPE, text=True, env=environment)
    rows = path / "seed_0" / "metrics.jsonl"
    deadline = time.monotonic() + 240
    while time.monotonic() < deadline and not rows.exists() and process.poll() is None:
        time.sleep(0.05)
    try:
        assert process.poll() is None
        assert train.main(["--resume", str(path), "--steps", "200000"]) == 1
        assert "another process is at work in it" in capsys.readouterr().err
        process.send_signal(asked)
        said, _ = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == 0
    assert "stage 2: compiling, then " in said
    assert "random steps" in said
    assert f"--resume {path}" in said
    steps = [int(p.name) for p in (path / "seed_0" / "checkpoints").iterdir() if p.name.isdigit()]
    assert max(steps) == RunFolder.open(path).metrics(0)[-1]["step"]
    assert RunFolder.open(path).config()["steps"] == 100000


@pytest.mark.parametrize(("text", "seeds"), [("5", (0, 1, 2, 3, 4)), ("3,7", (3, 7)), ("3,", (3,))])
def test_seeds(text: str, seeds: tuple[int, ...]) -> None:
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["0", "", "-1", "a", "1,1", "2.5"])
def test_bad_seeds(text: str) -> None:
    with pytest.raises(ConfigError, match="--seeds"):
        parse_seeds(text)


def test_a_stored_configuration_comes_back() -> None:
    config = Config(domain="sphinx", steps=123_000)
    assert config_from_dict(json.loads(json.dumps(dataclasses.asdict(config)))) == config
    with pytest.raises(ConfigError, match=r"--dqn\.wrong: this version has no such option"):
        config_from_dict({"dqn": {"wrong": 1}})
    with pytest.raises(ConfigError, match=r"information\.intrinsic-form: got 'most'"):
        config_from_dict({"information": {"intrinsic_form": "most"}})


@pytest.mark.parametrize(("arguments", "named"), [
    (["--domain", "nowhere"], "nowhere"),
    (["--agent", "best"], "--agent"),
    (["--dqn.batch-episodes", "7"], "--dqn.batch-episodes"),
    (["--steps", "-5"], "--steps"),
    (["--steps", "99999999999"], "accepted: a number <= 2147483647"),
    (["--dqn.learning-rate", "inf"], "--dqn.learning-rate: got inf, accepted: a finite number"),
    (["--stage1.lambda-r", "nan"], "--stage1.lambda-r: got nan"),
    (["--agent", "base", "--steps", "2000"], "more than the 2000 of the warm-up"),
    (["--stage1.heldout-episodes", "1"], "--stage1.heldout-episodes"),
    (["--stage1.data", "demonstrations"], "--stage1.data"),
    (["--stage1.data", "demonstrations", "--stage1.state-bound", "conditional"], "--stage1.state-bound"),
    (["--sac.trunk", "psi"], "--sac.trunk"),
    (["--network.dropout", "0.99"], "--network.dropout"),
    (["--network.critic-hidden", "0"], "--network.critic-hidden"),
    (["--stage1.batch-size", "100000", "--stage1.episodes", "2"], "--stage1.batch-size"),
    (["--evaluation.every", "33"], "--evaluation.every"),
    (["--resume", "/nonexistent"], "/nonexistent"),
    (["--domain", "json:dumps"], "json"),
    (["--hosts", "here"], "--hosts"),
    (["--hosts", "10.0.0.1:4321,2,2"], "an index below the count"),
    (["--hosts", "10.0.0.1:4321,0,2"], "at most 1 hosts, one for each seed, not 2"),
])
def test_bad_input_is_one_line_and_leaves_nothing(
    arguments: list[str], named: str, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = [] if "--resume" in arguments else ["--out", str(tmp_path / "run")]
    assert train.main([*arguments, *out]) != 0
    error = capsys.readouterr().err.strip()
    assert named in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "run").exists()


def test_a_representation_of_another_domain_is_refused(whole_run: pathlib.Path, tmp_path: pathlib.Path,
                                                       capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--domain", "sphinx", "--representation", str(whole_run), "--out", str(tmp_path / "run")]
    assert train.main(arguments) == 1
    assert "heaven_hell" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("arguments", "named"), [
    (["--resume", "RUN", "--preset", "paper"], "--resume: got '--preset'"),
    (["--resume", "RUN", "other"], "--resume: got 'other'"),
    (["--agent", "base", "--representation", "RUN"], "--agent base looks through no features here"),
    (["--stage1.features", "16", "--representation", "RUN"], "holds features 32 wide, wanted --stage1.features 16"),
    (["--dqn.pretrain-updates", "9", "--representation", "RUN"], "--stage1.episodes: got '150 (random)', accepted: 12"),
])
def test_what_does_not_go_with_a_run_is_refused(
    whole_run: pathlib.Path, arguments: list[str], named: str, tmp_path: pathlib.Path,
    capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.stat().st_mtime_ns for path in whole_run.rglob("*")}
    words = [str(whole_run) if word == "RUN" else word for word in arguments]
    assert train.main(words if "--resume" in words else [*words, "--out", str(tmp_path / "run")]) == 1
    assert named in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    assert {path: path.stat().st_mtime_ns for path in whole_run.rglob("*")} == before


def test_seeds_that_are_not_abreast_go_on_one_after_the_other(
    whole_run: pathlib.Path, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One of two hosts was lost before its first checkpoint: what the other has learnt is kept."""
    path = tmp_path / "half"
    shutil.copytree(whole_run, path)
    (path / "summary.json").unlink()
    for name in ("checkpoints", "metrics.jsonl", "end.json"):
        there = path / "seed_3" / name
        shutil.rmtree(there) if there.is_dir() else there.unlink()
    before = (path / "seed_0" / "metrics.jsonl").read_bytes()
    assert train.main(["--resume", str(path)]) == 0
    said = capsys.readouterr().out
    assert "going on from step 1,200" in said
    assert "seeds [0] have ended, seeds [3] have not" in said
    assert (path / "seed_0" / "metrics.jsonl").read_bytes() == before
    assert comparable(path, 3) == comparable(whole_run, 3)
    there, alone = (json.loads((run / "summary.json").read_text())["seeds"] for run in (path, whole_run))
    assert without_seconds(there) == without_seconds(alone)


def test_a_run_that_has_ended_is_left_as_it_is(whole_run: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.stat().st_mtime_ns for path in whole_run.rglob("*")}
    assert train.main(["--resume", str(whole_run)]) == 0
    assert "has ended, at its 1,200 steps" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in whole_run.rglob("*")} == before


def test_results_without_a_checkpoint_are_not_replaced(
    whole_run: pathlib.Path, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "kept_small"
    shutil.copytree(whole_run, path)
    shutil.rmtree(path / "seed_3" / "checkpoints")
    shutil.rmtree(path / "seed_3" / "representation")
    before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    assert train.main(["--resume", str(path), "--steps", "1600"]) == 1
    assert "seed 3 has results, but no checkpoint to go on from" in capsys.readouterr().err
    assert {file: file.read_bytes() for file in path.rglob("*") if file.is_file()} == before


def test_devices_are_set_before_an_environment_starts_jax() -> None:
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    arguments = ("--domain", "examples.gymnax_memory:MemoryChain", "--preset", "paper", "--seeds", "2", "--steps", "1")
    ended = subprocess.run(command(*arguments), capture_output=True, text=True, env=environment)
    assert ended.returncode == 1
    assert ended.stderr.startswith("error: --steps: got 1, accepted: more than the")


def test_divergence_is_named_and_not_written(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run"
    arguments = ["--agent", "base", "--memory", "gru", "--steps", "1200", *TINY, "--dqn.learning-rate", "1e30"]
    assert train.main([*arguments, "--out", str(path)]) == 1
    assert re.match(r"error: seed 0: loss/\w+ is \S+ at step \d+, .*--dqn\.learning-rate", capsys.readouterr().err)
    assert all(np.isfinite(row["loss/td"]) for row in RunFolder.open(path).metrics(0))


@pytest.mark.parametrize("trunk", [pytest.param("shared", marks=pytest.mark.slow), "z_o"])
def test_sac_goes_on_where_it_stopped(trunk: str, tmp_path: pathlib.Path) -> None:
    """With what its replay holds on a robot: demonstrations to imitate, and turned copies of moments or of features."""
    whole, again = tmp_path / "whole", tmp_path / "again"
    options = {
        "memory": "gru", "steps": 120, "num-envs": 2, "steps-per-iteration": 2, "evaluation.every": 20,
        "evaluation.episodes": 4, "network.gru-width": 8, "stage1.episodes": 20, "stage1.epochs": 2,
        "stage1.batch-size": 20, "stage1.heldout-episodes": 8, "stage1.features": 4, "sac.trunk": trunk,
        "sac.batch-episodes": 4, "sac.replay-steps": 400, "sac.warmup-episodes": 4, "sac.demonstrations": 4,
        "sac.pretrain-updates": 4, "sac.imitation-weight": 1, "sac.rotated-copies": 2, "sac.demonstration-share": 0.5,
        "checkpoint.every": 1}
    words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    assert train.main(["--domain", "compass:Compass", *words, "--sac.imitate-successes", "--out", str(whole)]) == 0
    shutil.copytree(whole, again)
    steps = sorted(int(path.name) for path in (again / "seed_0" / "checkpoints").iterdir() if path.name.isdigit())
    assert len(steps) > 1
    shutil.rmtree(again / "seed_0" / "checkpoints" / str(steps[-1]))
    (again / "summary.json").unlink()
    RunFolder.open(again).truncate_after(steps[-2], (0,))
    assert train.main(["--resume", str(again)]) == 0
    assert comparable(again, 0) == comparable(whole, 0)
    assert RunFolder.open(again).metrics(0)[-1]["step"] > steps[-2]

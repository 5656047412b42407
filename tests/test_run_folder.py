"""The run folder survives kills and says what is wrong with it; progress is readable."""

import errno
import io
import json
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from mijax import files, progress, runtime, trackers
from mijax.config import ConfigError
from mijax.progress import ProgressDisplay
from mijax.run_folder import RunError, RunFolder

CONFIG = {"domain": "heaven_hell", "agent": "mi", "memory": "gpt", "critic_hidden": (256, 256)}


@pytest.fixture
def run(tmp_path):
    return RunFolder.create(tmp_path / "run", CONFIG)


def one_line(error: pytest.ExceptionInfo[RunError]) -> str:
    message = str(error.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize(("raised", "code", "said"), [
    (None, 0, ""), (RunError("no such run"), 1, "error: no such run\n"), (KeyboardInterrupt(), 130, "stopped\n")])
def test_exit_codes(raised: BaseException | None, code: int, said: str, capsys: pytest.CaptureFixture[str]):
    def work() -> None:
        if raised is not None:
            raise raised

    assert runtime.exit_code(work) == code
    assert capsys.readouterr().err == said


def test_a_mistake_of_ours_is_not_taken_for_the_user_s():
    with pytest.raises(ZeroDivisionError):
        runtime.exit_code(lambda: 1 / 0)


def test_after_an_interrupt_no_thread_is_waited_for():
    script = "from concurrent.futures import ThreadPoolExecutor; import time; from mijax import runtime; " \
             "ThreadPoolExecutor().submit(time.sleep, 600); runtime.leave({})"
    ended = subprocess.run([sys.executable, "-c", script.format(runtime.INTERRUPTED)], timeout=120)
    assert ended.returncode == runtime.INTERRUPTED


def test_create_and_open(run):
    opened = RunFolder.open(run.path)
    assert opened.config() == {**CONFIG, "critic_hidden": [256, 256]}
    assert {"python", "jax", "flax", "optax", "numpy", "mijax", "platform", "commit"} <= opened.versions().keys()
    assert opened.seeds() == ()
    assert opened.summary() is None
    opened.write_summary({"seeds": {3: {"success": np.float32(1.0), "steps_to_solve": None}}})
    assert opened.summary() == {"seeds": {"3": {"success": 1.0, "steps_to_solve": None}}}


def test_metrics_come_back_exactly(run):
    value = np.float32(0.1) * np.float32(3)
    run.append(3, {"step": jnp.int32(1000), "loss/td": jnp.float32(value), "evaluation/success": 0.5})
    run.append(11, {"step": 1000, "loss/td": float("nan"), "note": "x"})
    assert run.seeds() == (3, 11)
    assert run.metrics(3) == [{"step": 1000, "loss/td": float(value), "evaluation/success": 0.5}]
    assert run.metrics(11) == [{"step": 1000, "note": "x"}]
    assert run.metrics(4) == []


def test_a_torn_last_line_is_dropped_and_a_resumed_run_writes_the_same_file(run):
    def write(from_step: int) -> None:
        for step in range(from_step, 5):
            run.append(0, {"step": step, "loss/td": None if step == 1 else step / 3})

    write(1)
    path = run.seed_path(0) / "metrics.jsonl"
    whole = path.read_bytes()
    for kept in range(len(whole.split(b"\n", 2)[0]) + 1, len(whole)):  # killed at any byte after the first line
        path.write_bytes(whole[:kept])
        last = run.metrics(0)[-1]["step"]
        run.truncate_after(last, [0])
        write(last + 1)
        assert path.read_bytes() == whole
    run.truncate_after(2, [0])
    assert [row["step"] for row in run.metrics(0)] == [1, 2]


def test_a_killed_start_can_be_started_again(tmp_path):
    (tmp_path / "versions.json").write_text("{")
    (tmp_path / "config.json.part").write_text("{")
    with pytest.raises(RunError, match=r"no config\.json"):
        RunFolder.open(tmp_path)
    assert RunFolder.create(tmp_path, CONFIG).versions()["python"]


def test_a_run_starts_with_its_representations_or_not_at_all(tmp_path):
    def killed(run: RunFolder) -> None:
        (run.seed_path(4) / "representation").mkdir(parents=True)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        RunFolder.create(tmp_path, CONFIG, killed)
    with pytest.raises(RunError, match=r"no config\.json"):
        RunFolder.open(tmp_path)
    filled = []
    run = RunFolder.create(tmp_path, CONFIG, filled.append)
    assert filled == [run]
    assert not run.seed_path(4).exists()


def test_another_budget_makes_a_run_go_on(run):
    run.write_summary({})
    run.amend(steps=9000, track="none")
    assert run.summary() is None
    assert run.config() == {**RunFolder.open(run.path).config(), "steps": 9000}


def test_two_cannot_work_on_one_seed(run):
    other = RunFolder.open(run.path)
    with run.held([0, 3]):
        with pytest.raises(RunError, match="seed_3: another process is at work in it"), other.held([1, 3]):
            pass
        with other.held([1]):  # a host's own share
            pass
    with other.held([1, 3]):
        pass


def test_a_run_that_could_not_begin_is_removed_unless_it_has_others(tmp_path):
    run = RunFolder.create(tmp_path / "run", {**CONFIG, "seed_list": [0, 3]})
    with run.held([0]), RunFolder.open(run.path).held([3]):
        run.discard([3])
        assert run.seeds() == (0,)
        assert RunFolder.open(run.path).config()["seed_list"] == [0, 3]
    run.discard([0, 3])
    assert not run.path.exists()


def test_what_a_seed_came_to_is_of_one_step(run):
    with run.held([0]):
        run.write_end(0, 1200, {"evaluation": {"success": 1.0}})
    assert run.end(0, 1200) == {"step": 1200, "evaluation": {"success": 1.0}}
    assert run.end(0, 2400) is None
    assert run.end(1, 1200) is None
    run.truncate_after(600, [0])
    assert run.end(0, 1200) is None


def test_where_files_cannot_be_locked_work_goes_on(run, monkeypatch):
    def without_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", without_locks)
    with run.held([0]):
        pass


def test_unusable_folders_are_named(tmp_path, run):
    with pytest.raises(RunError, match=r"already holds a run; .* --resume") as error:
        RunFolder.create(run.path, CONFIG)
    assert str(run.path) in one_line(error)

    with pytest.raises(RunError, match="no such run folder") as error:
        RunFolder.open(tmp_path / "missing")
    one_line(error)

    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.tex").touch()
    with pytest.raises(RunError, match=r"not empty and not a run \(it holds thesis\.tex\)") as error:
        RunFolder.create(foreign, CONFIG)
    one_line(error)
    (foreign / "config.json").write_text('{"lr": 1}')
    with pytest.raises(RunError, match="names no domain") as error:
        RunFolder.open(foreign)
    one_line(error)

    (run.path / "config.json").write_text('{"domain": "heav')
    with pytest.raises(RunError, match="corrupt or half-written") as error:
        RunFolder.open(run.path)
    one_line(error)

    file = tmp_path / "file"
    file.touch()
    with pytest.raises(RunError, match="Not a directory") as error:
        RunFolder.create(file / "run", CONFIG)
    one_line(error)


def test_a_corrupt_line_is_named(run):
    run.append(0, {"step": 1})
    with (run.seed_path(0) / "metrics.jsonl").open("a") as file:
        file.write('{"step": 2, "loss\n{"step": 3}\n')
    with pytest.raises(RunError, match=r"metrics\.jsonl:2: not a line of metrics") as error:
        run.metrics(0)
    one_line(error)


def test_a_full_disk_is_one_line_and_keeps_the_old_summary(run, monkeypatch):
    def no_space(_: int) -> None:
        raise OSError(28, "No space left on device")

    run.write_summary({"seeds": {}})
    monkeypatch.setattr(files.os, "fsync", no_space)
    with pytest.raises(RunError, match=r"summary\.json: No space left on device") as error:
        run.write_summary({"seeds": {"0": {}}})
    one_line(error)
    assert run.summary() == {"seeds": {}}


def test_trackers(run, monkeypatch):
    tracker = trackers.make_tracker("none", run)
    tracker.log(0, {"step": 1, "loss/td": 0.1})
    tracker.close()
    with pytest.raises(ConfigError, match="accepted: none, tensorboard, wandb"):
        trackers.make_tracker("comet", run)  # pyright: ignore[reportArgumentType]
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ConfigError, match="pip install"):
        trackers.make_tracker("wandb", run)


def test_tensorboard_gets_the_metrics_of_each_seed(run):
    pytest.importorskip("tensorboardX")
    tracker = trackers.make_tracker("tensorboard", run)
    for seed in (0, 3):
        tracker.log(seed, {"step": 10, "loss/td": np.float32(0.5), "loss/f": float("nan")})
    tracker.close()
    assert all(list((run.seed_path(seed) / "tensorboard").iterdir()) for seed in (0, 3))


class Clock:
    """A clock that moves when told."""

    def __init__(self, monkeypatch) -> None:
        self.now = 0.0
        monkeypatch.setattr(progress.time, "monotonic", lambda: self.now)


def test_plain_lines_come_at_a_steady_pace(monkeypatch):
    clock = Clock(monkeypatch)
    console = Console(file=io.StringIO(), force_terminal=False)
    with ProgressDisplay("stage 2", total=10_000, interval=10.0, console=console) as progress:
        progress.print("compiled in 11.8 s")
        for step in range(1000, 10_001, 1000):
            clock.now += 4.0
            progress.update(step, {"success": 0.5, "loss/td": 0.01234})
    lines = console.file.getvalue().splitlines()  # pyright: ignore[reportAttributeAccessIssue]
    assert lines[0] == "compiled in 11.8 s"
    assert lines[1] == "stage 2  1,000/10,000 steps  10%  250 steps/s  00:36 left  success 0.5  loss/td 0.0123"
    assert lines[-1].startswith("stage 2  10,000/10,000 steps  100%")
    assert len(lines) == 1 + 4  # after 4, 16, 28 and 40 seconds


def test_a_terminal_gets_a_bar(monkeypatch):
    clock = Clock(monkeypatch)
    console = Console(file=io.StringIO(), force_terminal=True, width=160, height=20, _environ={"TERM": "xterm"})
    with ProgressDisplay("stage 1", total=7200, start=3600, unit="epochs", console=console) as progress:
        clock.now += 1800.0
        progress.update(3601)
    text = console.file.getvalue()  # pyright: ignore[reportAttributeAccessIssue]
    assert "3,601/7,200 epochs" in text
    assert "1799:30:00 left" in text
    assert "━" in text


def test_config_is_plain_json(run):
    assert json.loads((run.path / "config.json").read_text())["critic_hidden"] == [256, 256]

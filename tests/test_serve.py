"""The policy server: what it answers, what it refuses, and that no client can harm another or the server."""

import base64
import hashlib
import json
import pathlib
import random
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from mijax import serve
from mijax.deploy.numpy_policy import VERSION, Instruction, Policy, Program

SHAPE, HORIZON = (2, 3), 2000
GOOD = [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """An export whose action is tanh of what was seen so far, weighted, and of the action before."""
    path = tmp_path_factory.mktemp("export")
    program = Program(
        ["memory.sum", "observation", "previous_action"], {"action": "v3", "next_memory.sum": "v1"},
        [Instruction("matmul", ("observation", "weights"), "v0", {}),
         Instruction("add", ("memory.sum", "v0"), "v1", {}),
         Instruction("add", ("v1", "previous_action"), "v2", {}),
         Instruction("tanh", ("v2",), "v3", {})],
        {"weights": np.array([0.5, -0.25, 0.125], np.float32)})
    program.save(path / "policy.npz")
    array = {"shape": [2], "dtype": "float32"}
    contract = {
        "mijax_policy": VERSION, "format": "npz", "horizon": HORIZON,
        "sha256": hashlib.sha256((path / "policy.npz").read_bytes()).hexdigest(),
        "observation": {"shape": SHAPE, "dtype": "float32", "low": 0.0, "high": 1.0, "unit": "m"},
        "action": array | {"low": -1.0, "high": 1.0}, "previous_action": array | {"at_start": 0.0},
        "memory": [array | {"name": "memory.sum"}]}
    (path / "policy.json").write_text(json.dumps(contract))
    return path


@pytest.fixture
def server(folder: pathlib.Path) -> Iterator[serve.Server]:
    """Listening on a port of its own."""
    with serve.Server(("127.0.0.1", 0), Policy.load(folder), connections=3) as running:
        thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield running
        running.shutdown()
        thread.join()


class Client:
    """A line, and the answer to it."""

    def __init__(self, server: serve.Server) -> None:
        self.socket = socket.create_connection(server.server_address[:2], timeout=10)  # pyright: ignore
        self._answers = self.socket.makefile("rb")

    def send(self, line: bytes) -> dict[str, Any]:
        self.socket.sendall(line + b"\n")
        return json.loads(self._answers.readline())

    def ask(self, **message: Any) -> dict[str, Any]:
        return self.send(json.dumps(message).encode())

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self._answers.close()
        self.socket.close()


def test_an_episode_over_tcp_is_the_policys(server: serve.Server, folder: pathlib.Path):
    policy = Policy.load(folder)
    packed = base64.b64encode(np.array(GOOD, "<f4").tobytes()).decode()
    with Client(server) as client:
        for number in (1, 2):
            assert client.ask(reset=True) == {"reset": True, "step": 0}
            policy.reset()
            first = policy.act(GOOD)
            assert client.ask(observation=GOOD, id=number) == {"id": number, "action": first.tolist(), "step": 1}
            assert client.ask(observation_base64=packed)["action"] == policy.act(GOOD).tolist()
            done = client.ask(observation=GOOD, previous_action=[0.5, -1])
            assert done == {"action": policy.act(GOOD, [0.5, -1]).tolist(), "step": 3}
        again = client.ask(reset=True, observation=GOOD)
        assert again == {"action": first.tolist(), "step": 1}
        assert client.ask(contract=True)["contract"]["horizon"] == HORIZON


REFUSED = [
    (b"", "not a line of JSON"), (b"\xff\xfe\x00", "not a line of JSON"), (b"[1, 2]", "not a JSON object"),
    (b"{}", "neither reset"), (b'{"observatoin": 1}', "unknown name"), (b'{"reset": false}', "can only be true"),
    (b'{"reset": true, "reset": true}', "twice"), (b'{"observation": [[NaN]]}', "NaN"),
    (b'{"observation": 3}', "no list of 2"), (b'{"observation": [[1, 2], [3, 4]]}', "no list of 3"),
    (b'{"observation": [[1, 2, 3], [0, 0, 0]]}', "accepted: 0 to 1 m"),
    (b'{"observation": [[true, 0, 0], [0, 0, 0]]}', "something else than numbers"),
    (b'{"observation": [[0, 0, 0], [0, 0, [1]]]}', "something else than numbers"),
    (b'{"observation": [[1e999, 0, 0], [0, 0, 0]]}', "not finite"),
    (b'{"observation": [[1' + b"0" * 400 + b', 0, 0], [0, 0, 0]]}', "no float"),
    (b'{"observation": [[' + b"1" * 4400 + b', 0, 0], [0, 0, 0]]}', "a line has more than"),
    (b'{"observation": ' + b"[" * 4000, "not a line of JSON"),
    (b'{"observation_base64": "AAAA"}', "not 24 bytes"), (b'{"observation_base64": 7}', "not 24 bytes"),
    (b'{"observation_base64": "\xc3\xa9"}', "not 24 bytes"), (b'{"previous_action": [0, 0]}', "without an observation"),
    (b'{"contract": true, "reset": true}', "together"), (b'{"reset": true, "id": 1.5}', "id: not"),
]


@pytest.mark.parametrize(("line", "reason"), REFUSED, ids=[f"{line[:24]!r}" for line, _ in REFUSED])
def test_what_is_refused_is_named_and_changes_nothing(folder: pathlib.Path, line: bytes, reason: str):
    policy = Policy.load(folder)
    conversation = serve.Conversation(policy)
    conversation.reply(json.dumps({"observation": GOOD}).encode())
    policy.act(GOOD)
    read = list(serve.lines(_Stream(line + b"\n").readline, conversation.longest_line))
    answer = json.loads(conversation.reply(read[0] if read else b""))
    assert reason in answer["error"]
    assert answer["step"] == 1
    follows = json.loads(conversation.reply(json.dumps({"observation": GOOD}).encode()))
    assert follows == {"action": policy.act(GOOD).tolist(), "step": 2}


def test_a_reset_whose_observation_is_refused_has_not_happened(folder: pathlib.Path):
    conversation = serve.Conversation(Policy.load(folder))
    conversation.reply(json.dumps({"observation": GOOD}).encode())
    answer = json.loads(conversation.reply(b'{"reset": true, "observation": [1]}'))
    assert answer["step"] == 1
    answer = json.loads(conversation.reply(json.dumps({"reset": True, "observation": GOOD, "previous_action": [0, 0]})
                                           .encode()))
    assert "first step" in answer["error"]
    assert answer["step"] == 1


class _Stream:
    """A stream that knows how much it was asked to hold at once."""

    def __init__(self, content: bytes) -> None:
        self._content, self.largest = content, 0

    def readline(self, limit: int) -> bytes:
        self.largest = max(self.largest, limit)
        end = self._content.find(b"\n") + 1 or len(self._content)
        line, self._content = self._content[: min(end, limit)], self._content[min(end, limit) :]
        return line


def test_long_lines_are_never_held():
    stream = _Stream(b"a\n" + b"x" * 1000 + b"\nb\r\n" + b"y" * 10 + b"\n" + b"z" * 10)
    assert list(serve.lines(stream.readline, 10)) == [b"a", None, b"b", b"y" * 10, b"z" * 10]
    assert stream.largest == 11


def malformed(rng: random.Random) -> bytes:
    """A line that no policy may accept."""
    def number() -> Any:
        return rng.choice([rng.random(), rng.randint(0, 1)])

    good = json.dumps({"observation": [[number() for _ in range(3)] for _ in range(2)]})
    rows, columns = rng.choice([(1, 3), (3, 2), (2, 4), (0, 0), (2, 0), (40, 3)])
    place = rng.randrange(6)
    values: list[Any] = [number() for _ in range(6)]
    values[place] = rng.choice([2.0, -0.5, 1e308, -1e39, None, "1", True, [0.5], {}, 10**300])
    special = json.dumps([values[:3], values[3:]])
    kind = rng.randrange(10)
    if kind == 0:  # of another shape
        return json.dumps({"observation": [[number() for _ in range(columns)] for _ in range(rows)]}).encode()
    if kind == 1:  # a value that is no number, or out of range
        return f'{{"observation": {special}}}'.encode()
    if kind == 2:  # not finite
        return good.replace("[[", f"[[{rng.choice(['NaN', 'Infinity', '-Infinity', '1e999'])}, ", 1).encode()
    if kind == 3:  # truncated
        return good[: rng.randrange(len(good))].encode()
    if kind == 4:  # far too long
        return b'{"observation": [' + b"0.5, " * rng.randint(5_000, 200_000)
    if kind == 5:  # binary
        return bytes(byte for byte in rng.randbytes(rng.randint(1, 4000)) if byte != 10) + b"\xff"
    if kind == 6:  # nested deeper than any parser goes
        return rng.choice([b"[", b'{"a":']) * rng.randint(1, 4000)
    if kind == 7:  # another message
        return json.dumps(rng.choice([
            {"reset": 1}, {"step": 3}, {"observation": GOOD, "action": [0, 0]}, {"contract": "yes"}, [], 7, None, "hi",
            {"observation": GOOD, "previous_action": [0.5]}, {"observation": GOOD, "previous_action": [0.5, 7]},
            {"observation": GOOD, "observation_base64": ""}, {"reset": True, "id": {}}])).encode()
    if kind == 8:  # encoded wrongly
        return json.dumps({"observation_base64": base64.b64encode(rng.randbytes(rng.choice([0, 23, 25, 999]))).decode()
                           + rng.choice(["", "=", "!"])}).encode()
    nan = np.array([rng.random()] * 5 + [rng.choice([np.nan, np.inf, -1.0, 3.0])], "<f4")
    return json.dumps({"observation_base64": base64.b64encode(nan.tobytes()).decode()}).encode()


def test_a_thousand_malformed_messages_harm_nobody(server: serve.Server, folder: pathlib.Path):
    """Each is refused with a reason; the sender's episode and another client's go on as if nothing had been said."""
    rng = random.Random(20)
    mine, others = Policy.load(folder), Policy.load(folder)
    with Client(server) as attacker, Client(server) as neighbour:
        assert attacker.ask(observation=GOOD)["action"] == mine.act(GOOD).tolist()
        for number in range(1000):
            line = malformed(rng)
            answer = attacker.send(line)
            assert set(answer) - {"id"} == {"error", "step"}, line[:200]
            assert answer["error"]
            assert answer["step"] == 1
            if number % 10 == 0:
                seen = [[rng.random() for _ in range(3)] for _ in range(2)]
                assert neighbour.ask(observation=seen)["action"] == others.act(seen).tolist()
            if number % 100 == 0:  # and one who leaves in the middle of a line
                with Client(server) as third:
                    third.socket.sendall(malformed(rng))
        assert attacker.ask(observation=GOOD) == {"action": mine.act(GOOD).tolist(), "step": 2}


@pytest.mark.parametrize(("option", "value"), [("--port", "70000"), ("--connections", "0")])
def test_options_that_cannot_be_used_are_named(option: str, value: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        serve.parse_arguments([option, value])
    assert f"{option}: got {value}, accepted" in capsys.readouterr().err


def test_more_connections_than_allowed_are_turned_away(server: serve.Server):
    clients = [Client(server) for _ in range(3)]
    assert all(client.ask(reset=True)["step"] == 0 for client in clients)
    with Client(server) as late:
        assert "no more connections" in json.loads(late._answers.readline())["error"]
    for client in clients:
        client.__exit__()
    for _ in range(100):  # a place is free once the server has seen the others leave
        with Client(server) as later:
            answer = later._answers.readline() if later.socket.sendall(b'{"reset": true}\n') else b""
            answer = answer or later._answers.readline()
            if b"error" not in answer:
                return
    pytest.fail("no place came free")


def test_the_command_serves_until_it_is_told_to_stop(folder: pathlib.Path):
    command = [sys.executable, "-m", "mijax.serve", str(folder), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address, port = process.stdout.readline().removeprefix("serving on ").strip().split(":")
        with socket.create_connection((address, int(port)), timeout=10) as connection:
            connection.sendall(b'{"reset": true}\n')
            assert json.loads(connection.makefile().readline()) == {"reset": True, "step": 0}
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=10)
    assert (process.returncode, errors) == (0, "")


def test_what_cannot_be_served_is_named(tmp_path: pathlib.Path, folder: pathlib.Path,
                                        capsys: pytest.CaptureFixture[str]):
    assert serve.main([str(tmp_path)]) == 1
    assert "no exported policy" in capsys.readouterr().err
    assert serve.main([str(folder), "--host", "no.such.host.invalid", "--port", "0"]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1

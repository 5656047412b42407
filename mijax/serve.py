"""`python -m mijax.serve EXPORT [--port N]`: an exported policy for other programs, a line of JSON per message.

    {"reset": true}                         -> {"reset": true, "step": 0}
    {"observation": [[...], ...]}           -> {"action": [0.1, -0.4, 0.0, 0.9], "step": 1}
    {"observation": "nonsense"}             -> {"error": "observation: ...", "step": 1}

Over TCP, or over standard input and output without --port. Each connection has an episode of its own. What is refused
changes nothing. docs/deploy.md has the whole protocol. With a policy.npz this file needs NumPy alone, and exports carry
a copy of it: `python serve.py --port 5555` in an exported folder.
"""

import argparse
import base64
import binascii
import contextlib
import itertools
import json
import pathlib
import signal
import socket
import socketserver
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, BinaryIO

import numpy as np

try:
    from mijax.deploy.numpy_policy import Policy, PolicyError, Refused
except ImportError:  # copied beside a policy, where mijax is not installed
    from numpy_policy import Policy, PolicyError, Refused  # pyright: ignore[reportMissingImports]

REQUESTS = frozenset({"reset", "observation", "observation_base64", "previous_action", "contract", "id"})
LINE_OVERHEAD = 4096
"""Bytes that a message may have beside its observation's numbers."""
BYTES_PER_NUMBER = 32
"""A double written out has up to 25, and a comma."""


class Conversation:
    """One client's episode."""

    def __init__(self, policy: Policy) -> None:
        """Args: policy: shared by all clients; this one's memory is its own."""
        self._policy = policy.another()

    @property
    def longest_line(self) -> int:
        """Bytes of the longest message that is read."""
        return LINE_OVERHEAD + BYTES_PER_NUMBER * int(np.prod(self._policy.contract["observation"]["shape"]))

    def reply(self, line: bytes | None) -> bytes:
        """The answer to a line, itself a line; None stands for one that was too long to be read."""
        answer: dict[str, Any] = {}
        try:
            if line is None:
                raise Refused(f"a line has more than {self.longest_line} bytes")
            message = parse(line)
            if "id" in message:
                answer["id"] = _identity(message["id"])
            answer |= self._answer(message)
        except Refused as error:
            answer |= {"error": str(error), "step": self._policy.steps}
        return json.dumps(answer, allow_nan=False).encode() + b"\n"

    def _answer(self, message: dict[str, Any]) -> dict[str, Any]:
        for name in ("reset", "contract"):
            if name in message and message[name] is not True:
                raise Refused(f"{name}: can only be true")
        encoded = {"observation", "observation_base64"} & set(message)
        if len(encoded) == 2:
            raise Refused("observation: given twice")
        if "contract" in message:
            if set(message) - {"contract", "id"}:
                raise Refused("contract: asked for together with something else")
            return {"contract": self._policy.contract}
        policy = self._policy.another() if "reset" in message else self._policy
        answer: dict[str, Any] = {}
        if encoded:
            observation = self._observation(message)
            previous = None
            if "previous_action" in message:
                spec = self._policy.contract["action"]
                previous = numbers("previous_action", message["previous_action"], tuple(spec["shape"]))
            action = policy.act(observation, previous)
            answer = {"action": action if isinstance(action, int) else [float(x) for x in action]}
        elif "previous_action" in message:
            raise Refused("previous_action: without an observation")
        elif "reset" in message:
            answer = {"reset": True}
        else:
            raise Refused("neither reset, observation nor contract")
        self._policy = policy  # only now: a reset whose observation is refused has not happened
        return answer | {"step": policy.steps}

    def _observation(self, message: dict[str, Any]) -> np.ndarray:
        spec = self._policy.contract["observation"]
        shape, dtype = tuple(spec["shape"]), np.dtype(spec["dtype"]).newbyteorder("<")
        if "observation" in message:
            return numbers("observation", message["observation"], shape)
        text = message["observation_base64"]
        try:
            data = base64.b64decode(text, validate=True) if isinstance(text, str) else b""
        except (binascii.Error, ValueError):
            data = b""
        wanted = dtype.itemsize * int(np.prod(shape))
        if len(data) != wanted:
            raise Refused(f"observation_base64: not {wanted} bytes in base64, of {spec['dtype']}, little-endian")
        return np.frombuffer(data, dtype).reshape(shape)


def parse(line: bytes) -> dict[str, Any]:
    """The message in a line; `Refused` for anything but one strict JSON object with known names."""
    try:
        message = json.loads(line.decode("utf-8"), parse_constant=_no_constant, object_pairs_hook=_once)
    except Refused:
        raise
    except (ValueError, RecursionError):
        raise Refused("not a line of JSON") from None
    if not isinstance(message, dict):
        raise Refused("not a JSON object")
    unknown = sorted(set(message) - REQUESTS)
    if unknown:
        raise Refused(f"unknown name {unknown[0][:40]!r}, accepted: {', '.join(sorted(REQUESTS))}")
    return message


def _no_constant(name: str) -> None:
    raise Refused(f"not JSON: {name}")


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise Refused("a name occurs twice")
    return found


def _identity(value: Any) -> str | int:
    if isinstance(value, bool) or not isinstance(value, str | int) or len(str(value)) > 64:
        raise Refused("id: not a whole number or a string of at most 64 characters")
    return value


def numbers(name: str, nested: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Nested lists of JSON numbers as a float64 array of that shape; `Refused` for anything else."""
    flat = [nested]
    for axis, length in enumerate(shape):
        if not all(type(part) is list and len(part) == length for part in flat):
            raise Refused(f"{name}: its shape is not {shape}: axis {axis} is no list of {length}")
        flat = list(itertools.chain.from_iterable(flat))
    if not set(map(type, flat)) <= {int, float}:
        raise Refused(f"{name}: its shape is not {shape}, or it holds something else than numbers")
    try:
        return np.array(flat, np.float64).reshape(shape)
    except OverflowError:
        raise Refused(f"{name}: holds a number that no float can be") from None


def lines(readline: Callable[[int], bytes], longest: int) -> Iterator[bytes | None]:
    """Lines without their ends; None for each that is longer than `longest` bytes: no more of it is ever held.

    `readline` returns at most so many bytes of a line, b"" at the end.
    """
    while line := readline(longest + 1):
        if len(line) > longest and not line.endswith(b"\n"):
            while (rest := readline(longest + 1)) and not rest.endswith(b"\n"):
                pass
            yield None
        else:
            yield line.rstrip(b"\r\n")


def converse(policy: Policy, source: BinaryIO, sink: BinaryIO) -> None:
    """Answer every line of a stream until it ends."""
    conversation = Conversation(policy)
    for line in lines(source.readline, conversation.longest_line):
        sink.write(conversation.reply(line))
        sink.flush()


class Server(socketserver.ThreadingTCPServer):
    """A thread and an episode for each connection."""

    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, address: tuple[str, int], policy: Policy, connections: int) -> None:
        """Args: address: host and port, 0 for any that is free; policy: shared; connections: at most, at a time."""
        self.policy = policy
        self._room = threading.BoundedSemaphore(connections)
        super().__init__(address, _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Turn away who comes when all places are taken."""
        if self._room.acquire(blocking=False):
            super().process_request(request, client_address)
            return
        with contextlib.suppress(OSError):
            request.settimeout(1.0)
            request.sendall(b'{"error": "no more connections are accepted"}\n')
        self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """One connection, from beginning to end."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._room.release()


class _Handler(socketserver.StreamRequestHandler):
    server: Server
    disable_nagle_algorithm = True  # an answer is one small packet, wanted at once

    def handle(self) -> None:
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)  # a client that lost power leaves
        with contextlib.suppress(OSError):  # the client has gone
            converse(self.server.policy, self.rfile, self.wfile)  # pyright: ignore[reportArgumentType]


def parse_arguments(arguments: Sequence[str]) -> argparse.Namespace:
    """The command's options."""
    parser = argparse.ArgumentParser(
        prog="python -m mijax.serve", description="Serve an exported policy, a line of JSON per message.")
    parser.add_argument("export", type=pathlib.Path, nargs="?", default=pathlib.Path(__file__).parent,
                        help="folder of an exported policy; default: the folder of this file")
    parser.add_argument("--port", type=int, help="TCP port, 0 for any that is free; default: standard input and output")
    parser.add_argument("--host", default="127.0.0.1",
                        help="address to listen on; nobody is asked for a password, so keep to networks you trust")
    parser.add_argument("--connections", type=int, default=16, help="at most so many at a time")
    options = parser.parse_args(list(arguments))
    if options.port is not None and not 0 <= options.port < 2**16:
        parser.error(f"--port: got {options.port}, accepted: 0 to {2**16 - 1}")
    if options.connections < 1:
        parser.error(f"--connections: got {options.connections}, accepted: a number >= 1")
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """The command."""
    options = parse_arguments(sys.argv[1:] if arguments is None else arguments)
    try:
        policy = Policy.load(options.export)
        if options.port is None:
            converse(policy, sys.stdin.buffer, sys.stdout.buffer)
            return 0
        server = Server((options.host, options.port), policy, options.connections)
    except (PolicyError, OSError, OverflowError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 0
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with server:
        print("serving on {}:{}".format(*server.server_address[:2]), flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever(poll_interval=0.1)
    return 0


if __name__ == "__main__":
    sys.exit(main())

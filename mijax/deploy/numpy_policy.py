"""Run an exported policy with NumPy and the standard library alone. Exports carry a copy of this file.

    from numpy_policy import Policy              # or mijax.deploy.numpy_policy
    policy = Policy.load("FOLDER")
    policy.reset()                               # at the start of every episode
    action = policy.act(observation)             # once per step

`python numpy_policy.py [FOLDER]` measures its speed on this machine. This file and `mijax.serve` keep to what Python
3.10 and NumPy 1.21 have: robots' computers are seldom the newest.
"""

import hashlib
import json
import pathlib
import sys
import time
import zipfile
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

CONTRACT_FILE = "policy.json"
FILES = {"npz": "policy.npz", "onnx": "policy.onnx", "stablehlo": "policy.stablehlo"}
"""What each format is stored in, beside the contract."""
VERSION = 1
"""Of the contract and of the program in a policy.npz; a reader knows one."""
NEEDED = frozenset({"horizon", "observation", "action", "previous_action", "memory", "sha256"})
"""What a contract cannot do without."""
NEXT = "next_"
"""Begins the name of the output that a leaf of the memory becomes."""
SLACK = 1e-6
"""By how much a float may lie outside its range: what float32 leaves of a bound."""

Arrays = Mapping[str, np.ndarray]
Step = Callable[[Arrays], Arrays]
"""One step: observation, previous_action and the memory's leaves -> action, the next leaves and, with discrete actions,
values. A pure function."""


class PolicyError(Exception):
    """A folder holds no policy that can be run here; the message is one line."""


class Refused(ValueError):
    """What a policy was given is not what its contract asks for; the message is one line and nothing was changed."""


# ------------------------------------------------------------------------------------------------------------ programs


class Instruction(NamedTuple):
    """`output = operation(*inputs, **attributes)`."""

    operation: str
    inputs: tuple[str, ...]
    output: str
    attributes: dict[str, Any]


def _logistic(x: np.ndarray) -> np.ndarray:
    return 0.5 * np.tanh(0.5 * x) + 0.5  # 1 / (1 + exp(-x)) overflows


def _slice(start: Sequence[int], stop: Sequence[int], step: Sequence[int]) -> Callable[[np.ndarray], np.ndarray]:
    part = tuple(map(slice, start, stop, step))
    return lambda x: x[part]


OPERATIONS: dict[str, Callable[..., Callable[..., Any]]] = {
    **{name: lambda function=function: function for name, function in {
        "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "max": np.maximum, "min": np.minimum,
        "neg": np.negative, "abs": np.abs, "exp": np.exp, "log": np.log, "tanh": np.tanh, "sqrt": np.sqrt,
        "logistic": _logistic, "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal,
        "gt": np.greater, "ge": np.greater_equal, "and": np.logical_and, "or": np.logical_or, "not": np.logical_not,
        "matmul": np.matmul, "where": np.where,
    }.items()},
    "reshape": lambda shape: lambda x: x.reshape(shape),
    "transpose": lambda axes: lambda x: x.transpose(axes),
    "expand": lambda shape: lambda x: np.broadcast_to(x, shape),
    "slice": _slice,
    "concatenate": lambda axis: lambda *parts: np.concatenate(parts, axis),
    "cast": lambda dtype: lambda x: x.astype(dtype),
    "sum": lambda axes: lambda x: x.sum(axes, dtype=x.dtype),
    "greatest": lambda axes: lambda x: x.max(axes),
    "argmax": lambda axis: lambda x: x.argmax(axis).astype(np.int32),
    "take": lambda: lambda x, index: x.take(index, 0, mode="clip"),
}
"""The operations that a program is made of, with their attributes. Names and broadcasting are NumPy's; `take` gathers
rows, and `where` is (bool, where true, where false)."""


class Program:
    """A step as a list of instructions, each of a known operation: data, not code."""

    def __init__(
        self, inputs: Sequence[str], outputs: Mapping[str, str], code: Sequence[Instruction],
        constants: Mapping[str, np.ndarray],
    ) -> None:
        """Args:
            inputs: names of the arrays that a step takes.
            outputs: name of each array that it gives -> the value that it is.
            code: instructions in the order of their evaluation.
            constants: the weights, by name.

        Raises:
            KeyError: an unknown operation or value.
        """
        self.inputs, self.outputs, self.code, self.constants = tuple(inputs), dict(outputs), tuple(code), constants
        slots = {name: slot for slot, name in enumerate((*constants, *inputs))}
        steps = []
        for instruction in self.code:
            function = OPERATIONS[instruction.operation](**instruction.attributes)
            sources = tuple(slots[name] for name in instruction.inputs)
            slots.setdefault(instruction.output, len(slots))
            steps.append((function, sources, slots[instruction.output]))
        self._steps = steps
        self._start = [*constants.values(), *[None] * (len(slots) - len(constants))]
        self._given = [(name, slots[name]) for name in inputs]
        self._wanted = [(name, slots[value]) for name, value in outputs.items()]

    def __call__(self, inputs: Arrays) -> dict[str, np.ndarray]:
        """Evaluate one step."""
        values: list[Any] = self._start.copy()
        for name, slot in self._given:
            values[slot] = inputs[name]
        for function, sources, slot in self._steps:
            values[slot] = function(*[values[source] for source in sources])
        return {name: np.asarray(values[slot]) for name, slot in self._wanted}

    def save(self, path: pathlib.Path) -> None:
        """Write `path`, an npz: the constants, and the rest as JSON under the name `program`."""
        text = json.dumps({"version": VERSION, "inputs": self.inputs, "outputs": self.outputs, "code": self.code})
        with path.open("wb") as file:
            np.savez(file, allow_pickle=False, program=np.frombuffer(text.encode(), np.uint8), **self.constants)

    @classmethod
    def load(cls, path: pathlib.Path) -> "Program":
        """Read what `save` wrote; `PolicyError` for anything else."""
        try:
            with np.load(path, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            described = json.loads(arrays.pop("program").tobytes())
            code = [Instruction(operation, tuple(inputs), output, {name: _tuples(x) for name, x in attributes.items()})
                    for operation, inputs, output, attributes in described["code"]]
            return cls(described["inputs"], described["outputs"], code, arrays)
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise PolicyError(f"{path}: not a policy's program ({type(error).__name__}: {error})") from None


def _tuples(x: Any) -> Any:
    return tuple(x) if isinstance(x, list) else x


# ------------------------------------------------------------------------------------------------------------ policies


class Policy:
    """A policy in the middle of an episode: what it remembers, and a step that it shares with others."""

    def __init__(self, contract: Mapping[str, Any], step: Step) -> None:
        """Start an episode. Args: contract: what policy.json says; step: shared, never changed."""
        self.contract, self._step = contract, step
        self.horizon: int = contract["horizon"]
        self.reset()

    @classmethod
    def load(cls, folder: str | pathlib.Path) -> "Policy":
        """The policy in an exported folder; `PolicyError` when there is none that can be run here."""
        folder = pathlib.Path(folder)
        contract = read_contract(folder)
        return cls(contract, load_step(folder, contract))

    def another(self) -> "Policy":
        """The same policy at the start of an episode of its own."""
        return Policy(self.contract, self._step)

    def reset(self) -> None:
        """Forget everything: an episode starts."""
        self.steps = 0
        self._memory = {leaf["name"]: np.zeros(leaf["shape"], leaf["dtype"]) for leaf in self.contract["memory"]}
        given = self.contract["previous_action"]
        self._previous = np.full(given["shape"], given["at_start"], given["dtype"])

    def act(self, observation: Any, previous_action: Any = None) -> Any:
        """The greedy action after one more observation.

        Args:
            observation: of the contract's shape and range.
            previous_action: what was really done since the last observation, where that is not the last answer.

        Returns:
            An int, or (A,) float32.

        Raises:
            Refused: an argument is not what the contract asks for, or the episode is over. The memory is as it was.
        """
        if self.steps >= self.horizon:
            raise Refused(f"the episode is over: it has {self.horizon} steps; reset first")
        seen, previous = checked("observation", observation, self.contract["observation"]), self._previous
        if previous_action is not None:
            if self.steps == 0:
                raise Refused("previous_action: an episode's first step has none")
            previous = checked("previous_action", previous_action, self.contract["action"])
        outputs = self._step({"observation": seen, "previous_action": previous, **self._memory})
        action = np.array(outputs["action"])
        # The action alone would not tell: the largest of values that are no numbers is the first.
        if not all(np.isfinite(np.asarray(array, np.float64)).all() for array in outputs.values()):
            raise Refused("the policy answers with a number that is not finite, or would remember one")
        self._memory = {name: outputs[NEXT + name] for name in self._memory}
        self._previous, self.steps = action, self.steps + 1
        return int(action) if action.ndim == 0 else action.copy()


def checked(name: str, value: Any, spec: Mapping[str, Any]) -> np.ndarray:
    """`value` as an array of the dtype that `spec` asks for; `Refused` unless shape, kind and range are right."""
    try:
        array = np.asarray(value)
    except (ValueError, OverflowError):
        raise Refused(f"{name}: not an array of numbers") from None
    if array.dtype.kind == "b" and (spec["dtype"], spec["low"], spec["high"]) == ("uint8", 0, 1):
        array = array.astype(np.uint8)
    if array.dtype.kind not in "iuf":
        raise Refused(f"{name}: not an array of numbers")
    if array.shape != tuple(spec["shape"]):
        raise Refused(f"{name}: its shape is {array.shape}, expected {tuple(spec['shape'])}")
    if not np.isfinite(array).all():
        raise Refused(f"{name}: holds a number that is not finite")
    blank = spec.get("blank_channels", 0)
    if blank and array[..., -blank:].any():
        raise Refused(f"{name}: holds something in the last {blank} of its channels, where only 0 belongs")
    dtype = np.dtype(spec["dtype"])
    whole = dtype.kind in "iu"
    if whole and (array != np.floor(array)).any():
        raise Refused(f"{name}: holds a fraction, expected {dtype}")
    slack, limits = (0, np.iinfo(dtype)) if whole else (SLACK, np.finfo(dtype))
    low, high = (limit if bound is None else bound for bound, limit in (
        (spec["low"], float(limits.min)), (spec["high"], float(limits.max))))
    smallest, greatest = float(array.min()), float(array.max())
    if smallest < low - slack or greatest > high + slack:
        worst = smallest if smallest < low - slack else greatest
        raise Refused(f"{name}: holds {worst:.6g}, accepted: {low:.6g} to {high:.6g}{_unit(spec)}")
    return array.astype(dtype)


def _unit(spec: Mapping[str, Any]) -> str:
    return f" {spec['unit']}" if spec.get("unit") else ""


def read_contract(folder: pathlib.Path) -> dict[str, Any]:
    """What policy.json says; `PolicyError` unless it is whole and belongs to the file beside it."""
    path = folder / CONTRACT_FILE
    try:
        contract = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise PolicyError(f"{folder}: no exported policy (no {CONTRACT_FILE})") from None
    except (OSError, ValueError) as error:
        raise PolicyError(f"{path}: cannot be read ({error})") from None
    if not isinstance(contract, dict) or contract.get("mijax_policy") != VERSION or contract.get("format") not in FILES:
        raise PolicyError(f"{path}: not the contract of a policy of version {VERSION}")
    lacking = sorted(NEEDED - set(contract))
    if lacking:
        raise PolicyError(f"{path}: says nothing of {lacking[0]}")
    file = folder / FILES[contract["format"]]
    try:
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError as error:
        raise PolicyError(f"{file}: {error.strerror}") from None
    if digest != contract["sha256"]:
        raise PolicyError(f"{file}: not the policy that {CONTRACT_FILE} describes (its SHA-256 differs)")
    return contract


def load_step(folder: pathlib.Path, contract: Mapping[str, Any]) -> Step:
    """The step of an exported policy; formats other than npz need mijax and what `mijax[deploy]` installs."""
    path = folder / FILES[contract["format"]]
    if contract["format"] == "npz":
        return Program.load(path)
    try:
        from mijax.deploy import runtimes
    except ImportError:
        raise PolicyError(f"{path}: needs mijax, which is not installed; NumPy alone runs --to npz") from None
    return runtimes.load(contract["format"], path)


def measure(policy: Policy, seconds: float = 2.0) -> np.ndarray:
    """(N,) seconds that single steps took, over about so many seconds, on observations of 0 or what is next to it."""
    spec = policy.contract["observation"]
    low, high = (0 if bound is None else bound for bound in (spec["low"], spec["high"]))
    observation = np.full(spec["shape"], low if low > 0 else min(0, high), spec["dtype"])
    taken: list[float] = []
    started = time.perf_counter()
    while time.perf_counter() - started < seconds:
        if policy.steps == policy.horizon:
            policy.reset()
        before = time.perf_counter()
        policy.act(observation)
        taken.append(time.perf_counter() - before)
    policy.reset()
    return np.array(taken)


def main(arguments: Sequence[str]) -> int:
    """Measure the policy in the folder that is named, or in this file's."""
    try:
        policy = Policy.load(arguments[0] if arguments else pathlib.Path(__file__).parent)
    except PolicyError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    taken = 1e3 * measure(policy)
    print(f"{len(taken)} steps: {1e3 / taken.mean():.0f} per second; median {np.median(taken):.2f} ms, "
          f"99 % below {np.percentile(taken, 99):.2f} ms")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""From a JAX function to a `Program`: its jaxpr, in the few operations that NumPy and ONNX have in common.

What does not depend on the inputs is computed here, once: weights come out in the layout that they are used in, and
random numbers of a fixed seed as constants.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from mijax.deploy.numpy_policy import OPERATIONS, Instruction, Program

Shapes = Mapping[str, jax.ShapeDtypeStruct]


class NotTraceable(Exception):
    """A function does what a program has no operation for; the message names it."""


@dataclasses.dataclass(frozen=True)
class _Value:
    """An array of the function: known here, or named in the program."""

    shape: tuple[int, ...]
    dtype: Any
    name: str = ""
    known: Any = None  # an array; None: depends on the inputs


def trace(function: Callable[[Any], Any], inputs: Shapes) -> Program:
    """The program of a function of a dictionary of arrays that returns such a dictionary.

    Args:
        function: traceable by JAX.
        inputs: shape and dtype of each array.

    Raises:
        NotTraceable: it does what a program has no operation for.
    """
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(dict(inputs))
    writer = _Writer()
    names = sorted(inputs)  # the order in which JAX flattens dictionaries
    given = [_Value(tuple(inputs[name].shape), np.dtype(inputs[name].dtype), name) for name in names]
    found = writer.evaluate(closed, given)
    outputs = {name: writer.name_of(value) for name, value in zip(sorted(shapes), found, strict=True)}
    code = _needed(writer.code, set(outputs.values()))
    used = {name for instruction in code for name in instruction.inputs} | set(outputs.values())
    constants = {name: value for name, value in writer.constants.items() if name in used}
    return Program(names, outputs, code, constants)


def _needed(code: Sequence[Instruction], wanted: set[str]) -> list[Instruction]:
    """The instructions on which the `wanted` values depend."""
    kept = []
    for instruction in reversed(code):
        if instruction.output in wanted:
            kept.append(instruction)
            wanted = wanted | set(instruction.inputs)
    return kept[::-1]


class _Writer:
    """Writes instructions, evaluates those whose inputs are known."""

    def __init__(self) -> None:
        self.code: list[Instruction] = []
        self.constants: dict[str, np.ndarray] = {}
        self._expanded: dict[str, _Value] = {}  # values that are others, expanded

    def name_of(self, value: _Value) -> str:
        """The value's name in the program."""
        if value.known is None:
            return value.name
        array = np.asarray(value.known)
        for name, constant in self.constants.items():
            if constant is array:
                return name
        name = f"c{len(self.constants)}"
        self.constants[name] = array
        return name

    def emit(
        self, operation: str, inputs: Sequence[_Value], shape: Sequence[int], dtype: Any = None, /, **attributes: Any
    ) -> _Value:
        """One instruction, or its result where all inputs are known. `dtype`: None for that of the first input."""
        shape, dtype = tuple(map(int, shape)), np.dtype(inputs[0].dtype if dtype is None else dtype)
        if dtype.name not in ("float32", "int32", "uint32", "uint8", "bool"):
            raise NotTraceable(f"arrays of {dtype.name}")
        if all(value.known is not None for value in inputs):
            result = np.asarray(OPERATIONS[operation](**attributes)(*(np.asarray(value.known) for value in inputs)))
            return known(np.broadcast_to(result, shape).astype(dtype))
        value = _Value(shape, dtype, f"v{len(self.code)}")
        self.code.append(Instruction(operation, tuple(map(self.name_of, inputs)), value.name, attributes))
        return value

    def elementwise(self, operation: str, *inputs: _Value, dtype: Any = None) -> _Value:
        """An operation that broadcasts by itself: inputs that were expanded for it are used as they were."""
        shape = inputs[-1].shape
        narrow = [self._expanded.get(value.name, value) if value.known is None else value for value in inputs]
        if np.broadcast_shapes(*(value.shape for value in narrow)) == shape:
            inputs = tuple(narrow)
        return self.emit(operation, inputs, shape, dtype)

    def reshape(self, x: _Value, shape: Sequence[int]) -> _Value:
        """The same numbers in another shape."""
        return x if x.shape == tuple(shape) else self.emit("reshape", [x], shape, shape=tuple(map(int, shape)))

    def transpose(self, x: _Value, axes: Sequence[int]) -> _Value:
        """The axes in another order."""
        if tuple(axes) == tuple(range(len(axes))):
            return x
        return self.emit("transpose", [x], [x.shape[axis] for axis in axes], axes=tuple(map(int, axes)))

    def expand(self, x: _Value, shape: Sequence[int]) -> _Value:
        """Repeated along axes of length 1."""
        if x.shape == tuple(shape):
            return x
        wide = self.emit("expand", [x], shape, shape=tuple(map(int, shape)))
        if wide.known is None:
            self._expanded[wide.name] = x
        return wide

    def slice(self, x: _Value, start: Sequence[int], stop: Sequence[int], step: Sequence[int]) -> _Value:
        """A part of every axis."""
        shape = [len(range(*bounds)) for bounds in zip(start, stop, step, strict=True)]
        start, stop, step = (tuple(map(int, bounds)) for bounds in (start, stop, step))
        return self.emit("slice", [x], shape, start=start, stop=stop, step=step)

    def evaluate(self, closed: Any, inputs: Sequence[_Value]) -> list[_Value]:
        """The outputs of a closed jaxpr."""
        jaxpr = closed.jaxpr
        values = dict(zip(jaxpr.constvars, map(known, closed.consts), strict=True))
        values |= dict(zip(jaxpr.invars, inputs, strict=True))

        def read(atom: Any) -> _Value:
            return known(atom.val, cast(Any, atom.aval).dtype) if isinstance(atom, core.Literal) else values[atom]

        for equation in jaxpr.eqns:
            results = self._equation(equation, [read(atom) for atom in equation.invars])
            values |= dict(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def _equation(self, equation: Any, inputs: list[_Value]) -> list[_Value]:
        name, parameters = equation.primitive.name, equation.params
        inner = parameters.get("jaxpr", parameters.get("call_jaxpr"))
        if inner is not None and name in _CALLS:
            return self.evaluate(inner, inputs)
        opaque = any(isinstance(value.known, jax.Array) for value in inputs)  # random keys, of which JAX alone knows
        bitwise = name in _LOGICAL and equation.outvars[0].aval.dtype != np.bool_  # and their bits
        if name in _RULES and not opaque and not bitwise:
            results = _RULES[name](self, inputs, parameters, [variable.aval for variable in equation.outvars])
            return results if isinstance(results, list) else [results]
        if all(value.known is not None for value in inputs):
            results = equation.primitive.bind(*(value.known for value in inputs), **parameters)
            return [known(x) for x in (results if equation.primitive.multiple_results else [results])]
        raise NotTraceable(f"the operation {name!r}")


def known(array: Any, dtype: Any = None) -> _Value:
    """An array that does not depend on the inputs; arrays of random keys stay JAX's."""
    if not (isinstance(array, jax.Array) and jnp.issubdtype(array.dtype, jax.dtypes.extended)):
        array = np.asarray(array, dtype)
    return _Value(tuple(array.shape), array.dtype, known=array)


# --------------------------------------------------------------------------------------------------------------- rules

_Rule = Callable[[_Writer, list[_Value], Mapping[str, Any], list[Any]], _Value | list[_Value]]
_CALLS = ("jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "remat", "checkpoint")
_LOGICAL = ("and", "or", "not")


def _same(writer: _Writer, inputs: list[_Value], parameters: Mapping[str, Any], out: list[Any]) -> list[_Value]:
    del writer, parameters, out
    return inputs


def _wide(writer: _Writer, x: _Value, shape: Sequence[int]) -> _Value:
    """A scalar, or an array with axes of length 1, in the shape of the others."""
    return writer.expand(x if x.shape else writer.reshape(x, (1,) * len(shape)), shape)


def _elementwise(operation: str) -> _Rule:
    def rule(writer: _Writer, inputs: list[_Value], _: Mapping[str, Any], out: list[Any]) -> _Value:
        if operation == "div" and np.dtype(out[0].dtype).kind != "f":
            raise NotTraceable("a division of whole numbers")
        return writer.elementwise(operation, *(_wide(writer, x, out[0].shape) for x in inputs), dtype=out[0].dtype)

    return rule


def _power(writer: _Writer, inputs: list[_Value], parameters: Mapping[str, Any], out: list[Any]) -> _Value:
    del out
    x, exponent = inputs[0], parameters["y"]
    if exponent < 1:
        raise NotTraceable(f"a power of {exponent}")
    result = x
    for _ in range(exponent - 1):
        result = writer.elementwise("mul", result, x)
    return result


def _square(writer: _Writer, inputs: list[_Value], _: Mapping[str, Any], out: list[Any]) -> _Value:
    return writer.elementwise("mul", inputs[0], inputs[0], dtype=out[0].dtype)


def _reciprocal_root(writer: _Writer, inputs: list[_Value], _: Mapping[str, Any], out: list[Any]) -> _Value:
    one = known(np.ones(out[0].shape, out[0].dtype))
    return writer.elementwise("div", one, writer.elementwise("sqrt", inputs[0]))


def _select(writer: _Writer, inputs: list[_Value], _: Mapping[str, Any], out: list[Any]) -> _Value:
    which, *cases = inputs
    if which.dtype != np.bool_ or len(cases) != 2:
        raise NotTraceable("a choice among more than two")
    wide = (_wide(writer, x, out[0].shape) for x in (which, cases[1], cases[0]))
    return writer.elementwise("where", *wide, dtype=out[0].dtype)


def _convert(writer: _Writer, inputs: list[_Value], parameters: Mapping[str, Any], _: list[Any]) -> _Value:
    x, dtype = inputs[0], np.dtype(parameters["new_dtype"])
    return x if x.dtype == dtype else writer.emit("cast", [x], x.shape, dtype, dtype=dtype.name)


def _broadcast(writer: _Writer, inputs: list[_Value], parameters: Mapping[str, Any], _: list[Any]) -> _Value:
    x, shape = inputs[0], parameters["shape"]
    lengths = dict(zip(parameters["broadcast_dimensions"], x.shape, strict=True))
    return writer.expand(writer.reshape(x, [lengths.get(axis, 1) for axis in range(len(shape))]), shape)


def _reshape(writer: _Writer, inputs: list[_Value], parameters: Mapping[str, Any], out: list[Any]) -> _Value:
    del parameters
    return writer.reshape(inputs[0], out[0].shape)


def _transpose(writer: _Writer, inputs: list[_Value], parameters: Mapping[str, Any], _: list[Any]) -> _Value:
    return writer.transpose(inputs[0], parameters["permutation"])


def _slice(writer: _Writer, inputs: list[_Value], parameters: Mapping[str, Any], _: list[Any]) -> _Value:
    start, stop = parameters["start_indices"], parameters["limit_indices"]
    return writer.slice(inputs[0], start, stop, parameters["strides"] or (1,) * len(start))


def _split(writer: _Writer, inputs: list[_Value], parameters: Mapping[str, Any], _: list[Any]) -> list[_Value]:
    x, axis = inputs[0], parameters["axis"]
    ends = np.cumsum(parameters["sizes"])
    parts = []
    for begin, end in zip((0, *ends[:-1]), ends, strict=True):
        start, stop = [0] * len(x.shape), list(x.shape)
        start[axis], stop[axis] = begin, end
        parts.append(writer.slice(x, start, stop, [1] * len(start)))
    return parts


def _concatenate(writer: _Writer, inputs: list[_Value], parameters: Mapping[str, Any], out: list[Any]) -> _Value:
    return writer.emit("concatenate", inputs, out[0].shape, axis=int(parameters["dimension"]))


def _stack(writer: _Writer, inputs: list[_Value], parameters: Mapping[str, Any], out: list[Any]) -> _Value:
    axis = int(parameters["axis"])
    single = [*out[0].shape[:axis], 1, *out[0].shape[axis + 1 :]]
    return writer.emit("concatenate", [writer.reshape(x, single) for x in inputs], out[0].shape, axis=axis)


def _product(writer: _Writer, inputs: list[_Value], parameters: Mapping[str, Any], out: list[Any]) -> _Value:
    """A general dot product as a batched matrix product of rank 2 or 3."""
    (left_sum, right_sum), (left_batch, right_batch) = parameters["dimension_numbers"]
    left, right = inputs

    def free(x: _Value, *used: Sequence[int]) -> list[int]:
        return [axis for axis in range(len(x.shape)) if axis not in {a for axes in used for a in axes}]

    def lengths(x: _Value, axes: Sequence[int]) -> list[int]:
        return [x.shape[axis] for axis in axes]

    rows, columns = free(left, left_sum, left_batch), free(right, right_sum, right_batch)
    batch = [int(np.prod(lengths(left, left_batch)))] if left_batch else []
    m, n = int(np.prod(lengths(left, rows))), int(np.prod(lengths(right, columns)))
    k = int(np.prod(lengths(left, left_sum)))
    a = writer.reshape(writer.transpose(left, [*left_batch, *rows, *left_sum]), [*batch, m, k])
    b = writer.reshape(writer.transpose(right, [*right_batch, *right_sum, *columns]), [*batch, k, n])
    return writer.reshape(writer.emit("matmul", [a, b], [*batch, m, n], out[0].dtype), out[0].shape)


def _reduction(operation: str) -> _Rule:
    def rule(writer: _Writer, inputs: list[_Value], parameters: Mapping[str, Any], out: list[Any]) -> _Value:
        return writer.emit(operation, inputs, out[0].shape, axes=tuple(map(int, parameters["axes"])))

    return rule


def _argmax(writer: _Writer, inputs: list[_Value], parameters: Mapping[str, Any], out: list[Any]) -> _Value:
    if len(parameters["axes"]) != 1 or np.dtype(parameters["index_dtype"]) != np.int32:
        raise NotTraceable("an argmax over several axes")
    return writer.emit("argmax", inputs, out[0].shape, np.int32, axis=int(parameters["axes"][0]))


def _iota(writer: _Writer, inputs: list[_Value], parameters: Mapping[str, Any], _: list[Any]) -> _Value:
    del writer, inputs
    shape, axis = parameters["shape"], parameters["dimension"]
    lengths = [-1 if a == axis else 1 for a in range(len(shape))]
    return known(np.broadcast_to(np.arange(shape[axis], dtype=parameters["dtype"]).reshape(lengths), shape).copy())


def _gather(writer: _Writer, inputs: list[_Value], parameters: Mapping[str, Any], out: list[Any]) -> _Value:
    """Rows of a table, `table[index]`: the only kind that the networks use, with indices that are in range."""
    table, index = inputs
    numbers, rank = parameters["dimension_numbers"], len(table.shape)
    trailing = tuple(range(len(out[0].shape) - rank + 1, len(out[0].shape)))
    rows = (tuple(numbers.start_index_map) == tuple(numbers.collapsed_slice_dims) == (0,)
            and tuple(parameters["slice_sizes"]) == (1, *table.shape[1:]) and tuple(numbers.offset_dims) == trailing
            and index.shape[-1] == 1)
    if not rows:
        raise NotTraceable("a gather that is not of rows")
    return writer.emit("take", [table, writer.reshape(index, index.shape[:-1])], out[0].shape)


_RULES: dict[str, _Rule] = {
    **{name: _elementwise(name) for name in (
        "add", "sub", "mul", "div", "max", "min", "neg", "abs", "exp", "log", "tanh", "sqrt", "logistic", "eq", "ne",
        "lt", "le", "gt", "ge")},
    **{name: _elementwise(name) for name in _LOGICAL},
    **dict.fromkeys(("stop_gradient", "copy", "copy_p", "optimization_barrier"), _same),
    **dict.fromkeys(("reshape", "squeeze", "expand_dims"), _reshape),
    "integer_pow": _power, "square": _square, "rsqrt": _reciprocal_root, "select_n": _select,
    "convert_element_type": _convert, "broadcast_in_dim": _broadcast, "transpose": _transpose, "slice": _slice,
    "split": _split, "concatenate": _concatenate, "stack": _stack, "dot_general": _product,
    "reduce_sum": _reduction("sum"), "reduce_max": _reduction("greatest"), "argmax": _argmax, "iota": _iota,
    "gather": _gather,
}

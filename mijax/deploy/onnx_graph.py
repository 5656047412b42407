"""A `Program` as an ONNX model: one or two nodes for each instruction."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from mijax.deploy.numpy_policy import Instruction, Program

OPSET = 18
"""Reductions take their axes as an input from here on; runtimes since 2023 have it."""

_SAME_NAME = {
    "add": "Add", "sub": "Sub", "mul": "Mul", "div": "Div", "max": "Max", "min": "Min", "neg": "Neg", "abs": "Abs",
    "exp": "Exp", "log": "Log", "tanh": "Tanh", "sqrt": "Sqrt", "logistic": "Sigmoid", "eq": "Equal", "lt": "Less",
    "le": "LessOrEqual", "gt": "Greater", "ge": "GreaterOrEqual", "and": "And", "or": "Or", "not": "Not",
    "matmul": "MatMul", "where": "Where",
}


class _Graph:
    """Nodes and constants of a model in the making."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def add(self, kind: str, inputs: tuple[str, ...], output: str, **attributes: Any) -> str:
        """A node; its output's name."""
        self.nodes.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def integers(self, values: Any) -> str:
        """A constant list of int64: what shapes, axes and bounds are given as."""
        name = f"integers{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(values, np.int64), name))
        return name


def _ne(graph: _Graph, step: Instruction) -> None:
    graph.add("Not", (graph.add("Equal", step.inputs, f"{step.output}_equal"),), step.output)


def _slice(graph: _Graph, step: Instruction) -> None:
    bounds = step.attributes
    axes = range(len(bounds["start"]))
    lists = (bounds["start"], bounds["stop"], axes, bounds["step"])
    graph.add("Slice", (*step.inputs, *(graph.integers(list(values)) for values in lists)), step.output)


def _argmax(graph: _Graph, step: Instruction) -> None:
    found = graph.add("ArgMax", step.inputs, f"{step.output}_int64", axis=step.attributes["axis"], keepdims=0)
    graph.add("Cast", (found,), step.output, to=TensorProto.INT32)


def _shaped(kind: str) -> Callable[[_Graph, Instruction], None]:
    def write(graph: _Graph, step: Instruction) -> None:
        graph.add(kind, (*step.inputs, graph.integers(step.attributes["shape"])), step.output)

    return write


def _reduced(kind: str) -> Callable[[_Graph, Instruction], None]:
    def write(graph: _Graph, step: Instruction) -> None:
        graph.add(kind, (*step.inputs, graph.integers(step.attributes["axes"])), step.output, keepdims=0)

    return write


_WRITERS: dict[str, Callable[[_Graph, Instruction], Any]] = {
    **{name: lambda graph, step, kind=kind: graph.add(kind, step.inputs, step.output)
       for name, kind in _SAME_NAME.items()},
    "ne": _ne, "slice": _slice, "argmax": _argmax, "reshape": _shaped("Reshape"), "expand": _shaped("Expand"),
    "sum": _reduced("ReduceSum"), "greatest": _reduced("ReduceMax"),
    "transpose": lambda graph, step: graph.add("Transpose", step.inputs, step.output, perm=step.attributes["axes"]),
    "concatenate": lambda graph, step: graph.add("Concat", step.inputs, step.output, axis=step.attributes["axis"]),
    "take": lambda graph, step: graph.add("Gather", step.inputs, step.output, axis=0),
    "cast": lambda graph, step: graph.add("Cast", step.inputs, step.output, to=_kind(step.attributes["dtype"])),
}


def _kind(dtype: Any) -> int:
    return helper.np_dtype_to_tensor_dtype(np.dtype(dtype))


def to_onnx(
    program: Program, inputs: Mapping[str, jax.ShapeDtypeStruct], outputs: Mapping[str, jax.ShapeDtypeStruct]
) -> onnx.ModelProto:
    """The model of a program, its inputs and outputs under their names; checked by ONNX itself.

    Args:
        program: of any operations.
        inputs: shape and dtype of each of its inputs.
        outputs: of each of its outputs.
    """
    graph = _Graph()
    graph.constants += [numpy_helper.from_array(np.ascontiguousarray(value).reshape(value.shape), name)
                        for name, value in program.constants.items()]
    for instruction in program.code:
        _WRITERS[instruction.operation](graph, instruction)
    for name, value in program.outputs.items():
        graph.add("Identity", (value,), name)
    described = [[helper.make_tensor_value_info(name, _kind(x.dtype), x.shape) for name, x in group.items()]
                 for group in (inputs, outputs)]
    model = helper.make_model(
        helper.make_graph(graph.nodes, "policy", *described, initializer=graph.constants),
        opset_imports=[helper.make_opsetid("", OPSET)], producer_name="mijax", ir_version=9)
    onnx.checker.check_model(model, full_check=True)
    return model

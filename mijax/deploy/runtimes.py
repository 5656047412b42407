"""Steps of exported policies in the formats that need more than NumPy: ONNX Runtime, and JAX for StableHLO."""

import importlib
import pathlib
from typing import Any

import numpy as np

from mijax.deploy.numpy_policy import Arrays, PolicyError, Step

WRITES = {"npz": (), "onnx": ("onnx", "onnxruntime"), "stablehlo": ("flatbuffers",)}
"""Packages beyond the library's own that exporting a format needs."""


def require(kind: str, *packages: str) -> None:
    """Raise `PolicyError` unless the packages that a format needs are installed."""
    for package in packages:
        try:
            importlib.import_module(package)
        except ImportError:
            raise PolicyError(
                f"{kind}: the package {package} is missing; install it with: pip install -e '.[deploy]'") from None


def load(kind: str, path: pathlib.Path) -> Step:
    """The step stored in `path`; `PolicyError` when it, or the package that runs it, cannot be had."""
    return {"onnx": load_onnx, "stablehlo": load_stablehlo}[kind](path)


def load_onnx(path: pathlib.Path) -> Step:
    """Run by ONNX Runtime on one core: a policy is too small for several."""
    require("onnx", "onnxruntime")
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its errors share no base class but this one
        raise PolicyError(f"{path}: not an ONNX model ({str(error).splitlines()[0][:200]})") from None
    taken = {one.name for one in session.get_inputs()}
    names = [one.name for one in session.get_outputs()]

    def step(arrays: Arrays) -> dict[str, np.ndarray]:
        results: Any = session.run(names, {name: array for name, array in arrays.items() if name in taken})
        return dict(zip(names, results, strict=True))

    return step


def load_stablehlo(path: pathlib.Path) -> Step:
    """Compiled by JAX for the device at hand, here and not in the first step, which would take seconds."""
    require("stablehlo", "jax", "flatbuffers")
    import jax
    from jax import export

    try:
        exported = export.deserialize(bytearray(path.read_bytes()))
    except Exception as error:  # a flatbuffer reader: whatever a damaged file makes it do
        raise PolicyError(f"{path}: not an exported JAX program ({type(error).__name__})") from None
    shapes, _ = jax.tree.unflatten(
        exported.in_tree, [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in exported.in_avals])
    compiled = jax.jit(exported.call).lower(*shapes).compile()

    def step(arrays: Arrays) -> dict[str, np.ndarray]:
        return {name: np.asarray(array) for name, array in compiled(dict(arrays)).items()}

    return step

"""How much arithmetic a computation needs, counted before any compiler has touched it.

Only matrix products and convolutions are counted, two operations per multiply-add:

    product      2 x batch x rows x columns x contracted
    convolution  2 x (elements of the output) x (input channels of one group) x (pixels of the kernel)

A loop counts as often as it runs, of several branches the dearest counts, and what no output depends on is left out.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
from jax.extend import core


def operations(function: Callable, *arguments: Any) -> float:
    """Floating-point operations of the products and convolutions in `function(*arguments)`."""
    return _count(jax.make_jaxpr(function)(*arguments).jaxpr)


def _count(jaxpr: core.Jaxpr) -> float:
    needed = {var for var in jaxpr.outvars if not isinstance(var, core.Literal)}
    total = 0.0
    for equation in reversed(jaxpr.eqns):
        if equation.effects or not needed.isdisjoint(equation.outvars):
            needed.update(var for var in equation.invars if not isinstance(var, core.Literal))
            total += _of_equation(equation)
    return total


def _of_equation(equation: core.JaxprEqn) -> float:
    name, parameters = equation.primitive.name, equation.params
    if name == "dot_general":
        (contracted, _), _ = parameters["dimension_numbers"]
        shape = _shape(equation.invars[0])
        return 2.0 * math.prod(_shape(equation.outvars[0])) * math.prod(shape[axis] for axis in contracted)
    if name == "conv_general_dilated":
        numbers, kernel = parameters["dimension_numbers"], _shape(equation.invars[1])
        per_output = math.prod(kernel) / kernel[numbers.rhs_spec[0]]
        return 2.0 * math.prod(_shape(equation.outvars[0])) * per_output
    inner = [_count(jaxpr) for value in parameters.values() for jaxpr in _jaxprs(value)]
    if name == "cond":
        return max(inner)
    return sum(inner) * parameters.get("length", 1) if name == "scan" else sum(inner)


def _shape(var: Any) -> tuple[int, ...]:
    return var.aval.shape


def _jaxprs(value: Any) -> Iterator[core.Jaxpr]:
    if isinstance(value, core.ClosedJaxpr):
        yield value.jaxpr
    elif isinstance(value, core.Jaxpr):
        yield value
    elif isinstance(value, (tuple, list)):
        for item in value:
            yield from _jaxprs(item)

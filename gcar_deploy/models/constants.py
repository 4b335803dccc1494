"""How large a graph's constants become once they are computed.

A few bytes of file can say "a tensor of 2^40 zeros", and ONNX Runtime works such nodes out as it
loads the model, before anything runs. Here the sizes of all nodes whose inputs are constant are
bounded without computing them, and sizes that are constant are read. Sizes that depend on the
input are not seen here.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

#: tensors with more elements than this are no shapes, and their values are not kept
MOST_VALUES = 64
#: operator -> inputs that say how large its output is
_SIZES = {
    "ConstantOfShape": (0,), "Expand": (1,), "Tile": (1,), "Range": (0, 1, 2), "Pad": (1,),
    "Resize": (2, 3),
}  # fmt: skip
#: element by element, shapes broadcast
_BROADCAST = frozenset(
    """
    Add And Div Equal Greater GreaterOrEqual Less LessOrEqual Max Mean Min Mod Mul Not Or PRelu Pow
    Sub Sum Where Xor
    """.split()  # noqa: SIM905 - a table to read
)
#: no larger than their first input, whatever the others say
_NO_LARGER = frozenset(
    """
    ArgMax ArgMin BatchNormalization Clip CumSum DequantizeLinear GroupNormalization
    InstanceNormalization LayerNormalization QuantizeLinear ReduceL1 ReduceL2 ReduceLogSumExp
    ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare Reshape Slice Split Squeeze
    Trilu Unsqueeze
    """.split()  # noqa: SIM905 - a table to read
)
#: attributes say how large; no network computes them from constants alone
_NEVER = frozenset({"AveragePool", "Conv", "ConvTranspose", "MaxPool", "Pad", "Resize"})


@dataclasses.dataclass(frozen=True)
class Constant:
    """A tensor that does not depend on the model's input.

    Attributes
    ----------
    elements : how many at most
    dims : its shape, None where that is not known
    values : of small tensors that stand in the file, else None
    """

    elements: int
    dims: tuple[int, ...] | None = None
    values: tuple[float, ...] | None = None


@dataclasses.dataclass(frozen=True)
class Node:
    """One node of the graph; ``value`` is what an operator ``Constant`` holds."""

    operator: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    value: Constant | None = None


def check_constants(weights: Mapping[str, Constant], nodes: Sequence[Node], most: int) -> None:
    """Refuse constants, or constant sizes, of more than ``most`` elements.

    Parameters
    ----------
    weights : by name
    nodes : of the graph, in any order
    most : elements of one size, and of all computed constants together

    Raises
    ------
    ValueError
        The end of a sentence about the file.
    """
    known = dict(weights)
    users: dict[str, list[int]] = {}
    missing = [set(filter(None, node.inputs)) for node in nodes]
    for k, names in enumerate(missing):
        for name in names:
            users.setdefault(name, []).append(k)
    total, ready = 0, [k for k, names in enumerate(missing) if not names]
    new = list(known)
    while ready or new:
        for name in new:
            for k in users.pop(name, ()):
                missing[k].discard(name)
                if not missing[k]:
                    ready.append(k)
        new = []
        for k in ready:
            made = nodes[k].value or _computed(nodes[k], known, most)
            total += made.elements if nodes[k].value is None else 0
            if total > most:
                raise ValueError(f"computes constants of more than {most} elements")
            for name in nodes[k].outputs:
                known[name] = made
                new.append(name)
        ready = []
    for node in nodes:
        _constant_size(node, known, most)


def _computed(node: Node, known: Mapping[str, Constant], most: int) -> Constant:
    """Bound what a node makes of constants alone."""
    if node.operator in _NEVER:
        raise ValueError(f"computes {node.operator} of constants, which is not allowed")
    inputs = [known[name] for name in node.inputs if name]
    first = max(inputs[0].elements, 1) if inputs else 1
    size = _constant_size(node, known, most)
    if size is not None:
        if node.operator == "Tile":
            return Constant(first * size.elements)
        return _broadcast([*inputs[:-1], size]) if node.operator == "Expand" else size
    if node.operator in _BROADCAST:
        return _broadcast(inputs)
    if node.operator in _NO_LARGER:
        return Constant(first)
    if node.operator == "Concat":
        return Constant(sum(one.elements for one in inputs))
    if node.operator == "Shape":
        return Constant(8)
    if node.operator == "MatMul" and len(inputs) == 2:
        a, b = inputs[0].dims or (), inputs[1].dims or ()
        if 1 <= len(a) <= 2 and 1 <= len(b) <= 2:
            dims = a[:-1] + b[1:]
            return Constant(math.prod(dims), dims)
    return Constant(math.prod(max(one.elements, 1) for one in inputs))


def _broadcast(inputs: Sequence[Constant]) -> Constant:
    if inputs and all(one is inputs[0] for one in inputs):  # one shape, known or not
        return Constant(inputs[0].elements, inputs[0].dims)
    shapes = [one.dims for one in inputs if one.dims is not None]
    if len(shapes) < len(inputs):
        return Constant(math.prod(max(one.elements, 1) for one in inputs))
    rank = max(map(len, shapes), default=0)
    full = [(1,) * (rank - len(shape)) + shape for shape in shapes]
    dims = tuple(max(sides) for sides in zip(*full, strict=True))
    return Constant(math.prod(dims), dims)


def _constant_size(node: Node, known: Mapping[str, Constant], most: int) -> Constant | None:
    """Read what a node's constant sizes ask for, ``Tile`` as a multiple; None without such."""
    places = _SIZES.get(node.operator, ())
    names = [node.inputs[k] if k < len(node.inputs) else "" for k in places]
    if node.operator == "Resize":  # scales or sizes: the other is left out or empty
        names = [name for name in names if name and (name not in known or known[name].elements)]
    told = [known.get(name) for name in names]
    if not told or any(one is None for one in told):
        return None
    values = [one.values for one in told if one is not None]
    if any(value is None for value in values):
        raise ValueError(f"gives {node.operator} a size that is computed from constants")
    size = _asked(node.operator, [value or () for value in values])
    if not size <= most:
        raise ValueError(f"asks {node.operator} for more than {most} elements")
    shape = values[0] if node.operator in ("ConstantOfShape", "Expand") else None
    dims = None if shape is None else tuple(int(value) for value in shape)
    return Constant(math.ceil(size), dims)


def _asked(operator: str, values: Sequence[tuple[float, ...]]) -> float:
    if operator == "Range":
        if any(len(value) != 1 for value in values) or values[2][0] == 0:
            return math.inf
        return max((values[1][0] - values[0][0]) / values[2][0], 0.0)
    if operator == "Pad":
        pads = [max(value, 0.0) for value in values[0]]
        half = len(pads) // 2
        sides = zip(pads[:half], pads[half:], strict=False)
        return math.prod(1.0 + before + after for before, after in sides)
    return max(math.prod(max(float(value), 0.0) for value in one) for one in values)

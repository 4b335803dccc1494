"""What an ONNX file holds, checked before any library builds a graph from it.

A model is a program: its graph may loop, draw random numbers, call operators of other vendors
or name files elsewhere on the disk. Here the file's own structure (protocol buffers, as laid
down in ``onnx.proto``) is walked byte by byte, and everything that a feed-forward network of
this project does not need is refused. Nothing is built or run; how large the graph's constants
become is reckoned in ``constants``. Functions raise ``ValueError`` with the end of a
sentence; ``read_model`` puts the name of the file in front.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np

from gcar_deploy.config import ModelLimits
from gcar_deploy.models.constants import MOST_VALUES, Constant, Node, check_constants

#: operators that compute values from values: no control flow (Loop, If, Scan), nothing random,
#: no text, sequences or optional values, and no scatters, whose repeated indices race
OPERATORS = frozenset(
    """
    Abs Add And ArgMax ArgMin AveragePool BatchNormalization Cast Ceil Clip Concat Constant
    ConstantOfShape Conv ConvTranspose CumSum DepthToSpace DequantizeLinear Div Elu Equal Erf Exp
    Expand Flatten Floor Gather GatherElements GatherND Gelu Gemm GlobalAveragePool GlobalMaxPool
    Greater GreaterOrEqual GroupNormalization HardSigmoid HardSwish Identity InstanceNormalization
    LayerNormalization LeakyRelu Less LessOrEqual Log LogSoftmax MatMul Max MaxPool Mean Min Mod
    Mul Neg Not Or PRelu Pad Pow QuantizeLinear Range Reciprocal ReduceL1 ReduceL2 ReduceLogSumExp
    ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare Relu Reshape Resize Round
    Shape Sigmoid Sign Size Slice Softmax Softplus Softsign SpaceToDepth Split Sqrt Squeeze Sub Sum
    Tanh Tile Transpose Trilu Unsqueeze Where Xor
    """.split()  # noqa: SIM905 - a table to read
)
_DAMAGED = "is damaged or no ONNX model; copy or export it again"
#: fields that are read or harmless, per message of onnx.proto; any other is refused
_MODEL_FIELDS = {1, 2, 3, 4, 5, 6, 7, 8, 14}
_GRAPH_FIELDS = {1, 2, 5, 10, 11, 12, 13, 16}
_NODE_FIELDS = {1, 2, 3, 4, 5, 6, 7, 9}
_ATTRIBUTE_FIELDS = {1, 2, 3, 4, 5, 7, 8, 9, 13, 20}
_TENSOR_FIELDS = {1, 2, 4, 5, 7, 8, 9, 10, 11, 12, 13, 14, 16}
#: what the refused fields are, for the message
_REFUSED = {
    ("model", 25): "functions of its own", ("model", 20): "training steps",
    ("graph", 15): "sparse weights", ("node", 8): "overloads",
    ("attribute", 6): "a graph within the graph", ("attribute", 11): "a graph within the graph",
    ("tensor", 3): "weights in segments", ("tensor", 6): "text",
}  # fmt: skip
#: data type -> (bytes per element in raw_data, NumPy type for the finite check)
_TYPES: dict[int, tuple[int, str | None]] = {
    1: (4, "<f4"), 2: (1, None), 3: (1, None), 6: (4, None), 7: (8, None), 9: (1, None),
    10: (2, "<f2"), 11: (8, "<f8"),
}  # fmt: skip
#: types whose small tensors may be sizes: NumPy types of their raw data
_RAW_NUMBERS = {1: "<f4", 2: "u1", 3: "i1", 6: "<i4", 7: "<i8", 10: "<f2", 11: "<f8"}
#: bytes of packed whole numbers, which take longer to count than raw data
_MAX_PACKED = 2**20
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


@dataclasses.dataclass
class _Walk:
    """Limits, and how many fields were met so far: a file of nothing but fields takes long."""

    limits: ModelLimits
    fields: int = 0


def check_onnx(data: bytes, limits: ModelLimits) -> None:
    """Walk an ONNX file and refuse what this project's networks do not need.

    Parameters
    ----------
    data : bytes of the file
    limits : ModelLimits

    Raises
    ------
    ValueError
        Not ONNX; external data; an operator, domain or opset that is not allowed; a graph
        within the graph; a tensor whose size is not that of its data; weights not finite;
        constants that become too large.
    """
    walk, graphs = _Walk(limits), 0
    for number, value in _message(walk, "model", memoryview(data), _MODEL_FIELDS):
        if number == 7:
            graphs += 1
            _check_graph(_bytes(value), walk)
        elif number == 8:
            _check_opset(_bytes(value), walk)
    if graphs != 1:
        raise ValueError(_DAMAGED)


def _check_graph(data: memoryview, walk: _Walk) -> None:
    elements = 0
    nodes: list[Node] = []
    weights: dict[str, Constant] = {}
    for number, value in _message(walk, "graph", data, _GRAPH_FIELDS):
        if number == 1:
            nodes.append(_check_node(_bytes(value), walk))
            held = nodes[-1].value
            elements += 0 if held is None else held.elements
        elif number == 5:
            name, held = _check_tensor(_bytes(value), walk, finite=True)
            elements += held.elements
            if name in weights:
                raise ValueError(f"has two weights of the name {name[:40]!r}")
            weights[name] = held
        if len(nodes) > walk.limits.max_nodes:
            raise ValueError(f"has more than {walk.limits.max_nodes} nodes")
        if elements > walk.limits.max_elements:
            raise ValueError(f"has more than {walk.limits.max_elements} weights")
    if not nodes:
        raise ValueError(_DAMAGED)
    check_constants(weights, nodes, walk.limits.max_elements)


def _check_opset(data: memoryview, walk: _Walk) -> None:
    for number, value in _message(walk, "opset", data, {1, 2}):
        if number == 1:
            _check_domain(_text(value))
        elif not isinstance(value, int) or not 1 <= value <= walk.limits.max_opset:
            raise ValueError(f"has an opset outside 1 .. {walk.limits.max_opset}")


def _check_domain(domain: str) -> None:
    if domain not in ("", "ai.onnx"):
        raise ValueError(f"uses operators of {domain[:40]!r}; only standard ones are allowed")


def _check_node(data: memoryview, walk: _Walk) -> Node:
    operator = ""
    inputs: list[str] = []
    outputs: list[str] = []
    held: list[Constant] = []
    numbers: list[float] = []
    for number, value in _message(walk, "node", data, _NODE_FIELDS):
        if number in (1, 2):
            (inputs if number == 1 else outputs).append(_text(value))
        elif number == 4:
            operator = _text(value)
        elif number == 7:
            _check_domain(_text(value))
        elif number == 5:
            for field, part in _message(walk, "attribute", _bytes(value), _ATTRIBUTE_FIELDS):
                if field == 5:
                    held.append(_check_tensor(_bytes(part), walk, finite=False)[1])
                elif field in (2, 3, 7, 8):
                    numbers += _numbers({2: 4, 7: 4}.get(field, 7), part)
    if operator not in OPERATORS:
        raise ValueError(f"uses operator {operator[:40]!r}, which is not allowed")
    if operator != "Constant":
        return Node(operator, tuple(inputs), tuple(outputs), None)
    if len(held) + bool(numbers) > 1:
        raise ValueError(_DAMAGED)
    if not held:
        held = [Constant(len(numbers), (len(numbers),), tuple(numbers[:MOST_VALUES]))]
    return Node(operator, (), tuple(outputs), held[-1])


def _check_tensor(data: memoryview, walk: _Walk, *, finite: bool) -> tuple[str, Constant]:
    """Compare a tensor's shape with its data; return its name and what it holds."""
    dims: list[int] = []
    name, kind, raw, typed = "", 0, None, 0
    values: list[float] = []
    for number, value in _message(walk, "tensor", data, _TENSOR_FIELDS):
        if number == 13 or (number == 14 and value != 0):
            raise ValueError("keeps weights in another file (external data); export it as one file")
        if number == 1:
            dims += _whole(value)
        elif number == 2:
            kind = value if isinstance(value, int) else 0
        elif number == 8:
            name = _text(value)
        elif number == 9:
            raw = _bytes(value)
        elif number in (4, 5, 7, 10, 11):
            typed += _count_typed(number, value, finite=finite)
            if typed <= MOST_VALUES:
                values += _numbers(number, value)
    if kind not in _TYPES:
        raise ValueError(f"has a tensor of data type {kind}, which is not allowed")
    elements = math.prod(dims)
    if len(dims) > 8 or any(d >= 2**63 for d in dims) or elements > walk.limits.max_elements:
        raise ValueError("has a tensor that is larger than allowed")
    width, numeric = _TYPES[kind]
    held = typed if raw is None else len(raw) / width
    if held != elements or (raw is not None and typed):
        raise ValueError("has a tensor whose data are not of its size; export it again")
    if finite and raw is not None and numeric and not _finite(raw, numeric):
        raise ValueError("has weights that are not finite")
    if elements > MOST_VALUES:
        return name, Constant(elements, tuple(dims))
    if raw is not None and kind in _RAW_NUMBERS:
        values = np.frombuffer(raw, _RAW_NUMBERS[kind]).tolist()
    known = tuple(values) if len(values) == elements else None
    return name, Constant(elements, tuple(dims), known)


def _count_typed(number: int, value: int | memoryview, *, finite: bool) -> int:
    """Count the elements in one of the typed fields of a tensor (float, int, double)."""
    width = {4: 4, 10: 8}.get(number)
    if width is None or isinstance(value, int):
        return len(_whole(value))
    if len(value) % width:
        raise ValueError(_DAMAGED)
    if finite and not _finite(value, f"<f{width}"):
        raise ValueError("has weights that are not finite")
    return len(value) // width


def _numbers(number: int, value: int | memoryview) -> list[float]:
    """Read one of a tensor's typed fields: 4 float, 10 double, the others whole numbers."""
    width = {4: 4, 10: 8}.get(number)
    if width is None or isinstance(value, int):
        return [whole - 2**64 if whole >= 2**63 else whole for whole in _whole(value)]
    if len(value) % width:
        raise ValueError(_DAMAGED)
    return [float(one) for one in np.frombuffer(value, f"<f{width}")]


def _finite(data: memoryview, numeric: str) -> bool:
    return bool(np.isfinite(np.frombuffer(data, numeric)).all())


def _message(
    walk: _Walk, name: str, data: memoryview, known: set[int]
) -> Iterator[tuple[int, int | memoryview]]:
    for number, value in _fields(data):
        walk.fields += 1
        if walk.fields > walk.limits.max_fields:
            raise ValueError(f"has more than {walk.limits.max_fields} parts")
        if number not in known:
            what = _REFUSED.get((name, number), f"field {number} in its {name}")
            raise ValueError(f"holds {what}, which is not allowed")
        yield number, value


def _fields(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Yield (number, value) of each field of a protocol buffer; lengths are checked."""
    at, end = 0, len(data)
    while at < end:
        key, at = _varint(data, at)
        number, wire = key >> 3, key & 7
        if not 0 < number < 2**29:
            raise ValueError(_DAMAGED)
        if wire == _VARINT:
            value, at = _varint(data, at)
            yield number, value
            continue
        if wire == _BYTES:
            size, at = _varint(data, at)
        elif wire in (_FIXED32, _FIXED64):
            size = 4 if wire == _FIXED32 else 8
        else:
            raise ValueError(_DAMAGED)
        if at + size > end:
            raise ValueError(_DAMAGED)
        yield number, data[at : at + size]
        at += size


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        if at >= len(data) or shift > 63:
            raise ValueError(_DAMAGED)
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
        shift += 7


def _whole(value: int | memoryview) -> list[int]:
    """Whole numbers of a repeated field, packed or single."""
    if isinstance(value, int):
        return [value]
    if len(value) > _MAX_PACKED:
        raise ValueError("has large whole-number data that are not raw; export it again")
    out, at = [], 0
    while at < len(value):
        number, at = _varint(value, at)
        out.append(number)
    return out


def _bytes(value: int | memoryview) -> memoryview:
    if isinstance(value, int):
        raise ValueError(_DAMAGED)
    return value


def _text(value: int | memoryview) -> str:
    try:
        return str(_bytes(value), "utf-8")
    except UnicodeDecodeError:
        raise ValueError(_DAMAGED) from None

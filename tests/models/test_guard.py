"""Every way a graph can be more than a feed-forward network is refused before it is built."""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gcar_deploy.config import ModelLimits
from gcar_deploy.models.constants import Constant, Node, check_constants
from gcar_deploy.models.guard import OPERATORS, check_onnx
from gcar_deploy.predict.kinds import MULTI

onnx = pytest.importorskip("onnx", reason="needs the export extra")
from google.protobuf.message import DecodeError  # noqa: E402
from onnx import TensorProto, helper, numpy_helper  # noqa: E402
from onnx.reference import ReferenceEvaluator  # noqa: E402

TINY = Path(__file__).parents[1] / "data" / "tiny.onnx"


def model() -> onnx.ModelProto:
    """y = Relu(x w), the smallest graph with a weight."""
    weight = numpy_helper.from_array(np.ones((3, 2), np.float32), "w")
    nodes = [helper.make_node("MatMul", ["x", "w"], ["h"]), helper.make_node("Relu", ["h"], ["y"])]
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3])
    y = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 2])
    graph = helper.make_graph(nodes, "g", [x], [y], [weight])
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)])


def inner() -> onnx.GraphProto:
    y = helper.make_tensor_value_info("z", TensorProto.FLOAT, [1])
    return helper.make_graph([helper.make_node("Relu", ["y"], ["z"])], "inner", [], [y])


def external(m: onnx.ModelProto) -> None:
    tensor = m.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    entry = tensor.external_data.add()
    entry.key, entry.value = "location", "../../secret"


def external_named_only(m: onnx.ModelProto) -> None:
    entry = m.graph.initializer[0].external_data.add()
    entry.key, entry.value = "location", "/etc/hostname"


def external_in_a_constant(m: onnx.ModelProto) -> None:
    tensor = onnx.TensorProto(dims=[1], data_type=1, data_location=TensorProto.EXTERNAL)
    m.graph.node.append(helper.make_node("Constant", [], ["c"], value=tensor))


def control(operator: str) -> Callable[[onnx.ModelProto], None]:
    def change(m: onnx.ModelProto) -> None:
        m.graph.node.append(helper.make_node(operator, ["y"], ["z"], body=inner()))

    return change


def hidden_graph(m: onnx.ModelProto) -> None:
    m.graph.node[1].attribute.append(helper.make_attribute("body", inner()))


def hidden_graphs(m: onnx.ModelProto) -> None:
    m.graph.node[1].attribute.append(helper.make_attribute("bodies", [inner()]))


def operator(name: str) -> Callable[[onnx.ModelProto], None]:
    return lambda m: m.graph.node.append(helper.make_node(name, ["y"], ["z"]))


def domain(m: onnx.ModelProto) -> None:
    m.graph.node[1].domain = "com.microsoft"


def imported_domain(m: onnx.ModelProto) -> None:
    m.opset_import.append(helper.make_opsetid("com.evil", 1))


def function(m: onnx.ModelProto) -> None:
    nodes = [helper.make_node("Relu", ["a"], ["b"])]
    opsets = [helper.make_opsetid("", 18)]
    m.functions.append(helper.make_function("", "Relu2", ["a"], ["b"], nodes, opsets))


def sparse(m: onnx.ModelProto) -> None:
    m.graph.sparse_initializer.add().dims.append(4)


def huge(m: onnx.ModelProto) -> None:
    del m.graph.initializer[0].dims[:]
    m.graph.initializer[0].dims.extend([2**31, 2**31])


def negative(m: onnx.ModelProto) -> None:
    m.graph.initializer[0].dims[0] = -3


def short(m: onnx.ModelProto) -> None:
    m.graph.initializer[0].raw_data = m.graph.initializer[0].raw_data[:-4]


def twice(m: onnx.ModelProto) -> None:
    m.graph.initializer[0].float_data.extend([1.0] * 6)


def filled(value: float, *, typed: bool) -> Callable[[onnx.ModelProto], None]:
    def change(m: onnx.ModelProto) -> None:
        tensor = m.graph.initializer[0]
        tensor.ClearField("raw_data")
        if typed:
            tensor.float_data.extend([value] * 6)
        else:
            tensor.raw_data = np.full(6, value, np.float32).tobytes()

    return change


def text(m: onnx.ModelProto) -> None:
    m.graph.initializer.append(helper.make_tensor("s", TensorProto.STRING, [1], [b"x"]))


def old(m: onnx.ModelProto) -> None:
    m.opset_import[0].version = 99


def two_graphs(m: onnx.ModelProto) -> None:
    m.MergeFromString(m.SerializeToString())


def constants(
    *nodes: onnx.NodeProto, backwards: bool = False, **weights: np.ndarray
) -> Callable[[onnx.ModelProto], None]:
    """Add nodes and weights that end in ``c`` (in disorder with ``backwards``)."""

    def change(m: onnx.ModelProto) -> None:
        m.graph.initializer.extend(numpy_helper.from_array(v, k) for k, v in weights.items())
        m.graph.node.extend(nodes[::-1] if backwards else nodes)

    return change


def sizes(*values: float) -> np.ndarray:
    return np.array(values, np.int64)


def node(operator: str, inputs: str, output: str = "c", **attributes: object) -> onnx.NodeProto:
    return helper.make_node(operator, inputs.split(" ") if inputs else [], [output], **attributes)


#: half a gigabyte and more out of a few bytes
LARGE: dict[str, tuple[Callable[[onnx.ModelProto], None], str]] = {
    "zeros": (constants(node("ConstantOfShape", "s"), s=sizes(2**27)), "ConstantOfShape for more"),
    "zeros of a node's shape": (
        constants(
            node("Constant", "", "s", value_ints=[2**14, 2**14]), node("ConstantOfShape", "s")
        ),
        "ConstantOfShape for more",
    ),
    "zeros of a tensor's typed shape": (
        lambda m: (
            m.graph.initializer.append(helper.make_tensor("s", TensorProto.INT64, [1], [2**40])),
            m.graph.node.append(node("ConstantOfShape", "s")),
        ),
        "ConstantOfShape for more",
    ),
    "a computed shape": (
        constants(node("Mul", "s s", "t"), node("ConstantOfShape", "t"), s=sizes(2**14)),
        "computed from constants",
    ),
    "a computed shape, written backwards": (
        constants(
            node("Mul", "s s", "t"), node("ConstantOfShape", "t"), s=sizes(2**14), backwards=True
        ),
        "computed from constants",
    ),
    "expanded": (constants(node("Expand", "w s"), s=sizes(2**26, 3, 2)), "Expand for more"),
    "expanded input": (constants(node("Expand", "x s"), s=sizes(2**26, 3)), "Expand for more"),
    "tiled": (constants(node("Tile", "w s"), s=sizes(2**13, 2**13)), "Tile for more"),
    "tiled a little, thrice": (
        constants(
            node("Tile", "w s", "a"), node("Tile", "a s", "b"), node("Tile", "b s"),
            s=sizes(2**6, 2**6),
        ),
        "constants of more than",
    ),
    "counted": (
        constants(
            node("Range", "a b d"),
            a=np.array(0.0, np.float32), b=np.array(1.0, np.float32), d=np.array(1e-9, np.float32),
        ),
        "Range for more",
    ),
    "padded input": (constants(node("Pad", "x s"), s=sizes(0, 0, 2**20, 2**20)), "Pad for more"),
    "resized input": (
        constants(node("Resize", "x  s"), s=np.array([2**14, 2**14], np.float32)),
        "Resize for more",
    ),
    "an outer product": (
        constants(
            node("Add", "a b"), a=np.zeros((2**13, 1), np.float32),
            b=np.zeros((1, 2**13), np.float32),
        ),
        "constants of more than",
    ),
    "a product of matrices": (
        constants(
            node("MatMul", "a b"), a=np.zeros((2**13, 1), np.float32),
            b=np.zeros((1, 2**13), np.float32),
        ),
        "constants of more than",
    ),
    "many zeros of allowed size": (
        constants(
            *(node("ConstantOfShape", "s", f"c{k}") for k in range(9)), s=sizes(2**11, 2**11)
        ),
        "constants of more than",
    ),
    "padded by a convolution": (
        constants(node("Conv", "k k", pads=[2**14] * 4), k=np.ones((1, 1, 3, 3), np.float32)),
        "Conv of constants",
    ),
    "one name twice": (constants(w=np.ones(1, np.float32)), "two weights"),
}  # fmt: skip

ATTACKS: dict[str, tuple[Callable[[onnx.ModelProto], None], str]] = {
    "external data": (external, "another file"),
    "external data by name": (external_named_only, "another file"),
    "external data in a constant": (external_in_a_constant, "another file"),
    "loop": (control("Loop"), "graph within"),
    "if": (control("If"), "graph within"),
    "scan": (control("Scan"), "graph within"),
    "hidden graph": (hidden_graph, "graph within"),
    "hidden graphs": (hidden_graphs, "graph within"),
    "random numbers": (operator("RandomNormalLike"), "RandomNormalLike"),
    "scatter": (operator("ScatterND"), "ScatterND"),
    "text operator": (operator("StringNormalizer"), "StringNormalizer"),
    "unheard-of operator": (operator("RunShellCommand"), "RunShellCommand"),
    "other domain": (domain, "com.microsoft"),
    "imported domain": (imported_domain, "com.evil"),
    "function": (function, "functions of its own"),
    "sparse weights": (sparse, "sparse weights"),
    "huge tensor": (huge, "larger than allowed"),
    "negative size": (negative, "larger than allowed"),
    "too little data": (short, "not of its size"),
    "data twice": (twice, "not of its size"),
    "NaN weights": (filled(np.nan, typed=False), "not finite"),
    "infinite weights": (filled(np.inf, typed=True), "not finite"),
    "text weights": (text, "text"),
    "unknown opset": (old, "opset"),
    **LARGE,
}


@pytest.mark.req("REQ-17")
def test_good_models_pass():
    check_onnx(model().SerializeToString(), ModelLimits())
    typed = model()
    filled(1.0, typed=True)(typed)
    check_onnx(typed.SerializeToString(), ModelLimits())
    check_onnx(TINY.read_bytes(), ModelLimits())
    assert MULTI.path is not None
    check_onnx(MULTI.path.read_bytes(), ModelLimits())


@pytest.mark.parametrize("name", ATTACKS)
@pytest.mark.req("REQ-17")
def test_attack_is_refused(name):
    change, words = ATTACKS[name]
    attacked = model()
    change(attacked)
    with pytest.raises(ValueError, match=words):
        check_onnx(attacked.SerializeToString(), ModelLimits())


@pytest.mark.req("REQ-17")
def test_constants_of_a_network_pass():
    """What exporters leave: small zeros, shapes of shapes, a table added to a table, upsampling."""
    change = constants(
        node("ConstantOfShape", "s", "zeros"),
        node("Add", "zeros table", "sum"),
        node("MatMul", "x sum", "h2"),
        node("Expand", "h2 t", "h3"),
        node("Shape", "x", "shape"),
        node("ConstantOfShape", "shape", "more"),
        node("Constant", "", "k", value_float=2.0),
        node("Mul", "h3 k"),
        s=sizes(3, 512), t=sizes(4, 1, 512), table=np.ones((3, 512), np.float32),
    )  # fmt: skip
    m = model()
    change(m)
    check_onnx(m.SerializeToString(), ModelLimits())


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_no_constant_is_larger_than_reckoned(data):
    """Random chains of constants, computed by the reference implementation."""
    weights = {"a": np.ones((2, 3), np.float32), "b": np.ones(3, np.float32), "s": sizes(2, 3)}
    names, steps = ["a", "b"], []
    for k in range(data.draw(st.integers(1, 5))):
        operator = data.draw(st.sampled_from(["Add", "MatMul", "Concat", "Expand", "Tile", "Neg"]))
        inputs = [data.draw(st.sampled_from(names)) for _ in range(2)]
        if operator in ("Neg", "Expand", "Tile"):
            inputs[1:] = [] if operator == "Neg" else ["s"]
        extra = {"axis": 0} if operator == "Concat" else {}
        names.append(f"n{k}")
        steps.append(node(operator, " ".join(inputs), names[-1], **extra))
    end = helper.make_tensor_value_info(names[-1], TensorProto.FLOAT, None)
    held = [numpy_helper.from_array(value, name) for name, value in weights.items()]
    whole = helper.make_model(
        helper.make_graph(steps, "g", [], [end], held),
        opset_imports=[helper.make_opsetid("", 18)],
    )
    try:
        (found,) = ReferenceEvaluator(whole).run(None, {})
    except Exception:  # noqa: BLE001 - shapes that do not fit together
        return
    check_onnx(whole.SerializeToString(), ModelLimits())
    known = {name: Constant(v.size, v.shape, tuple(v.ravel())) for name, v in weights.items()}
    nodes = [Node(n.op_type, tuple(n.input), tuple(n.output)) for n in steps]
    with pytest.raises(ValueError, match="more than"):
        check_constants(known, nodes, found.size - 1)


@pytest.mark.parametrize("data", [b"", b"x", b"not a graph", bytes(64), b"\xff" * 64, b"\x3a\x00"])
def test_what_is_no_model(data):
    with pytest.raises(ValueError, match="no ONNX model"):
        check_onnx(data, ModelLimits())


@pytest.mark.parametrize("field", ["max_nodes", "max_elements", "max_fields", "max_opset"])
def test_limits_can_be_changed(field):
    tight = dataclasses.replace(ModelLimits(), **{field: 1})
    with pytest.raises(ValueError, match=r"more than|larger than|opset"):
        check_onnx(model().SerializeToString(), tight)


@pytest.mark.req("REQ-17")
def test_the_walk_agrees_with_the_reference_parser():
    """What the guard lets through after random damage, the reference parser reads as it does."""
    chance = random.Random(0)  # noqa: S311 - reproducible damage, no secret
    good = model().SerializeToString()
    passed = 0
    for _ in range(3000):
        data = bytearray(good)
        for _ in range(chance.randint(1, 3)):
            data[chance.randrange(len(data))] = chance.randrange(256)
        try:
            check_onnx(bytes(data), ModelLimits())
        except ValueError:
            continue
        try:
            found = onnx.ModelProto.FromString(bytes(data))
        except DecodeError:  # stricter still, for instance about UTF-8
            continue
        assert {node.op_type for node in found.graph.node} <= OPERATORS
        assert all(tensor.data_location == 0 for tensor in found.graph.initializer)
        assert not found.functions and not found.graph.sparse_initializer
        passed += 1
    assert passed > 100

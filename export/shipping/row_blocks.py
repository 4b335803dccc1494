"""Convolutions on sparse points in blocks of rows: the same graph, with less memory in flight.

A convolution gathers 27 neighbours of every point and multiplies once. Gathered for all points at
once they are some 50 MB, which go to memory and come back; block by block they stay in the cache.
Every row is worked out as before, so the answers are the same to the last bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

#: blocks of the points of each level, the finest first; coarser ones are small enough
BLOCKS = {"neighbours0": 8, "neighbours1": 2}


def in_blocks(model: Any) -> int:
    """Cut each convolution of ``model``, an ONNX graph, into blocks, in place.

    Parameters
    ----------
    model : ModelProto; what reads an input of ``BLOCKS`` as Reshape, Gather, Reshape, Gemm, Relu
        is cut

    Returns
    -------
    how many convolutions were cut
    """
    from onnx import helper, numpy_helper

    graph = model.graph
    made_by = {output: node for node in graph.node for output in node.output}
    used_by: dict[str, list[Any]] = {}
    for node in graph.node:
        for name in node.input:
            used_by.setdefault(name, []).append(node)
    nodes: list[Any] = []
    gone: set[str] = set()
    cut: list[str] = []

    def add(kind: str, inputs: Sequence[str], outputs: Sequence[str], **attributes: Any) -> None:
        nodes.append(helper.make_node(kind, inputs, outputs, **attributes))

    def constant(name: str, values: Sequence[int]) -> str:
        graph.initializer.append(numpy_helper.from_array(np.array(values, np.int64), name))
        return name

    def cut_table(table: str) -> None:
        """Cut the table of neighbours once: rows n k / blocks .. n (k + 1) / blocks, flattened."""
        count = BLOCKS[table]
        if not cut:
            constant("blocks_flat", [-1])
        at = constant(f"{table}_at", range(count + 1))
        parts = constant(f"{table}_parts", [count])
        add("Shape", [table], [f"{table}_rows"], start=0, end=1)
        add("Mul", [f"{table}_rows", at], [f"{table}_times"])
        add("Div", [f"{table}_times", parts], [f"{table}_edges"])
        for name, first in (("low", 0), ("high", 1)):
            start = constant(f"{table}_{name}_from", [first])
            end = constant(f"{table}_{name}_to", [first + count])
            add("Slice", [f"{table}_edges", start, end], [f"{table}_{name}"])
        add("Sub", [f"{table}_high", f"{table}_low"], [f"{table}_sizes"])
        blocks = [f"{table}_{k}" for k in range(count)]
        add("Split", [table, f"{table}_sizes"], blocks, axis=0)
        for block in blocks:
            add("Reshape", [block, "blocks_flat"], [f"{block}_flat"])
        cut.append(table)

    convolutions = 0
    for node in graph.node:
        chain = _convolution(node, made_by, used_by)
        if chain is None:
            nodes.append(node)
            continue
        table, gather, wide, relu = chain
        if table not in cut:
            cut_table(table)
        attributes = {a.name: helper.get_attribute_value(a) for a in node.attribute}
        done = []
        for k in range(BLOCKS[table]):
            own = f"{node.output[0]}_{k}"
            add("Gather", [gather.input[0], f"{table}_{k}_flat"], [f"{own}_near"], axis=0)
            add("Reshape", [f"{own}_near", wide.input[1]], [f"{own}_wide"])
            add("Gemm", [f"{own}_wide", *node.input[1:]], [own], **attributes)
            add("Relu", [own], [f"{own}_out"])
            done.append(f"{own}_out")
        add("Concat", done, [relu.output[0]], axis=0)
        gone |= {gather.output[0], wide.output[0], relu.output[0]}
        convolutions += 1
    kept = [n for n in nodes if n.op_type == "Concat" or not gone & set(n.output)]
    del graph.node[:]
    graph.node.extend(kept)
    return convolutions


def _convolution(
    gemm: Any, made_by: dict[str, Any], used_by: dict[str, list[Any]]
) -> tuple[str, Any, Any, Any] | None:
    """Table of neighbours, Gather, Reshape and Relu round a Gemm; None of any other node."""
    before: list[Any] = []
    node = gemm
    # From the product back to the table: what is multiplied, gathered, by which index.
    for kind, read in (("Gemm", 0), ("Reshape", 0), ("Gather", 1), ("Reshape", 0)):
        if node is None or node.op_type != kind:
            return None
        before.append(node)
        node = made_by.get(node.input[read])
    _, wide, gather, index = before
    after = used_by[gemm.output[0]]
    alone = all(len(used_by[n.output[0]]) == 1 for n in (gather, wide))
    if index.input[0] not in BLOCKS or [n.op_type for n in after] != ["Relu"] or not alone:
        return None
    return index.input[0], gather, wide, after[0]

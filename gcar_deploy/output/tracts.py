"""Centreline in the form of VMTK's branch extractor, which SimVascular's tools read as well.

Each way from the inlet to an outlet is one centreline, cut into tracts: branches, and between them
bifurcations from one radius before a fork to one radius (of the parent) behind it (after Antiga and
Steinman, IEEE Trans Med Imaging 23:704, 2004). Tracts of several centrelines in the same branch
share a group; bifurcations are blanked. A shared branch is there once per centreline, as in VMTK.
"""

from __future__ import annotations

import numpy as np

from gcar_deploy.flow import PressureDrop
from gcar_deploy.output.vtp import poly_data
from gcar_deploy.tree.tree import Tree, along
from gcar_deploy.types import Array

#: a bifurcation takes no more than this share of a branch
_MOST_SHARE = 0.4


def tracts_vtp(tree: Tree, drop: PressureDrop) -> bytes:
    """Write the centrelines of the artery.

    Cell arrays ``CenterlineIds``, ``TractIds``, ``GroupIds`` count from 0, as in VMTK, ``Blanking``
    is 1 in bifurcations; ``BranchId`` is the number of a branch in every other file, 0 in a
    bifurcation. Point arrays ``MaximumInscribedSphereRadius`` and ``Radius``, mm.
    """
    network = drop.network
    head, tail = _lengths(tree, drop)
    fork_group = {
        k: len(network.order) + i
        for i, k in enumerate(k for k in network.order if network.children[k])
    }
    group = {k: i for i, k in enumerate(network.order)}
    cells: dict[str, list[int]] = {
        name: [] for name in ("CenterlineIds", "TractIds", "GroupIds", "Blanking", "BranchId")
    }
    lines: list[Array] = []

    def add(line: Array, centerline: int, number: int, own: int, branch: int) -> None:
        lines.append(line)
        values = (centerline, number, own, int(branch == 0), branch)
        for name, value in zip(cells, values, strict=True):
            cells[name].append(value)

    for centerline, outlet in enumerate(network.outlets):
        way = [outlet]
        while (above := network.parent[way[-1]]) is not None:
            way.append(above)
        way.reverse()
        number = 0
        for k, child in zip(way, [*way[1:], None], strict=True):
            length = tree.branches[k].length_mm
            inner = _stretch(tree, k, head[k], length - tail[k])
            add(inner, centerline, number, group[k], k + 1)
            number += 1
            if child is None:
                continue
            before = _stretch(tree, k, length - tail[k], length)
            behind = _stretch(tree, child, 0.0, head[child])
            add(np.concatenate([before, behind[1:]]), centerline, number, fork_group[k], 0)
            number += 1
    table = np.concatenate(lines)
    return poly_data(
        table[:, :3], [len(line) for line in lines],
        {"MaximumInscribedSphereRadius": table[:, 3], "Radius": table[:, 3]},
        {name: np.array(values, np.int64) for name, values in cells.items()},
    )  # fmt: skip


def _lengths(tree: Tree, drop: PressureDrop) -> tuple[dict[int, float], dict[int, float]]:
    """How much of each branch belongs to the bifurcations at its beginning and at its end, mm."""
    head, tail = {}, {}
    for k in drop.network.order:
        branch, above = tree.branches[k], drop.network.parent[k]
        most = _MOST_SHARE * branch.length_mm
        before = 0.0 if above is None else float(tree.branches[above].radius_mm[-1])
        head[k] = min(before, most)
        tail[k] = min(float(branch.radius_mm[-1]), most) if drop.network.children[k] else 0.0
    return head, tail


def _stretch(tree: Tree, k: int, low_mm: float, high_mm: float) -> Array:
    """(m, 4) points and radii of a branch between two distances from its inlet."""
    branch = tree.branches[k]
    arc = branch.arc_mm
    inside = arc[(arc > low_mm + 1e-6) & (arc < high_mm - 1e-6)]
    at = np.concatenate([[low_mm], inside, [high_mm]])
    radius = np.interp(at, arc, branch.radius_mm)
    return np.column_stack([along(branch.points_mm, arc, at), radius])

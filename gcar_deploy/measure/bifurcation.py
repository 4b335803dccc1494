"""A bifurcation in figures: its three segments, each against its own reference."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gcar_deploy.measure.lumen import BranchLumen
from gcar_deploy.tree.tree import Tree

#: a segment reaches this far from the node, beyond what the bifurcation itself widens, mm
SEGMENT_MM = 8.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Segment:
    """One vessel at a bifurcation; None where no section of it is clear.

    Attributes
    ----------
    branch : number of the branch, from 0
    role : ``parent``, ``main`` (the wider daughter by reference) or ``side``
    reference_mm : reference diameter at the node
    minimal_diameter_mm, stenosis_percent : at the worst of its sections, by the reference there
    """

    branch: int
    role: str
    reference_mm: float
    minimal_diameter_mm: float | None
    stenosis_percent: float | None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bifurcation:
    """Node with the segments that meet there, the parent first, the main daughter next.

    Attributes
    ----------
    node : row of ``Tree.nodes_mm``
    segments : three of them
    calibre_ratio : reference of the parent over the sum of the daughters' (healthy: about 0.68,
        Finet et al., EuroIntervention 3:490, 2008)
    """

    node: int
    segments: tuple[Segment, ...]
    calibre_ratio: float


def bifurcations(tree: Tree, lumens: Sequence[BranchLumen]) -> tuple[Bifurcation, ...]:
    """Measure every node at which one branch becomes two."""
    out = []
    for node in range(len(tree.nodes_mm)):
        parents = [k for k, branch in enumerate(tree.branches) if branch.end == node]
        daughters = [k for k, branch in enumerate(tree.branches) if branch.start == node]
        if len(parents) != 1 or len(daughters) != 2:
            continue
        daughters.sort(key=lambda k: -float(lumens[k].reference_mm[0]))
        segments = tuple(
            _segment(k, lumens[k], role)
            for k, role in zip([*parents, *daughters], ("parent", "main", "side"), strict=True)
        )
        ratio = segments[0].reference_mm / sum(s.reference_mm for s in segments[1:])
        out.append(Bifurcation(node=node, segments=segments, calibre_ratio=ratio))
    return tuple(out)


def _segment(branch: int, lumen: BranchLumen, role: str) -> Segment:
    arc, diameter = lumen.sections.arc_mm, lumen.sections.diameter_mm
    away = arc[-1] - arc if role == "parent" else arc
    reference = float(lumen.reference_mm[-1 if role == "parent" else 0])
    use = lumen.clear & (away <= SEGMENT_MM)
    if not use.any():
        return Segment(branch=branch, role=role, reference_mm=reference, minimal_diameter_mm=None,
                       stenosis_percent=None)  # fmt: skip
    share = np.where(use, diameter / lumen.reference_mm, np.inf)
    k = int(np.argmin(share))
    return Segment(
        branch=branch,
        role=role,
        reference_mm=reference,
        minimal_diameter_mm=float(diameter[k]),
        stenosis_percent=100 * max(0.0, 1 - float(share[k])),
    )

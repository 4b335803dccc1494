"""Flow through a tree: who feeds whom, and how much goes where."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gcar_deploy.flow.assumption import M3_S_PER_ML_MIN, Assumption
from gcar_deploy.measure.lumen import BranchLumen
from gcar_deploy.tree.tree import Branch, Tree
from gcar_deploy.types import Array, Scalars

#: the calibre of a branch is its healthy diameter over so much of its beginning, mm
CALIBRE_MM = 10.0


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Network:
    """Branches as a directed forest.

    Attributes
    ----------
    parent : per branch the branch that feeds it, or None
    children : per branch those that it feeds
    order : every branch after its parent
    left_out : branch -> why no flow can be told through it
    calibre_mm : (branches,) healthy diameter that flow goes by
    draw : (branches,) share of its calibre's flow that a branch draws, below 1 for short free ends
    from_mm : (branches,) distance of each branch's inlet from the ostium
    """

    parent: tuple[int | None, ...]
    children: tuple[tuple[int, ...], ...]
    order: tuple[int, ...]
    left_out: dict[int, str]
    calibre_mm: Scalars
    draw: Scalars
    from_mm: Scalars

    @property
    def roots(self) -> tuple[int, ...]:
        """Branches that flow enters at an inlet, in order."""
        return tuple(k for k in self.order if self.parent[k] is None)

    @property
    def outlets(self) -> tuple[int, ...]:
        """Branches that flow leaves the tree from, in order."""
        return tuple(k for k in self.order if not self.children[k])


#: a free piece draws flow by its length up to so much, mm: short ones are often no vessel
FULL_MM = 20.0
#: main vessels that begin at an ostium
_OSTIAL = ("LM", "RCA")


def network_of(
    tree: Tree, lumens: Sequence[BranchLumen], names: Sequence[str | None] = ()
) -> Network:
    """Tell who feeds whom.

    The longest component is an artery, and so is one that a left main or right coronary artery
    begins. Others have lost their way to theirs, so that no flow can be told in them; nor can it
    downstream of a loop.

    Parameters
    ----------
    tree : Tree, branches from their inlets (``measure.inlet``)
    lumens : its branches' lumens
    names : of its branches; empty where none is known
    """
    n = len(tree.branches)
    feeding: dict[int, list[int]] = {}
    for k, branch in enumerate(tree.branches):
        feeding.setdefault(branch.end, []).append(k)
    component = tree.components() if n else np.zeros(0, int)
    arteries = {component[b.start] for b in tree.branches[:1]}
    for branch, name in zip(tree.branches, names, strict=bool(names)):
        if name in _OSTIAL and branch.start not in feeding:
            arteries.add(component[branch.start])
    parent: list[int | None] = [None] * n
    left_out: dict[int, str] = {}
    for k, branch in enumerate(tree.branches):
        fed_by = [j for j in feeding.get(branch.start, ()) if j != k]
        if component[branch.start] not in arteries:
            left_out[k] = "it is not joined to an artery's inlet"
        elif len(fed_by) > 1 or branch.start == branch.end:
            left_out[k] = "the tree has a loop there"
        elif fed_by:
            parent[k] = fed_by[0]
    children = tuple(tuple(j for j in range(n) if parent[j] == k) for k in range(n))
    order: list[int] = []
    waiting = [k for k in range(n) if parent[k] is None and k not in left_out][::-1]
    from_mm = np.zeros(n)
    while waiting:
        k = waiting.pop()
        order.append(k)
        for child in children[k][::-1]:
            from_mm[child] = from_mm[k] + tree.branches[k].length_mm
            waiting.append(child)
    for k in range(n):
        if k not in order:
            left_out.setdefault(k, "the tree has a loop upstream")
    return Network(
        parent=tuple(parent), children=children, order=tuple(order), left_out=left_out,
        calibre_mm=np.array([
            calibre_mm(branch, lumen) for branch, lumen in zip(tree.branches, lumens, strict=True)
        ]),
        draw=np.array([
            1.0 if below else min(branch.length_mm / FULL_MM, 1.0)
            for branch, below in zip(tree.branches, children, strict=True)
        ]),
        from_mm=from_mm,
    )  # fmt: skip


def calibre_mm(branch: Branch, lumen: BranchLumen) -> float:
    """Healthy diameter at the beginning of a branch, mm: a stenosis draws no less flow.

    Where the branch is too short to tell it, the median of its diameters.
    """
    known = np.flatnonzero(np.isfinite(lumen.healthy_mm))
    if not len(known):
        return float(2.0 * np.median(branch.radius_mm))
    near = known[branch.arc_mm[known] <= branch.arc_mm[known[0]] + CALIBRE_MM]
    # In a short branch that is mostly lesion, the reference line is too low itself.
    wide = np.quantile(2.0 * branch.radius_mm[near], 0.75)
    return float(max(np.median(lumen.healthy_mm[near]), wide))


def own_flows(network: Network, calibre_mm: Array, inlet: Array, assumed: Assumption) -> Array:
    """Flow through each branch by its own calibre beside that of its inlet.

    Branches that were missed, made up or joined wrongly change the split at a bifurcation, but not
    this; where the split is right, both are nearly the same.

    Parameters
    ----------
    calibre_mm : (..., branches) diameters that flow goes by
    inlet : (..., branches) flows, of which those of the roots are taken
    assumed : Assumption

    Returns
    -------
    (..., branches) m^3 / s; 0 where none can be told
    """
    out = np.zeros(inlet.shape)
    root: dict[int, int] = {}
    for k in network.order:
        above = network.parent[k]
        root[k] = k if above is None else root[above]
        share = (calibre_mm[..., k] / calibre_mm[..., root[k]]) ** assumed.split_exponent
        out[..., k] = inlet[..., root[k]] * share
    return out


def flows(network: Network, calibre_mm: Array, draw: Array, assumed: Assumption) -> Array:
    """Flow through each branch; what enters a bifurcation leaves it.

    Parameters
    ----------
    calibre_mm : (..., branches) diameters that flow goes by
    draw : (..., branches) factor on what each draws beside its sisters
    assumed : Assumption; inlet flow without its spread

    Returns
    -------
    (..., branches) m^3 / s; 0 where none can be told
    """
    out = np.zeros(calibre_mm.shape)
    roots = list(network.roots)
    if not roots:
        return out
    if assumed.flow_ml_min is None:
        area = 0.25 * np.pi * (1e-3 * calibre_mm[..., roots]) ** 2
        out[..., roots] = assumed.velocity_m_s * area
    else:
        share = calibre_mm[..., roots] ** assumed.inlet_exponent
        whole = assumed.flow_ml_min * M3_S_PER_ML_MIN
        out[..., roots] = whole * share / share.sum(axis=-1, keepdims=True)
    for k in network.order:
        below = list(network.children[k])
        if below:
            share = draw[..., below] * calibre_mm[..., below] ** assumed.split_exponent
            out[..., below] = out[..., [k]] * share / share.sum(axis=-1, keepdims=True)
    return out

"""Lesions of one branch: narrowings behind which the vessel is wider again.

A vessel that tapers, or goes on as a thinner one (a graft as the artery that it feeds), leaves its
straight reference and never comes back: that is no lesion. Behind a lesion the vessel comes half of
the way back to its reference, in the same branch or, over a fork, in those that follow; or, where
all that follows is small, it is wider than the lesion by as much as a lesion is narrower.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gcar_deploy.measure.reference import FLOW_EXPONENT
from gcar_deploy.measure.sections import Sections
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Scalars

#: a stretch this much narrower than its reference (share) counts as lesion.
LESION_SHARE = 0.25
#: a lesion ends where the lumen is this share of its reference again; narrower is plaque
BORDER_SHARE = 0.9
#: how a branch goes on is read within this of its inlet, mm, at so many sections or more
GOES_ON_MM, _ENOUGH = 10.0, 3


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lesion:
    """One narrowing in figures; see ``BranchLumen``, whose figures are those of the gravest.

    ``marked``: its borders are the user's.
    """

    minimal_diameter_mm: float
    minimal_at_mm: float
    reference_diameter_mm: float
    stenosis_percent: float
    lesion_mm: tuple[float, float]
    marked: bool = False


def going_on_mm(tree: Tree, sections: Sequence[Sections], clear: Sequence[Array]) -> list[float]:
    """Per branch: diameter of one vessel that carries what its followers do; 0 without any."""
    begin = [_begin_mm(own, use) for own, use in zip(sections, clear, strict=True)]
    into: dict[int, float] = {}
    for branch, diameter in zip(tree.branches, begin, strict=True):
        into[branch.start] = into.get(branch.start, 0.0) + diameter**FLOW_EXPONENT
    return [into.get(branch.end, 0.0) ** (1 / FLOW_EXPONENT) for branch in tree.branches]


def _begin_mm(own: Sections, use: Array) -> float:
    """Widest of a branch near its inlet: a lesion right behind a fork hides no recovery."""
    near = use & (own.arc_mm <= GOES_ON_MM)
    if near.sum() >= _ENOUGH:
        return float(own.diameter_mm[near].max())
    return float(np.median(own.diameter_mm[own.measured])) if own.measured.any() else 0.0


def recovers(own: Sections, line: Scalars, clear: Array, going_on: float) -> Array:
    """(m,) bool: sections beyond which the vessel is wider again.

    Parameters
    ----------
    own : sections of a branch
    line : (m,) reference diameter, mm
    clear : (m,) bool, sections whose diameter is the branch's own
    going_on : diameter with which the branch goes on beyond its end, mm; 0 at a free end
    """
    diameter = np.where(clear, own.diameter_mm, 0.0)
    wider, nearer = (
        np.append(np.maximum.accumulate(values[::-1])[::-1][1:], 0.0)
        for values in (diameter, diameter / line)
    )
    wider = np.maximum(wider, going_on)
    nearer = np.maximum(nearer, going_on / line[-1])
    share = own.diameter_mm / line
    out: Array = (nearer >= 0.5 * (1 + share)) | (own.diameter_mm <= (1 - LESION_SHARE) * wider)
    return out


def narrowest(share: Scalars, clear: Array, again: Array) -> list[tuple[int, int, int]]:
    """Sections where each lesion is narrowest, begins and ends, the gravest first.

    Two are separate where the vessel between them comes half of the way back from the slighter to
    its reference: less is the rough wall of one. A lesion ends at the latest where the vessel is
    wider for the last time: what narrows for good behind it is none.

    Parameters
    ----------
    share : (m,) diameter as a share of the reference
    clear, again : (m,) bool, where a lesion may be narrowest, and as of ``recovers``
    """
    deep = np.flatnonzero(clear & again & (share < 1 - LESION_SHARE))
    recovered = min(int(np.flatnonzero(again)[-1]) + 1, len(share) - 1) if again.any() else 0
    found: list[int] = []
    for k in deep[np.argsort(share[deep], kind="stable")].tolist():
        half = 0.5 * (1 + share[k])
        if all(share[min(k, other) : max(k, other)].max() >= half for other in found):
            found.append(k)
    spots = ((k, *_borders(share, k, found)) for k in found)
    return [(k, first, min(last, recovered)) for k, first, last in spots]


def slightest(share: Scalars, searched: Array, again: Array) -> int:
    """Section of the most severe narrowing of a branch without a lesion.

    Not the narrowest point, which may just be the thin far end; nor, unless there is nothing else,
    what a taper ends in. ``searched`` (m,) bool, where it is looked for; ``again`` as ``recovers``.
    """
    k = int(np.argmin(np.where(searched, share, np.inf)))
    if share[k] >= 1 - LESION_SHARE or again[k]:
        return k
    known = searched & (again | (share >= 1))
    if not known.any():
        known = searched & (share == share[searched].max())
    return int(np.argmin(np.where(known, share, np.inf)))


def _borders(share: Scalars, k: int, others: Sequence[int]) -> tuple[int, int]:
    """Sections at which the lesion round section ``k`` begins and ends."""
    first = last = k
    while first > 0 and share[first] < BORDER_SHARE:
        first -= 1
    while last < len(share) - 1 and share[last] < BORDER_SHARE:
        last += 1
    # Between two lesions that touch the border is where the vessel is widest.
    for other in others:
        if other < k:
            first = max(first, other + int(np.argmax(share[other:k])))
        elif other > k:
            last = min(last, k + int(np.argmax(share[k:other])))
    return first, last


def lesion_at(own: Sections, line: Scalars, k: int, first: int, last: int) -> Lesion:
    """Return the figures of a lesion that is narrowest at section ``k``."""
    return Lesion(
        minimal_diameter_mm=float(own.diameter_mm[k]),
        minimal_at_mm=float(own.arc_mm[k]),
        reference_diameter_mm=float(line[k]),
        stenosis_percent=100.0 * (1.0 - min(float(own.diameter_mm[k] / line[k]), 1.0)),
        lesion_mm=(float(own.arc_mm[first]), float(own.arc_mm[last])),
    )

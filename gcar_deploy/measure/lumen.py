"""Measures of the lumen: diameters, stenosis, lengths, bifurcation angles, foreshortening."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.measure.borders import Spot, beside_marked
from gcar_deploy.measure.lesions import (
    BORDER_SHARE,
    LESION_SHARE,
    Lesion,
    going_on_mm,
    lesion_at,
    narrowest,
    recovers,
    slightest,
)
from gcar_deploy.measure.reference import reference_lines
from gcar_deploy.measure.sections import Sections, sections_of_radii
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Scalars

#: stretches this close to an end (in radii) are left out: the tube ends or widens there.
END_RADII = 1.5
#: the lumen at an end is the widest within this, mm
END_MM = 3.0
#: a branch needs this many sections left to state a stenosis.
MIN_SECTIONS = 5
#: directions at a bifurcation are taken this far from it, mm, at least.
ANGLE_REACH_MM = 4.0


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class BranchLumen:
    """One branch in figures; None where the branch is too short to say.

    Attributes
    ----------
    healthy_mm : (m,) reference diameter at each point; NaN near the ends and in short branches
    sections : Sections along the branch, of which all figures are taken
    clear : (sections,) those away from the ends, where a diameter is the branch's own
    reference_mm : reference diameter at each section, from end to end
    minimal_diameter_mm, minimal_at_mm : minimal lumen diameter and how far from the inlet
    minimal_sigma_mm : its standard deviation
    reference_diameter_mm : reference diameter there
    stenosis_percent : 100 (1 - minimal / reference), 0 or more
    area_stenosis_percent : the same of areas
    lesion_length_mm : distance of the borders; 0 where it is narrower by less than a quarter
    lesion_mm : proximal and distal border of that lesion, distance from the inlet
    proximal_reference_mm, distal_reference_mm : reference diameter at the borders
    plaque_free_mm : length of vessel that is no narrower than its reference by a tenth
    lesions : all of the branch, the gravest first: the one that the figures above tell of
    replaced : found ones that gave way to those the user marked
    narrows_to_mm : least diameter where the branch tapers or steps down by more than a lesion and
        is not wider again beyond; no lesion, and None where it does not
    """

    healthy_mm: Scalars
    sections: Sections
    clear: Array
    reference_mm: Scalars
    minimal_diameter_mm: float | None = None
    minimal_at_mm: float | None = None
    minimal_sigma_mm: float | None = None
    reference_diameter_mm: float | None = None
    stenosis_percent: float | None = None
    area_stenosis_percent: float | None = None
    lesion_length_mm: float | None = None
    lesion_mm: tuple[float, float] | None = None
    proximal_reference_mm: float | None = None
    distal_reference_mm: float | None = None
    plaque_free_mm: float | None = None
    lesions: tuple[Lesion, ...] | None = None
    replaced: tuple[Lesion, ...] = ()
    narrows_to_mm: float | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class BifurcationAngle:
    """Angle between two branches that meet at a node, degrees."""

    node: int
    first: int
    second: int
    angle_deg: float


def tree_lumens(
    tree: Tree,
    sections: Sequence[Sections] | None = None,
    marked: Mapping[int, Sequence[tuple[float, float]]] | None = None,
) -> tuple[BranchLumen, ...]:
    """Measure every branch; see ``BranchLumen``.

    Parameters
    ----------
    tree : Tree, branches from their inlets
    sections : of each branch; None takes the tree's own radii
    marked : branch -> borders of each lesion that the user set in it, distance from its inlet, mm
    """
    if sections is None:
        sections = sections_of_radii(tree)
    clear = [_clear(tree, k, own) for k, own in enumerate(sections)]
    lines = reference_lines(tree, sections, clear)
    marked = marked or {}
    further = going_on_mm(tree, sections, clear)
    return tuple(
        _lumen(branch.arc_mm, own, (line, use, beyond), marked.get(k, ()))
        for k, (branch, own, line, use, beyond) in enumerate(
            zip(tree.branches, sections, lines, clear, further, strict=True)
        )
    )


def _clear(tree: Tree, k: int, own: Sections) -> Array:
    """(m,) sections away from both ends, where the vessel ends or opens into another."""
    branch, arc, radius = tree.branches[k], own.arc_mm, 0.5 * own.diameter_mm
    before = [float(b.radius_mm[-1]) for b in tree.branches if b.end == branch.start]
    # At a blunt end the lumen seems to narrow before it stops.
    first = max([float(radius[arc <= END_MM].max()), *before])
    low = END_RADII * first
    high = END_RADII * float(radius[arc >= arc[-1] - END_MM].max())
    return own.measured & (arc >= low) & (arc <= arc[-1] - high)


def _lumen(
    arc_mm: Scalars,
    own: Sections,
    told: tuple[Scalars, Array, float],
    borders: Sequence[tuple[float, float]],
) -> BranchLumen:
    line, alone, beyond = told
    clear = alone.copy()
    for low, high in borders:
        clear |= (own.arc_mm >= low) & (own.arc_mm <= high)
    healthy = np.full(len(arc_mm), np.nan)
    if np.count_nonzero(clear) < MIN_SECTIONS:
        return BranchLumen(healthy_mm=healthy, sections=own, clear=clear, reference_mm=line)
    low, high = own.arc_mm[clear][[0, -1]]
    inner = (arc_mm >= low) & (arc_mm <= high)
    healthy[inner] = np.interp(arc_mm[inner], own.arc_mm, line)
    share = own.diameter_mm / line
    again = recovers(own, line, alone, beyond)
    marked = [_between(own, share, *ends) for ends in borders]
    found, gone = beside_marked(narrowest(share, alone, again), marked)
    spots = sorted([*marked, *found], key=lambda spot: float(share[spot[0]]))
    k, first, last = spots[0] if spots else (slightest(share, alone, again),) * 3
    for_good = clear & ~again & (share < 1 - LESION_SHARE)
    for _, begin, end in spots:
        for_good[begin : end + 1] = False
    least = float(min(share[k], 1.0))
    spans = np.gradient(own.arc_mm)
    return BranchLumen(
        healthy_mm=healthy,
        sections=own,
        clear=clear,
        reference_mm=line,
        minimal_diameter_mm=float(own.diameter_mm[k]),
        minimal_at_mm=float(own.arc_mm[k]),
        minimal_sigma_mm=float(own.sigma_mm[k]) if np.isfinite(own.sigma_mm[k]) else None,
        reference_diameter_mm=float(line[k]),
        stenosis_percent=100.0 * (1.0 - least),
        area_stenosis_percent=100.0 * (1.0 - least**2),
        lesion_length_mm=float(own.arc_mm[last] - own.arc_mm[first]),
        lesion_mm=(float(own.arc_mm[first]), float(own.arc_mm[last])) if last > first else None,
        proximal_reference_mm=float(line[first]) if last > first else None,
        distal_reference_mm=float(line[last]) if last > first else None,
        plaque_free_mm=float(spans[clear & (share >= BORDER_SHARE)].sum()),
        lesions=tuple(
            dataclasses.replace(lesion_at(own, line, *spot), marked=spot in marked)
            for spot in spots
        ),
        replaced=tuple(lesion_at(own, line, *spot) for spot in gone),
        narrows_to_mm=float(own.diameter_mm[for_good].min()) if for_good.any() else None,
    )


def _between(own: Sections, share: Scalars, low: float, high: float) -> Spot:
    """Sections where the vessel is narrowest between two borders, and those of the borders.

    What no view shows, as within a fork, is narrowest only where nothing else lies between.
    """
    inside = np.flatnonzero((own.arc_mm >= low) & (own.arc_mm <= high))
    shown = inside[own.measured[inside]] if own.measured[inside].any() else inside
    return int(shown[np.argmin(share[shown])]), int(inside[0]), int(inside[-1])


def bifurcation_angles(tree: Tree) -> tuple[BifurcationAngle, ...]:
    """Angles between each two branches that meet where three or more do."""
    out: list[BifurcationAngle] = []
    for node, degree in enumerate(tree.degrees):
        if degree < 3:
            continue
        ways = []
        for k, branch in enumerate(tree.branches):
            if branch.start == node:
                ways.append((k, _direction(branch.points_mm, branch.radius_mm)))
            if branch.end == node:
                ways.append((k, _direction(branch.points_mm[::-1], branch.radius_mm[::-1])))
        for (i, a), (j, b) in itertools.combinations(ways, 2):
            cosine = float(np.clip(a @ b, -1.0, 1.0))
            angle = float(np.degrees(np.arccos(cosine)))
            out.append(BifurcationAngle(node=node, first=i, second=j, angle_deg=angle))
    return tuple(out)


def hidden_share(tree: Tree, carm: CArm) -> float | None:
    """Share of the whole tree's length that a view hides; None without a tree."""
    total = tree.length_mm
    if not total > 0:
        return None
    lengths = np.array([branch.length_mm for branch in tree.branches])
    return float(foreshortening(tree, carm) @ lengths) / total


def foreshortening(tree: Tree, carm: CArm) -> Scalars:
    """(branches,) share of each one's length that a view hides.

    From 0 (in the picture plane) to 1 (end on).
    """
    starts, ends, *_ = tree.segments()
    steps = ends - starts
    ray = 0.5 * (ends + starts) - carm.source_mm
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12)
    across = np.linalg.norm(np.cross(steps, ray), axis=1)
    count = len(tree.branches)
    branch = np.repeat(np.arange(count), np.array([len(b) - 1 for b in tree.branches], np.int64))
    seen, length = (
        np.bincount(branch, values, minlength=count)
        for values in (across, np.linalg.norm(steps, axis=1))
    )
    out: Scalars = np.where(length > 0, 1.0 - seen / np.where(length > 0, length, 1.0), 0.0)
    return out


def _direction(points_mm: Scalars, radius_mm: Scalars) -> Scalars:
    """(3,) unit vector from the first point to one clear of the other branches."""
    arc = np.linalg.norm(points_mm - points_mm[0], axis=1)
    reach = max(ANGLE_REACH_MM, 2.0 * float(radius_mm[0]))
    beyond = np.flatnonzero(arc >= reach)
    k = int(beyond[0]) if len(beyond) else len(points_mm) - 1
    way = points_mm[k] - points_mm[0]
    out: Scalars = way / max(float(np.linalg.norm(way)), 1e-12)
    return out

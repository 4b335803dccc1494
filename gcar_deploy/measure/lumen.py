"""Measures of the lumen: diameters, stenosis, lengths, bifurcation angles, foreshortening."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.tree.tree import Branch, Tree
from gcar_deploy.types import Scalars

#: a stretch this much narrower than its reference (share) counts as lesion.
LESION_SHARE = 0.25
#: share of a branch's diameters that lie below its reference line (expectile).
REFERENCE_EXPECTILE = 0.8
#: stretches this close to an end (in radii) are left out: the tube ends or widens there.
END_RADII = 1.5
#: a branch needs this many points left to state a stenosis.
MIN_POINTS = 5
#: directions at a bifurcation are taken this far from it, mm, at least.
ANGLE_REACH_MM = 4.0


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class BranchLumen:
    """One branch in figures; None where the branch is too short to say.

    Attributes
    ----------
    healthy_mm : (m,) reference diameter at each point; NaN near the ends and in short branches
    minimal_diameter_mm, minimal_at_mm : minimal lumen diameter and how far from the inlet
    reference_diameter_mm : healthy diameter there, by a line through the wider parts
    stenosis_percent : 100 (1 - minimal / reference), 0 or more
    lesion_length_mm : stretch round the minimum narrower than the reference by a quarter
    """

    healthy_mm: Scalars
    minimal_diameter_mm: float | None = None
    minimal_at_mm: float | None = None
    reference_diameter_mm: float | None = None
    stenosis_percent: float | None = None
    lesion_length_mm: float | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class BifurcationAngle:
    """Angle between two branches that meet at a node, degrees."""

    node: int
    first: int
    second: int
    angle_deg: float


def branch_lumen(branch: Branch) -> BranchLumen:
    """Measure one branch; see ``BranchLumen``."""
    arc, diameter = branch.arc_mm, 2.0 * branch.radius_mm
    healthy = np.full(len(arc), np.nan)
    low, high = END_RADII * branch.radius_mm[0], END_RADII * branch.radius_mm[-1]
    clear = (arc >= low) & (arc <= arc[-1] - high)
    if np.count_nonzero(clear) < MIN_POINTS:
        return BranchLumen(healthy_mm=healthy)
    healthy[clear] = reference_curve(arc[clear], diameter[clear])
    share = diameter / healthy
    # The most severe narrowing, not the narrowest point, which may just be the thin far end.
    k = int(np.nanargmin(share))
    # One more False, which is the neighbour of both ends.
    narrow = np.append(share < 1 - LESION_SHARE, False)
    first, last = k, k
    if narrow[k]:
        while narrow[first - 1]:
            first -= 1
        while narrow[last + 1]:
            last += 1
    return BranchLumen(
        healthy_mm=healthy,
        minimal_diameter_mm=float(diameter[k]),
        minimal_at_mm=float(arc[k]),
        reference_diameter_mm=float(healthy[k]),
        stenosis_percent=max(0.0, 100.0 * (1.0 - float(share[k]))),
        lesion_length_mm=float(arc[last] - arc[first]),
    )


def reference_curve(arc_mm: Scalars, diameter_mm: Scalars) -> Scalars:
    """(m,) healthy diameter: a line through the wider parts of a vessel.

    Asymmetric least squares (expectile regression) with weight ``REFERENCE_EXPECTILE`` above the
    line. It may rise as well as fall: some vessels widen downstream.
    """
    design = np.stack([np.ones(len(arc_mm)), arc_mm - arc_mm.mean()], axis=1)
    weight = np.ones(len(arc_mm))
    line = np.full(len(arc_mm), float(np.median(diameter_mm)))
    for _ in range(20):
        w = weight[:, None] * design
        coefficients = np.linalg.lstsq(design.T @ w, w.T @ diameter_mm, rcond=None)[0]
        line = design @ coefficients
        new = np.where(diameter_mm > line, REFERENCE_EXPECTILE, 1 - REFERENCE_EXPECTILE)
        if np.array_equal(new, weight):
            break
        weight = new
    out: Scalars = np.maximum(line, 0.1)
    return out


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
    return sum(foreshortening(b, carm) * b.length_mm for b in tree.branches) / total


def foreshortening(branch: Branch, carm: CArm) -> float:
    """Share of the branch's length that a view hides, 0 (in the picture plane) .. 1 (end on)."""
    steps = np.diff(branch.points_mm, axis=0)
    length = np.linalg.norm(steps, axis=1)
    middle = 0.5 * (branch.points_mm[1:] + branch.points_mm[:-1])
    ray = middle - carm.source_mm
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12)
    across = np.linalg.norm(np.cross(steps, ray), axis=1)
    total = float(length.sum())
    return float(1.0 - across.sum() / total) if total > 0 else 0.0


def _direction(points_mm: Scalars, radius_mm: Scalars) -> Scalars:
    """(3,) unit vector from the first point to one clear of the other branches."""
    arc = np.linalg.norm(points_mm - points_mm[0], axis=1)
    reach = max(ANGLE_REACH_MM, 2.0 * float(radius_mm[0]))
    beyond = np.flatnonzero(arc >= reach)
    k = int(beyond[0]) if len(beyond) else len(points_mm) - 1
    way = points_mm[k] - points_mm[0]
    out: Scalars = way / max(float(np.linalg.norm(way)), 1e-12)
    return out

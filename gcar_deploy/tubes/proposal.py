"""Where in depth a line that no tube explains could run.

Each pixel of the line is a ray; where along it the vessel lies is asked of the other views (vessel
that nothing explains is best, vessel that others explain is possible, none is unlikely), of the
predictor's evidence, of the tree, from which one end must leave along what every view shows, and
of the vessel itself, which bends slowly. The cheapest course is a proposal: the fit says whether
it earns its place.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.tree.edit import with_branch
from gcar_deploy.tree.tree import Tree, along, polyline_arc
from gcar_deploy.tubes.course import cheapest_course
from gcar_deploy.tubes.missed import MISSED_SHARE, Look, MissedLine
from gcar_deploy.tubes.support import least_seen, sampled
from gcar_deploy.types import Array, Pixels, Points, Scalars

#: distance of places on the line and of depths, how far beyond the tree depths are tried, mm
PLACE_MM, DEPTH_MM, ROOM_MM = 2.0, 0.5, 15.0
#: costs per mm: no vessel in the other views, vessel there that tubes explain, no evidence
NO_VESSEL, EXPLAINED, NO_EVIDENCE = 4.0, 0.6, 0.5
#: vessel is what shows this share of the line's own path, which another view crosses otherwise, and
#: at least so many mm
ENOUGH, ENOUGH_MM = 0.5, 0.15
#: courses that cost more than this per mm are no proposal, nor are those of which the other views
#: show less than this share beyond what tubes explain
MOST_COST, LEAST_NEW = 2.0, 0.05
#: from the tree to the first place that the line shows, at most so far, mm; each mm costs so much,
#: and ``NO_VESSEL`` where a view shows none
MOST_GAP_MM, GAP_COST, GAP_PLACES = 25.0, 1.0, 8
#: an end this near to the tree is on it, mm
ON_TREE_MM = 0.5
#: the first place is joined to the tree, mm
JOINED_MM = 5.0
#: random walk of the course's direction, 1 / sqrt(mm)
TURN = 0.15
#: first radius of a proposal, mm, and how far it is believed
RADIUS_BOUNDS_MM, CONFIDENCE = (0.3, 2.0), 0.4


@dataclasses.dataclass(frozen=True, eq=False)
class Told:
    """What the predictor said of each candidate before any was chosen, to be asked at any place.

    Attributes
    ----------
    lookup : cKDTree of the n candidates
    share : (n + 1,) root of their confidence, and 0 for a place without a candidate
    reach_mm : a candidate speaks for places so near
    """

    lookup: cKDTree
    share: Scalars
    reach_mm: float

    @staticmethod
    def by(evidence: CenterPoints) -> Told:
        """Prepare the evidence for questions."""
        share = np.append(np.sqrt(evidence.confidence), 0.0)
        return Told(cKDTree(evidence.points_mm), share, evidence.spacing_mm)

    def at(self, points_mm: Points) -> Scalars:
        """(n,) share told at (n, 3) points."""
        # What finds no candidate gets the number behind the last.
        _, near = self.lookup.query(points_mm, distance_upper_bound=self.reach_mm)
        said: Scalars = self.share[near]
        return said


@dataclasses.dataclass(frozen=True, eq=False)
class Proposal:
    """A vessel that a missed line could be.

    Attributes
    ----------
    cost : of its course, per mm
    points_mm : (m, 3) along it, from the tree
    radius_mm : float
    """

    cost: float
    points_mm: Points
    radius_mm: float

    def added(self, tree: Tree) -> Tree:
        """Return the tree with the vessel."""
        return with_branch(tree, self.points_mm, self.radius_mm, CONFIDENCE, JOINED_MM)


def proposal(line: MissedLine, looks: Sequence[Look], tree: Tree, told: Told) -> Proposal | None:
    """Find the vessel that a line could be; None where no course is likely or it is explained now.

    Parameters
    ----------
    line : MissedLine of ``looks``, maybe of earlier ones
    looks : of ``tree``
    tree : Tree, at least one branch
    told : Told
    """
    look = looks[line.view]
    col, row = line.pixels[line.core].astype(np.int64).T
    if np.mean(look.missed[row, col]) < MISSED_SHARE:
        return None
    path = float(np.median(look.left_mm[row, col]))
    arc = polyline_arc(line.pixels) * look.target.pixel_mm
    count = max(round(arc[-1] / PLACE_MM), 2) + 1
    places = along(line.pixels, arc, np.linspace(0.0, arc[-1], count))
    step = arc[-1] / (count - 1)
    points = _depths(look, places, tree)
    others = [other for number, other in enumerate(looks) if number != line.view]
    cost, new = _costs(points, others, _paths(look, places, path), told)
    lookup = cKDTree(tree.points())
    courses, limit = [], MOST_COST * count * step
    for way in (slice(None), slice(None, None, -1)):
        # Whichever end leaves the tree comes first.
        gap, start = _nearest(points[way][0], lookup)
        away = _gap_costs(points[way][0], start, gap, looks, path)
        found = cheapest_course(step * cost[way], away, DEPTH_MM, step, TURN, limit)
        if found is None:
            continue
        depth, total = found
        at = np.arange(count), depth
        first = start[depth[:1]] if gap[depth[0]] > ON_TREE_MM else np.empty((0, 3))
        course = np.concatenate([first, points[way][at]])
        courses.append((total, course, float(new[way][at].mean())))
        limit = total
    if not courses:
        return None
    total, course, shown = min(courses, key=lambda one: one[0])
    if shown < LEAST_NEW:
        return None
    return Proposal(total / (count * step), course, float(np.clip(0.5 * path, *RADIUS_BOUNDS_MM)))


def _depths(look: Look, places: Pixels, tree: Tree) -> Points:
    """(n, d, 3) points along the rays of (n, 2) pixels, as deep as the tree and a little more."""
    carm = look.target.carm
    reach = np.linalg.norm(tree.points() - carm.source_mm, axis=1)
    depth = np.arange(reach.min() - ROOM_MM, reach.max() + ROOM_MM, DEPTH_MM)
    points: Points = carm.source_mm + carm.rays(places)[:, None, :] * depth[:, None]
    return points


def _paths(look: Look, places: Pixels, path: float) -> Scalars:
    """(n,) path of the line at (n, 2) places, mm: vessels taper, and cross others."""
    left = ndimage.map_coordinates(look.left_mm, places.T[::-1], order=1, mode="nearest")
    out: Scalars = np.minimum(ndimage.median_filter(left, 3, mode="nearest"), 1.5 * path)
    return out


def _costs(
    points: Points, others: Sequence[Look], path: Scalars, told: Told
) -> tuple[Array, Array]:
    """(n, d) cost per mm of a vessel of (n,) paths at (n, d, 3) points, and how much of it is new.

    New is the share of its path that the other views show and no tube explains, their mean.
    """
    enough = np.repeat(np.maximum(ENOUGH * path, ENOUGH_MM), points.shape[1])
    places = points.reshape(-1, 3)
    total, new = np.zeros((2, len(places)))
    for look in others:
        pictures = look.seen_mm, look.left_mm
        seen, left = np.minimum(sampled(look.target.carm, pictures, places) / enough, 1.0)
        total += NO_VESSEL * (1.0 - seen) + EXPLAINED * np.maximum(seen - left, 0.0)
        new += left / len(others)
    cost = total / len(others) + NO_EVIDENCE * (1.0 - told.at(places))
    return cost.reshape(points.shape[:-1]), new.reshape(points.shape[:-1])


def _nearest(points: Points, tree: cKDTree) -> tuple[Scalars, Points]:
    """Distance of (d, 3) points to the tree, mm, and the (d, 3) nearest points of it."""
    gap, at = tree.query(points)
    return gap, tree.data[at]


def _gap_costs(
    points: Points, start: Points, gap: Scalars, looks: Sequence[Look], path: float
) -> Scalars:
    """(d,) cost of leaving the tree at ``start`` for points that are ``gap`` mm away."""
    enough = np.maximum(0.5 * ENOUGH * path, ENOUGH_MM)
    share = np.linspace(0.0, 1.0, GAP_PLACES)[:, None, None]
    between = (start + (points - start) * share).reshape(-1, 3)
    seen = np.stack([sampled(k.target.carm, [k.seen_mm], between)[0] for k in looks]) / enough
    unseen = 1.0 - np.minimum(least_seen(seen), 1.0).reshape(GAP_PLACES, -1).mean(axis=0)
    # Too far is dearer than any course.
    out: Scalars = np.where(gap > MOST_GAP_MM, 1e6, gap * (GAP_COST + NO_VESSEL * unseen))
    return out

"""Vessels that one picture shows as a line and no tube explains: where in depth they could run.

A line of the skeleton whose path no tube accounts for was missed by whoever chose the starting
points. Each of its pixels is a ray; where along it the vessel lies is asked of the other views
(vessel that nothing explains is best, vessel that others explain is possible, none is unlikely),
of the predictor's evidence, of the tree, from which one end must leave, and of the vessel itself,
which bends slowly. The cheapest course is a proposal: the fit says whether it earns its place.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.line_chains import chains
from gcar_deploy.tree.edit import with_branch
from gcar_deploy.tree.tree import Tree, along, polyline_arc
from gcar_deploy.tubes.course import cheapest_course
from gcar_deploy.tubes.model import Footprint
from gcar_deploy.tubes.support import sampled
from gcar_deploy.tubes.targets import Target
from gcar_deploy.types import Array, Image, Pixels, Points, Scalars

#: a line counts where tubes leave this share of its path, over so many mm at the isocentre ...
MISSED_SHARE, MIN_LENGTH_MM = 0.5, 6.0
#: ... with holes up to this long; it is followed beyond its ends, to where it leaves the tree, mm
HOLE_MM, BEYOND_MM = 2.0, 6.0
#: a line that is a catheter, lead or wire with this mean probability is none
MOST_DEVICE = 0.2
#: paths are compared as means over this box, and tubes reach so much farther: fits are off by that
BOX_MM, NEAR_MM = 1.0, 0.7
#: path of no vessel, mm
LEAST_PATH_MM = 0.2
#: distance of places on the line and of depths, how far beyond the tree depths are tried, mm
PLACE_MM, DEPTH_MM, ROOM_MM = 2.0, 0.5, 15.0
#: costs per mm: no vessel in the other views, vessel there that tubes explain, no evidence
NO_VESSEL, EXPLAINED, NO_EVIDENCE = 3.0, 1.0, 2.0
#: courses that cost more than this per mm are no proposal. On generated pairs, exact and raw, 2.2
#: to 3.3 choose alike
MOST_COST = 2.9
#: ... and so are those of which the other views show less than this share beyond what tubes explain
LEAST_NEW = 0.2
#: one end leaves the tree: its distance from it costs one per mm, up to so many
MOST_GAP_MM = 12.0
#: an end this near to the tree is joined to it, mm
JOINED_MM = 5.0
#: random walk of the course's direction, 1 / sqrt(mm)
TURN = 0.15
#: first radius of a proposal, mm, and how far it is believed
RADIUS_BOUNDS_MM, CONFIDENCE = (0.3, 2.0), 0.4


@dataclasses.dataclass(frozen=True, eq=False)
class Look:
    """What one picture shows, and what of it no tube explains; both as means over ``BOX_MM``.

    Attributes
    ----------
    view : VesselImage
    target : Target of the picture's own pixels
    seen_mm, left_mm : (rows, cols) float32, path in the model's mm
    """

    view: VesselImage
    target: Target
    seen_mm: Image
    left_mm: Image

    @functools.cached_property
    def missed(self) -> Array:
        """(rows, cols) share of the path that no tube explains."""
        return self.left_mm / np.maximum(self.seen_mm, np.float32(LEAST_PATH_MM))


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
class MissedLine:
    """A line that one view shows and no tube explains.

    Attributes
    ----------
    view : number of the view, from 0
    pixels : (m, 2) (col, row) along it, followed beyond its ends
    core : what of them is missed
    """

    view: int
    pixels: Pixels
    core: slice


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


def looked_at(
    views: Sequence[VesselImage], targets: Sequence[Target], prints: Sequence[Footprint]
) -> list[Look]:
    """Compare pictures with tubes.

    Parameters
    ----------
    views, targets, prints : one each per view; targets are of the pictures' own pixels
    """
    return [_look(*one) for one in zip(views, targets, prints, strict=True)]


def _look(view: VesselImage, target: Target, seen: Footprint) -> Look:
    box = 2 * round(0.5 * BOX_MM / target.pixel_mm) + 1
    near = 2 * round(NEAR_MM / target.pixel_mm) + 1
    path = target.path_mm / target.contrast
    reach = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (near, near))
    model = cv2.dilate(seen.image(target.path_mm.shape).astype(np.float32), reach)
    shown, told = (cv2.blur(picture.astype(np.float32), (box, box)) for picture in (path, model))
    left = np.where(view.valid, np.maximum(shown - told, 0), 0)
    return Look(view, target, shown.astype(np.float32), left.astype(np.float32))


def missed_lines(looks: Sequence[Look]) -> list[MissedLine]:
    """Find the lines that no tube explains."""
    return [line for number, look in enumerate(looks) for line in _lines(number, look)]


def _lines(number: int, look: Look) -> list[MissedLine]:
    line, px = look.view.skeleton, look.target.pixel_mm
    hole, least = max(round(HOLE_MM / px), 1), MIN_LENGTH_MM / px
    missed = look.missed > MISSED_SHARE
    # Tracing lines takes far longer than to see that there are none.
    around = np.ones((2 * hole + 1, 2 * hole + 1), np.uint8)
    near = (cv2.dilate((line & missed).astype(np.uint8), around) > 0) & line
    if cv2.connectedComponentsWithStats(near.astype(np.uint8))[2][1:, 4].max(initial=0) < least:
        return []
    width: Image = 2 * cv2.distanceTransform(
        look.view.mask.astype(np.uint8), cv2.DIST_L2, 5
    ).astype(np.float32, copy=False)
    beyond, device = round(BEYOND_MM / px), look.view.device
    out = []
    for chain in chains(line, width):
        at = np.array(chain)
        open_ = np.pad(missed[at[:, 0], at[:, 1]], 2 * hole)
        open_ = ndimage.binary_closing(open_, iterations=hole)[2 * hole : -2 * hole]
        for (run,) in ndimage.find_objects(ndimage.label(open_)[0]):
            row, col = at[run].T
            if len(row) < least or (device is not None and device[row, col].mean() > MOST_DEVICE):
                continue
            first, last = max(run.start - beyond, 0), min(run.stop + beyond, len(at))
            pixels = at[first:last, ::-1].astype(np.float64)
            out.append(MissedLine(number, pixels, slice(run.start - first, run.stop - first)))
    return out


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
    cost, new = _costs(points, others, path, told)
    lookup = cKDTree(tree.points())
    courses = []
    for way in (slice(None), slice(None, None, -1)):
        # Whichever end leaves the tree comes first.
        gap = np.minimum(lookup.query(points[way][0])[0], MOST_GAP_MM)
        depth, total = cheapest_course(step * cost[way], gap, DEPTH_MM, step, TURN)
        at = np.arange(count), depth
        courses.append((total, points[way][at], float(new[way][at].mean())))
    total, course, shown = min(courses, key=lambda one: one[0])
    per_mm = total / (count * step)
    if per_mm > MOST_COST or shown < LEAST_NEW:
        return None
    return Proposal(per_mm, course, float(np.clip(0.5 * path, *RADIUS_BOUNDS_MM)))


def _depths(look: Look, places: Pixels, tree: Tree) -> Points:
    """(n, d, 3) points along the rays of (n, 2) pixels, as deep as the tree and a little more."""
    carm = look.target.carm
    reach = np.linalg.norm(tree.points() - carm.source_mm, axis=1)
    depth = np.arange(reach.min() - ROOM_MM, reach.max() + ROOM_MM, DEPTH_MM)
    points: Points = carm.source_mm + carm.rays(places)[:, None, :] * depth[:, None]
    return points


def _costs(points: Points, others: Sequence[Look], path: float, told: Told) -> tuple[Array, Array]:
    """(n, d) cost per mm of a vessel of that path at (n, d, 3) points, and how much of it is new.

    New is the share of its path that the other views show and no tube explains, their mean.
    """
    wanted = max(path, 0.5)
    places = points.reshape(-1, 3)
    total, new = np.zeros((2, len(places)))
    for look in others:
        pictures = look.seen_mm, look.left_mm
        seen, left = np.minimum(sampled(look.target.carm, pictures, places) / wanted, 1.0)
        total += NO_VESSEL * (1.0 - seen) + EXPLAINED * np.maximum(seen - left, 0.0)
        new += left / len(others)
    cost = total / len(others) + NO_EVIDENCE * (1.0 - told.at(places))
    return cost.reshape(points.shape[:-1]), new.reshape(points.shape[:-1])

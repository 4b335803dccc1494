"""Which tubes the pictures bear out, and what no tube explains: cut, drop and grow."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.tree.edit import UNTOLD, kept_branches, part_of, with_ends_moved
from gcar_deploy.tree.tree import Branch, Tree
from gcar_deploy.tubes.model import Footprint, Tubes
from gcar_deploy.tubes.targets import Target
from gcar_deploy.types import Array, Points

#: a branch or a free end is dropped where less than this share of it is seen in some view
MIN_SEEN = 0.4
#: free ends grow along what no tube explains, at most this far, mm
MAX_GROWTH_MM = 25.0
#: step and directions of a growing end.
GROWTH_STEP_MM = 1.0
GROWTH_CONE_DEG = 35.0
GROWTH_RINGS = 3
#: an end grows while the least share of its chord left unexplained in any view is above this.
GROWTH_SHARE = 0.5
#: growth shorter than this is not kept, mm.
MIN_GROWTH_MM = 3.0
#: share of the views that may fail to show a vessel that is there: where a thicker one covers it,
#: the thicker one's error swallows it. Of two or three views none may; of sixteen some view or
#: other nearly always does, so that "in every view" would cut true vessels the more, the more
#: views there are. The rays that cross in a ghost by chance are those of two or three views.
SPARE_VIEWS = 0.25


def least_seen(shares: Array) -> Array:
    """Return the least of the views' shares, the spare views left out, (views, n) to (n,).

    The smallest of two or three views, the second smallest of four, the fifth of sixteen. Views
    with NaN say nothing; 1 where none says anything.
    """
    told = np.count_nonzero(~np.isnan(shares), axis=0)
    spare = np.minimum(np.floor(SPARE_VIEWS * told).astype(np.int64), np.maximum(told - 1, 0))
    ordered = np.sort(np.where(np.isnan(shares), np.inf, shares), axis=0)
    least = np.take_along_axis(ordered, spare[None], axis=0)[0]
    return np.where(told > 0, least, 1.0)


def seen_share(tubes: Tubes, targets: list[Target], prints: list[Footprint]) -> Array:
    """Return the share of each segment's path that the picture leaves to it, (views, segments).

    What a pixel shows beyond all other tubes, at most what the segment claims there. NaN where
    a segment is not in the picture.
    """
    out = np.full((len(targets), len(tubes.first)), np.nan)
    for k, (target, seen) in enumerate(zip(targets, prints, strict=True)):
        total = seen.image(target.path_mm.shape).reshape(-1)
        data = target.path_mm.reshape(-1) / target.contrast
        left = data[seen.pixel] - (total[seen.pixel] - seen.path_mm)
        weight = target.weight.reshape(-1)[seen.pixel]
        claim = np.clip(left, 0.0, seen.path_mm) * weight
        claimed = np.bincount(seen.segment, seen.path_mm * weight, minlength=len(tubes.first))
        got = np.bincount(seen.segment, claim, minlength=len(tubes.first))
        ok = claimed > 1e-6
        out[k, ok] = got[ok] / claimed[ok]
    return out


def supported_tree(tree: Tree, tubes: Tubes, share: Array) -> Tree:
    """Drop branches and cut free ends that the views do not show (``least_seen``).

    Parameters
    ----------
    tree : Tree in step with ``tubes``
    share : (views, segments) from ``seen_share``
    """
    worst = least_seen(share)
    degrees = tree.degrees
    branches: list[Branch] = []
    keep: list[bool] = []
    for k, branch in enumerate(tree.branches):
        own = worst[tubes.branch == k]
        good = ndimage.uniform_filter1d(own, 3, mode="nearest") >= MIN_SEEN
        first, last = 0, len(branch) - 1
        if good.any():
            if degrees[branch.start] == 1:
                first = int(np.argmax(good))
            if degrees[branch.end] == 1:
                last = len(good) - int(np.argmax(good[::-1]))
        leaf = degrees[branch.start] == 1 or degrees[branch.end] == 1
        keep.append(bool(np.median(own[first:last]) >= MIN_SEEN) or not leaf)
        branches.append(part_of(branch, first, last))
    cut = with_ends_moved(dataclasses.replace(tree, branches=tuple(branches)))
    return kept_branches(cut, np.array(keep, bool))


def unexplained(targets: list[Target], prints: list[Footprint]) -> list[Array]:
    """Per view (rows, cols): millimetres of path that no tube explains, 0 or more."""
    return [
        np.maximum(target.path_mm / target.contrast - seen.image(target.path_mm.shape), 0.0)
        * target.weight
        for target, seen in zip(targets, prints, strict=True)
    ]


def grown_tree(tree: Tree, targets: list[Target], left: Sequence[Array]) -> Tree:
    """Lengthen free ends along what every view shows and no tube explains."""
    degrees = tree.degrees
    branches = list(tree.branches)
    for k, branch in enumerate(branches):
        for at_end in (False, True):
            node = branch.end if at_end else branch.start
            if degrees[node] != 1 or len(branch) < 3:
                continue
            points = branch.points_mm if at_end else branch.points_mm[::-1]
            radius = float(np.median((branch.radius_mm if at_end else branch.radius_mm[::-1])[-3:]))
            new = _grow(points, radius, targets, left, MAX_GROWTH_MM)
            if len(new) * GROWTH_STEP_MM >= MIN_GROWTH_MM:
                branch = _lengthened(branch, new, radius, at_end)
        branches[k] = branch
    return with_ends_moved(dataclasses.replace(tree, branches=tuple(branches)))


def _lengthened(branch: Branch, new: Points, radius: float, at_end: bool) -> Branch:
    count = len(new)

    def joined(old: Array, extra: Array) -> Array:
        return np.concatenate([old, extra] if at_end else [extra[::-1], old])

    return dataclasses.replace(
        branch,
        points_mm=joined(branch.points_mm, new),
        radius_mm=joined(branch.radius_mm, np.full(count, radius)),
        sigma_mm=joined(branch.sigma_mm, np.full(count, np.nan)),
        confidence=joined(branch.confidence, np.full(count, UNTOLD)),
    )


def _grow(
    points: Points, radius: float, targets: list[Target], left: Sequence[Array], limit_mm: float
) -> Points:
    """(m, 3) new points beyond the last one."""
    tip = points[-1].copy()
    back = points[max(len(points) - 4, 0)]
    direction = (tip - back) / max(float(np.linalg.norm(tip - back)), 1e-9)
    out: list[Points] = []
    while len(out) * GROWTH_STEP_MM < limit_mm:
        ways = _cone(direction)
        # Look one radius ahead, past the cap that already explains the tip's surroundings.
        score = np.full(len(ways), np.inf)
        for reach in (radius + GROWTH_STEP_MM, radius + 2 * GROWTH_STEP_MM):
            probe = tip + reach * ways
            seen = [sampled(t.carm, [rest], probe) for t, rest in zip(targets, left, strict=True)]
            score = np.minimum(score, least_seen(np.concatenate(seen)))
        score = score - 0.02 * radius * np.arange(len(ways))
        best = int(np.argmax(score))
        if score[best] < GROWTH_SHARE * 2 * radius:
            break
        direction = direction + 0.6 * (ways[best] - direction)
        direction /= np.linalg.norm(direction)
        tip = tip + GROWTH_STEP_MM * direction
        out.append(tip)
    return np.array(out).reshape(-1, 3)


def _cone(direction: Points) -> Points:
    """(m, 3) unit vectors round a direction, itself first, outwards."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    e1 = np.cross(direction, helper)
    e1 /= np.linalg.norm(e1)
    e2 = np.cross(direction, e1)
    out = [direction]
    for ring in range(1, GROWTH_RINGS + 1):
        a = np.radians(GROWTH_CONE_DEG * ring / GROWTH_RINGS)
        for phi in np.arange(8) * np.pi / 4:
            side = np.cos(phi) * e1 + np.sin(phi) * e2
            out.append(np.cos(a) * direction + np.sin(a) * side)
    return np.array(out)


def sampled(carm: CArm, pictures: Sequence[Array], points_mm: Points) -> Array:
    """(k, n) bilinear values of k pictures of one view at (n, 3) projected points; 0 outside."""
    pixels, depth = carm.project(points_mm)
    at = np.where(depth[:, None] > 1.0, pixels, -10.0).T[::-1]
    return np.stack([ndimage.map_coordinates(picture, at, order=1) for picture in pictures])

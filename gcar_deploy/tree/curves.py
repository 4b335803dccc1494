"""From cell paths to smooth branches: split at junctions, recentre, smooth, measure radius."""

from __future__ import annotations

import itertools

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.tree.tree import Branch, Tree, along, empty_tree, polyline_arc
from gcar_deploy.types import Array, Points, Scalars

#: distance between centreline points, lattice cells
STEP_CELLS = 0.8
#: correlation length of the centreline's smoothing, lattice cells
CURVE_CELLS = 2.0
#: radii outside are not believed, mm
MIN_RADIUS_MM, MAX_RADIUS_MM = 0.25, 4.0
#: points with less confidence than this move no centroid and change no threshold's outcome
LEAST_CONFIDENCE = 1e-6


def draw_branches(cells_mm: Points, paths: list[Array], centers: CenterPoints) -> Tree:
    """Turn paths over cells (tip first, junction or root last) into a smooth tree.

    Parameters
    ----------
    cells_mm : (n, 3) mm
    paths : list of (m,) cell indices; a later path ends on a cell of an earlier one
    centers : CenterPoints, for centroid and cross-section area
    """
    if not paths:
        return empty_tree()
    pieces = _split(paths)
    keys = sorted({int(end) for piece in pieces for end in (piece[0], piece[-1])})
    number = {key: i for i, key in enumerate(keys)}
    nodes = cells_mm[np.array(keys, dtype=np.int64)] if keys else np.zeros((0, 3))
    step = STEP_CELLS * centers.spacing_mm
    lines = [resample(cells_mm[piece], step) for piece in pieces]
    ends = np.array([[number[int(p[0])], number[int(p[-1])]] for p in pieces]).reshape(-1, 2)
    lines, nodes = _recentre(lines, ends, nodes, centers)
    lines = [resample(line, step) for line in lines]
    radii, confidence = _radii(lines, centers)
    branches = tuple(
        Branch(
            points_mm=line,
            radius_mm=radius,
            sigma_mm=np.full(len(line), np.nan),
            confidence=trust,
            start=int(end[0]),
            end=int(end[1]),
        )
        for line, radius, trust, end in zip(lines, radii, confidence, ends, strict=True)
    )
    return Tree(nodes_mm=nodes, branches=branches)


def resample(points_mm: Points, step_mm: float) -> Points:
    """(m, 3) points about ``step_mm`` apart along a polyline, both ends kept, m >= 2."""
    arc = polyline_arc(points_mm)
    count = max(int(np.rint(arc[-1] / step_mm)), 1) + 1
    return along(points_mm, arc, np.linspace(0.0, arc[-1], count))


def points_every(tree: Tree, step_mm: float) -> Points:
    """(n, 3) points along all branches, about ``step_mm`` apart; (0, 3) of an empty tree."""
    lines = (resample(branch.points_mm, step_mm) for branch in tree.branches)
    return np.concatenate([np.zeros((0, 3)), *lines])


def smooth_line(points_mm: Points, weight: Scalars, sigma_steps: float) -> Points:
    """Gaussian-weighted mean along a line; the ends stay where they are."""
    if len(points_mm) < 3 or sigma_steps <= 0:
        return points_mm
    # Smoothing the departure from the chord keeps the ends free of shrinking.
    t = np.linspace(0, 1, len(points_mm))[:, None]
    chord = points_mm[0] + t * (points_mm[-1] - points_mm[0])
    w = np.maximum(weight, 1e-3)[:, None]
    blur = {"sigma": sigma_steps, "axis": 0, "mode": "mirror", "truncate": 3.0}
    # Odd reflection: values beyond an end mirror with the opposite sign.
    away = points_mm - chord
    pad = min(len(points_mm) - 1, int(3 * sigma_steps) + 1)
    odd = np.concatenate([-away[pad:0:-1], away, -away[-2 : -pad - 2 : -1]])
    wide = np.concatenate([w[pad:0:-1], w, w[-2 : -pad - 2 : -1]])
    # Values and their weights in one call.
    sums = ndimage.gaussian_filter1d(np.concatenate([odd * wide, wide], axis=1), **blur)
    mean = sums[:, :-1] / sums[:, -1:]
    return chord + mean[pad : pad + len(points_mm)]


def _split(paths: list[Array]) -> list[Array]:
    """Cut the paths where others end on them."""
    joints = {int(path[-1]) for path in paths[1:]}
    pieces: list[Array] = []
    for path in paths:
        inner = [i for i in range(1, len(path) - 1) if int(path[i]) in joints]
        cuts = [0, *inner, len(path) - 1]
        pieces += [path[a : b + 1] for a, b in itertools.pairwise(cuts) if b > a]
    return pieces


def _recentre(
    lines: list[Points], ends: Array, nodes: Points, centers: CenterPoints
) -> tuple[list[Points], Points]:
    """Draw each point to the centroid of the points nearest to it, then smooth."""
    sigma = CURVE_CELLS / STEP_CELLS
    for _ in range(2):
        allpoints = np.concatenate(lines)
        centroid, mass = _centroids(allpoints, centers)
        start = 0
        moved: list[Points] = []
        for line in lines:
            part = slice(start, start + len(line))
            start += len(line)
            blend = np.where(mass[part, None] > 0, centroid[part], line)
            # Only across the line: along it the points stay evenly spread.
            moved.append(smooth_line(blend, mass[part], sigma))
        nodes = _joint_means(moved, ends, nodes)
        lines = [
            _pinned(line, nodes[end[0]], nodes[end[1]])
            for line, end in zip(moved, ends, strict=True)
        ]
    return lines, nodes


def _centroids(points: Points, centers: CenterPoints) -> tuple[Points, Scalars]:
    centers = centers.select(centers.confidence > LEAST_CONFIDENCE)
    near, nearest = _nearest(points, centers.points_mm, 4.0 * centers.spacing_mm)
    weight = centers.confidence * near
    mass = np.bincount(nearest, weight, minlength=len(points))
    total = np.stack(
        [
            np.bincount(nearest, weight * centers.points_mm[:, k], minlength=len(points))
            for k in range(3)
        ],
        axis=1,
    )
    return total / np.maximum(mass, 1e-9)[:, None], mass.astype(np.float64)


def _nearest(points: Points, asked: Points, reach_mm: float) -> tuple[Array, Array]:
    """(n,) whether one of ``points`` is within reach, and (n,) the nearest, 0 where none is."""
    distance, nearest = cKDTree(points).query(asked, distance_upper_bound=reach_mm)
    near = np.isfinite(distance)
    return near, np.where(near, nearest, 0)


def _joint_means(lines: list[Points], ends: Array, nodes: Points) -> Points:
    total, count = np.zeros_like(nodes), np.zeros(len(nodes))
    for line, end in zip(lines, ends, strict=True):
        for node, point in ((end[0], line[0]), (end[1], line[-1])):
            total[node] += point
            count[node] += 1
    return total / np.maximum(count, 1)[:, None]


def _pinned(line: Points, first: Points, last: Points) -> Points:
    """Move both ends onto their nodes; the shift fades out over a few points."""
    out = line.copy()
    fade = np.exp(-np.arange(len(line)) / 1.5)[:, None]
    fade[-1] = 0.0
    out += fade * (first - line[0])
    out += fade[::-1] * (last - line[-1])
    out[0], out[-1] = first, last
    return out


def _radii(lines: list[Points], centers: CenterPoints) -> tuple[list[Scalars], list[Scalars]]:
    """Radius from the volume of the points that each stretch of line stands for."""
    points = np.concatenate(lines)
    reach = max(4.0 * centers.spacing_mm, MAX_RADIUS_MM)
    near, nearest = _nearest(points, centers.points_mm, reach)
    weight = centers.confidence * near
    volume = np.bincount(nearest, weight, minlength=len(points)) * centers.spacing_mm**3
    count = np.bincount(nearest, near.astype(float), minlength=len(points))
    given = np.where(np.isfinite(centers.radius_mm), centers.radius_mm, 0.0)
    known = weight * np.isfinite(centers.radius_mm)
    told = np.bincount(nearest, known * given, minlength=len(points))
    told_mass = np.bincount(nearest, known, minlength=len(points))
    radii, trust = [], []
    sigma = 1.5 / STEP_CELLS
    start = 0
    for line in lines:
        part = slice(start, start + len(line))
        start += len(line)
        steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
        own = 0.5 * (np.append(steps, 0) + np.insert(steps, 0, 0))
        # End points also own what lies beyond the end, which is not length: leave them out.
        use = np.ones(len(line))
        if len(line) > 4:
            use[[0, -1]] = 0.0
        area, length, share, spoken, mass, cells = _blur(
            np.stack(
                [volume[part] * use, own * use, told_mass[part], told[part], volume[part],
                 count[part]]
            ), sigma,
        )  # fmt: skip
        radius = np.sqrt(np.maximum(area / np.maximum(length, 1e-9), 0) / np.pi)
        radius = np.where(share > 1e-6, spoken / np.maximum(share, 1e-9), radius)
        radii.append(np.clip(radius, MIN_RADIUS_MM, MAX_RADIUS_MM))
        trust.append(mass / np.maximum(cells * centers.spacing_mm**3, 1e-9))
    return radii, [np.clip(t, 0.0, 1.0) for t in trust]


def _blur(values: Array, sigma: float) -> Array:
    """(k, m) rows of values, blurred along a line of m points."""
    out: Array = ndimage.gaussian_filter1d(values, sigma, mode="nearest", truncate=3.0)
    return out

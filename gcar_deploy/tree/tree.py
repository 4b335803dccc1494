"""Tree: coronary vessels as branches of points with radius, joined at nodes."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from gcar_deploy.geometry.covariance import worst_sigma
from gcar_deploy.types import Array, Points, Scalars


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Branch:
    """One vessel piece between two nodes, its first and last point lying on them.

    Attributes
    ----------
    points_mm : (m, 3) centreline, mm LPS, m >= 2
    radius_mm : (m,) lumen radius, mm
    sigma_mm : (m,) standard deviation of the position (worst direction), mm; NaN if unknown
    confidence : (m,) 0 .. 1, mean confidence of the starting points nearest to the line here; a
        score that ranks points, not a calibrated probability
    start, end : int
        Rows of ``Tree.nodes_mm``.
    covariance_mm2 : (m, 2, 3, 3) covariance of the position across the vessel, mm^2 LPS: what the
        fit leaves open, and what the geometry adds; None if unknown. ``sigma_mm`` is the worst
        direction of their sum. Both hold if the branch is real
    """

    points_mm: Points
    radius_mm: Scalars
    sigma_mm: Scalars
    confidence: Scalars
    start: int
    end: int
    covariance_mm2: Array | None = None

    def __len__(self) -> int:
        return len(self.points_mm)

    @functools.cached_property
    def arc_mm(self) -> Scalars:
        """(m,) distance from the first point along the centreline, mm; read only."""
        arc = polyline_arc(self.points_mm)
        arc.setflags(write=False)
        return arc

    @property
    def length_mm(self) -> float:
        """Length of the centreline, mm."""
        return float(self.arc_mm[-1])

    @property
    def sigma_parts_mm(self) -> Array:
        """(m, 2) sigma in the worst direction of what the fit leaves open, and of the geometry."""
        if self.covariance_mm2 is None:
            return np.full((len(self), 2), np.nan)
        return worst_sigma(self.covariance_mm2)

    @functools.cached_property
    def tangents(self) -> Points:
        """(m, 3) unit vectors along the centreline; read only."""
        tangents = polyline_tangents(self.points_mm)
        tangents.setflags(write=False)
        return tangents


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Tree:
    """Branches joined at nodes; several components are allowed, loops are not made.

    Attributes
    ----------
    nodes_mm : (k, 3) ends and bifurcations, mm LPS
    branches : tuple of Branch
    """

    nodes_mm: Points
    branches: tuple[Branch, ...]

    @property
    def length_mm(self) -> float:
        """Sum of the branches' lengths, mm."""
        return float(sum(branch.length_mm for branch in self.branches))

    @property
    def degrees(self) -> Array:
        """(k,) number of branch ends at each node."""
        ends = [node for branch in self.branches for node in (branch.start, branch.end)]
        return np.bincount(np.asarray(ends, dtype=np.int64), minlength=len(self.nodes_mm))

    def points(self) -> Points:
        """(n, 3) points of all branches, in order."""
        return _joined([branch.points_mm for branch in self.branches], (0, 3))

    def radii(self) -> Scalars:
        """(n,) radii of all branches, in the order of ``points``."""
        return _joined([branch.radius_mm for branch in self.branches], (0,))

    def branch_index(self) -> Array:
        """(n,) branch of each point of ``points``."""
        sizes = [len(branch) for branch in self.branches]
        return np.repeat(np.arange(len(sizes)), np.asarray(sizes, dtype=np.int64))

    def moved(self, shift_mm: Points) -> Tree:
        """Return the same tree moved by (3,) mm."""
        return dataclasses.replace(
            self,
            nodes_mm=self.nodes_mm + shift_mm,
            branches=tuple(
                dataclasses.replace(branch, points_mm=branch.points_mm + shift_mm)
                for branch in self.branches
            ),
        )

    def segments(self) -> tuple[Points, Points, Scalars, Scalars]:
        """Return the tapered capsules: (s, 3) starts, (s, 3) ends, (s,) radii at each."""
        starts = [branch.points_mm[:-1] for branch in self.branches]
        ends = [branch.points_mm[1:] for branch in self.branches]
        first = [branch.radius_mm[:-1] for branch in self.branches]
        last = [branch.radius_mm[1:] for branch in self.branches]
        return (
            _joined(starts, (0, 3)),
            _joined(ends, (0, 3)),
            _joined(first, (0,)),
            _joined(last, (0,)),
        )

    def components(self) -> Array:
        """(k,) connected component of each node, numbered from 0 in order of first node."""
        label = np.arange(len(self.nodes_mm))
        for _ in range(len(self.branches) + 1):
            before = label.copy()
            for branch in self.branches:
                low = min(label[branch.start], label[branch.end])
                label[branch.start] = label[branch.end] = low
            if np.array_equal(before, label):
                break
        return np.unique(label, return_inverse=True)[1]

    def parts(self) -> Array:
        """(b,) connected component of each branch, numbered as those of the nodes."""
        starts = np.array([branch.start for branch in self.branches], np.int64)
        out: Array = self.components()[starts]
        return out

    def part_lengths_mm(self) -> Scalars:
        """(c,) vessel length in each connected component, mm."""
        lengths = np.array([branch.length_mm for branch in self.branches])
        return np.bincount(self.parts(), lengths).astype(np.float64)


def empty_tree() -> Tree:
    """Return a tree without a branch."""
    return Tree(nodes_mm=np.zeros((0, 3)), branches=())


def polyline_arc(points_mm: Points) -> Scalars:
    """(m,) distance of each point of a polyline from the first one along it, mm."""
    steps = points_mm[1:] - points_mm[:-1]
    arc = np.zeros(len(points_mm))
    # Not np.linalg.norm and np.diff, whose calls take longer than the work.
    np.cumsum(np.sqrt(np.add.reduce(steps * steps, axis=1)), out=arc[1:])
    return arc


def along(points_mm: Points, arc_mm: Scalars, at_mm: Array) -> Points:
    """Places on a polyline by linear interpolation.

    Parameters
    ----------
    points_mm : (m, d), also of a picture
    arc_mm : (m,) ascending distance of each
    at_mm : (...) distances asked for; those beyond the ends are held to them

    Returns
    -------
    (..., d)
    """
    out = np.empty((*at_mm.shape, points_mm.shape[1]))
    for axis, column in enumerate(points_mm.T):
        out[..., axis] = np.interp(at_mm, arc_mm, column)
    return out


def polyline_tangents(points_mm: Points) -> Points:
    """(m, 3) unit tangents of a polyline by central differences, m >= 2."""
    forward = np.diff(points_mm, axis=0)
    tangents = np.empty_like(points_mm)
    tangents[0], tangents[-1] = forward[0], forward[-1]
    tangents[1:-1] = forward[1:] + forward[:-1]
    length = np.linalg.norm(tangents, axis=1, keepdims=True)
    return tangents / np.maximum(length, 1e-12)


def _joined(parts: list[Array], empty_shape: tuple[int, ...]) -> Array:
    return np.concatenate(parts) if parts else np.zeros(empty_shape)

"""Where all views look: the space in which vessels are looked for when nobody names a volume."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.types import Array, Points, Scalars

#: no vessel of a heart is so far from the middle of the grid that is asked for, mm
FARTHEST_MM = 100.0


def common_field(grid: Grid, carms: Sequence[CArm]) -> Grid:
    """Return the box round all that every view sees, and round ``grid``; the same where it bounds.

    Parameters
    ----------
    grid : Grid that is asked for
    carms : V views

    Returns
    -------
    Grid with as many voxels: lattices are laid by its place and size alone
    """
    if grid.bounds:
        return grid
    sides = [_sides(carm) for carm in carms]
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    normal = np.concatenate([axes, *(n for n, _ in sides)])
    most = np.concatenate([axes @ grid.center_mm + FARTHEST_MM, *(d for _, d in sides)])
    corners = _corners(normal, most)
    if not len(corners):
        return grid
    low = np.minimum(corners.min(axis=0), grid.lower_mm)
    high = np.maximum(corners.max(axis=0), grid.lower_mm + grid.size_mm)
    center, size = 0.5 * (low + high), high - low
    return dataclasses.replace(grid, center_mm=tuple(center.tolist()), size_mm=tuple(size.tolist()))


def _sides(carm: CArm) -> tuple[Points, Scalars]:
    """Four planes from the source through the picture's edges: inside is n . p <= d."""
    right, bottom = carm.columns - 0.5, carm.rows - 0.5
    corners = np.array([(-0.5, -0.5), (right, -0.5), (right, bottom), (-0.5, bottom)])
    rays = carm.rays(corners)
    normal = np.cross(rays, np.roll(rays, -1, axis=0))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal *= -np.sign(normal @ rays.mean(axis=0))[:, None]
    return normal, normal @ carm.source_mm


def _corners(normal: Array, most: Scalars) -> Points:
    """(k, 3) corners of the space with n . p <= d for all (m, 3) normals and (m,) limits."""
    a, b, c = np.array(list(itertools.combinations(range(len(normal)), 3))).T
    across = np.cross(normal[b], normal[c])
    volume = (normal[a] * across).sum(axis=1)
    flat = np.abs(volume) < 1e-9
    points = (
        most[a, None] * across
        + most[b, None] * np.cross(normal[c], normal[a])
        + most[c, None] * np.cross(normal[a], normal[b])
    ) / np.where(flat, 1.0, volume)[:, None]
    inside = (points @ normal.T <= most + 1e-6).all(axis=1)
    found: Points = points[inside & ~flat]
    return found

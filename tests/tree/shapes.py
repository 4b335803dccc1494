"""Small trees with known answers."""

import numpy as np

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.tree.occupancy import tree_occupancy
from gcar_deploy.tree.tree import Branch, Tree


def branch(points, radius, start=0, end=1):
    points = np.asarray(points, dtype=float)
    radius = np.broadcast_to(np.asarray(radius, dtype=float), (len(points),)).copy()
    return Branch(
        points_mm=points,
        radius_mm=radius,
        sigma_mm=np.full(len(points), np.nan),
        confidence=np.ones(len(points)),
        start=start,
        end=end,
    )


def tube(length=30.0, radius=1.5, count=31, axis=(0.0, 0.0, 1.0)):
    t = np.linspace(-length / 2, length / 2, count)
    points = t[:, None] * np.asarray(axis) / np.linalg.norm(axis)
    return Tree(nodes_mm=points[[0, -1]], branches=(branch(points, radius),))


def fork(radius=(1.8, 1.3, 1.2)):
    """Y shape: one trunk up the z axis, two curved daughters, asymmetric."""
    s = np.linspace(0, 1, 25)[:, None]
    trunk = np.array([0, 0, -20.0]) + s * np.array([0, 0, 20.0])
    left = s * np.array([16.0, 3.0, 14.0]) + np.sin(np.pi * s) * np.array([0, 4.0, 0])
    right = s * np.array([-12.0, 8.0, 18.0]) + np.sin(np.pi * s) * np.array([3.0, 0, 0])
    lines = (trunk, left, right)
    nodes = np.array([trunk[0], [0, 0, 0], left[-1], right[-1]])
    ends = ((0, 1), (1, 2), (1, 3))
    branches = tuple(
        branch(line, r, a, b) for line, r, (a, b) in zip(lines, radius, ends, strict=True)
    )
    return Tree(nodes_mm=nodes, branches=branches)


def grid(shape=64, spacing=1.0, center=(0.0, 0.0, 0.0)):
    return Grid(center_mm=center, size_mm=(shape * spacing,) * 3, shape=(shape,) * 3)


def points_of(tree, where, noise=0.0, seed=0):
    """CenterPoints at the occupied voxels of a tree, occupancy as confidence."""
    volume = tree_occupancy(tree, where)
    index = np.argwhere(volume > 0)
    points = where.index2world(index)
    h = float(where.spacing_mm[0])
    if noise:
        points = points + np.random.default_rng(seed).normal(0, noise * h, points.shape)
    return CenterPoints(
        points_mm=points,
        confidence=volume[volume > 0].astype(float),
        radius_mm=np.full(len(points), np.nan),
        spacing_mm=h,
        source="multi",
    )


def enclosed_mm3(surface):
    """Volume inside a closed surface, positive when the normals point outwards."""
    a, b, c = (surface.vertices_mm[surface.faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def dice(a, b):
    a, b = a >= 0.5, b >= 0.5
    return 2 * np.count_nonzero(a & b) / (np.count_nonzero(a) + np.count_nonzero(b))

"""Rigid alignment of two point clouds whose frames have nothing to do with each other.

Starts at every proper rotation that maps principal axes on principal axes, goes on by trimmed
iterative closest points (Besl and McKay 1992; Chetverikov et al. 2002). Reflections are no rigid
motions and never tried.
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gcar_deploy.types import Array, Points

#: share of the nearest pairs that an iteration trusts
TRIM = 0.8
_COARSE_STEPS, _FINE_STEPS = 12, 60
_COARSE_POINTS = 600


@dataclasses.dataclass(frozen=True, eq=False)
class Rigid:
    """x -> rotation x + shift.

    Attributes
    ----------
    rotation : (3, 3), determinant +1
    shift : (3,) mm
    cost_mm : float, trimmed mean distance that is left
    """

    rotation: Array
    shift: Array
    cost_mm: float

    def apply(self, points: Points) -> Points:
        """(n, 3) points, moved."""
        moved: Points = points @ self.rotation.T + self.shift
        return moved


def best_rotation(a: Points, b: Points) -> tuple[Array, Array]:
    """Rotation and shift that bring (n, 3) ``a`` nearest to ``b`` point by point (Kabsch 1976)."""
    ca, cb = a.mean(axis=0), b.mean(axis=0)
    U, _, Vt = np.linalg.svd((a - ca).T @ (b - cb))
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(Vt.T @ U.T))])
    R = Vt.T @ turn @ U.T
    return R, cb - R @ ca


def align(moving: Points, fixed: Points) -> Rigid:
    """Find the rigid motion that lays ``moving`` on ``fixed``.

    Parameters
    ----------
    moving, fixed : (n, 3) and (m, 3) mm; ``moving`` may be a part of ``fixed``

    Returns
    -------
    Rigid
    """
    rng = np.random.default_rng(0)  # also of the starts beside the principal axes
    few = moving[rng.permutation(len(moving))[:_COARSE_POINTS]]
    tree = cKDTree(fixed)
    starts = [*_axis_rotations(moving, fixed), *Rotation.random(40, rng=rng).as_matrix()]
    tries = []
    for R in starts:
        shift = fixed.mean(axis=0) - R @ moving.mean(axis=0)
        tries.append(_icp(few, fixed, tree, Rigid(R, shift, np.inf), _COARSE_STEPS))
    tries.sort(key=lambda t: t.cost_mm)
    return min(
        (_icp(moving, fixed, tree, t, _FINE_STEPS) for t in tries[:4]), key=lambda t: t.cost_mm
    )


def _axis_rotations(moving: Points, fixed: Points) -> list[Array]:
    frames = [np.linalg.eigh(np.cov(x.T))[1] for x in (moving, fixed)]
    out = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            R = frames[1] @ np.diag(signs)[:, list(order)] @ frames[0].T
            if np.linalg.det(R) > 0:
                out.append(R)
    return out


def _icp(moving: Points, fixed: Points, tree: cKDTree, start: Rigid, steps: int) -> Rigid:
    now, last = start, np.inf
    for _ in range(steps):
        at = now.apply(moving)
        gap, index = tree.query(at)
        near = gap <= np.quantile(gap, TRIM)
        cost = float(gap[near].mean())
        if last - cost < 1e-4 * max(cost, 1e-9):
            return dataclasses.replace(now, cost_mm=cost)
        last = cost
        R, shift = best_rotation(moving[near], fixed[index[near]])
        now = Rigid(R, shift, cost)
    return now


def sample_surface(vertices: Points, faces: Array, count: int, seed: int = 0) -> Points:
    """(count, 3) points spread evenly over the triangles (m, 3) of a surface."""
    rng = np.random.default_rng(seed)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(faces), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    over = (u + v > 1)[:, 0]
    u[over], v[over] = 1 - u[over], 1 - v[over]
    points: Points = a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]
    return points


def read_stl(data: bytes) -> tuple[Points, Array]:
    """Vertices (3 m, 3) and faces (m, 3) of a binary STL file.

    Raises
    ------
    ValueError
        The length does not fit the number of triangles.
    """
    count = int(np.frombuffer(data, "<u4", 1, 80)[0]) if len(data) >= 84 else 0
    if count == 0 or len(data) != 84 + 50 * count:
        raise ValueError("is no binary STL file")
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("spare", "<u2")])
    corners = np.frombuffer(data, kind, count, 84)["corners"].astype(np.float64)
    return corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)

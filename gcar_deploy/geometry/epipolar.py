"""Two views: epipolar lines and planes, and points from pixels of several views."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gcar_deploy.errors import GeometryError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.types import Array, Pixels, Points, Scalars


def fundamental_matrix(first: CArm, second: CArm) -> Array:
    """(3, 3) F with x2^T F x1 = 0 for homogeneous pixels (col, row, 1) of one point.

    F = [e2]x P2 P1^+, e2 the projection of the first source in the second view
    (Hartley and Zisserman, Multiple View Geometry, eq. 9.1). Scaled to unit norm.
    """
    P1, P2 = first.world2pixel, second.world2pixel
    e2 = P2 @ np.append(first.source_mm, 1.0)
    cross = np.array([[0, -e2[2], e2[1]], [e2[2], 0, -e2[0]], [-e2[1], e2[0], 0]])
    F = cross @ P2 @ np.linalg.pinv(P1)
    return F / np.linalg.norm(F)


def epipolar_lines(first: CArm, second: CArm, pixels: Pixels) -> Array:
    """(n, 3) lines (a, b, c) in the second view for (n, 2) pixels of the first.

    a col + b row + c is the signed distance from the line in pixels of the second view.
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    lines = np.column_stack([pixels, np.ones(len(pixels))]) @ fundamental_matrix(first, second).T
    return lines / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)


def triangulate(carms: Sequence[CArm], pixels: Sequence[Pixels]) -> tuple[Points, Scalars]:
    """Find the points nearest to one ray per view, in the least-squares sense.

    Parameters
    ----------
    carms : sequence of v CArm, v >= 2
    pixels : sequence of v arrays (n, 2), (col, row) of the same n points

    Returns
    -------
    points_mm : (n, 3) mm LPS
    residual_mm : (n,) root mean square distance from the rays, mm
    """
    n = len(pixels[0])
    normal, right = np.zeros((n, 3, 3)), np.zeros((n, 3))
    across = []
    for carm, uv in zip(carms, pixels, strict=True):
        rays = carm.rays(uv)
        # I - r r^T takes out the direction along the ray, in which nothing is measured.
        Q = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        across.append((Q, carm.source_mm))
        normal += Q
        right += Q @ carm.source_mm
    points: Array = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
    squares = [np.sum(((Q @ (points - s)[:, :, None])[:, :, 0]) ** 2, axis=1) for Q, s in across]
    return points, np.sqrt(np.mean(squares, axis=0))


def ray_gaps(first: CArm, second: CArm, a: Pixels, b: Pixels) -> Scalars:
    """Signed distance between the rays of the same points in two views.

    Parameters
    ----------
    first, second : CArm
    a, b : (n, 2) (col, row) in the first and the second view

    Returns
    -------
    (n,) mm, along the common normal of both rays; 0 where they meet
    """
    if not len(a):
        return np.zeros(0)
    normal = np.cross(first.rays(a), second.rays(b))
    length = np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    gaps: Scalars = normal @ (second.source_mm - first.source_mm) / length
    return gaps


def plane_angles(first: CArm, second: CArm, carm: CArm, pixels: Pixels) -> Scalars:
    """Angle of the epipolar plane through each (n, 2) pixel of ``carm``, radians (n,).

    See ``plane_slices``.
    """
    return plane_slices(first, second, carm, pixels)[0]


def reach_mm(first: CArm, second: CArm) -> float:
    """Mm at the isocentre for each radian between epipolar planes."""
    return 0.5 * sum(float(np.linalg.norm(carm.source_mm)) for carm in (first, second))


def plane_slices(first: CArm, second: CArm, carm: CArm, pixels: Pixels) -> tuple[Scalars, Scalars]:
    """Epipolar plane of each pixel of ``carm``, and what its path length counts for there.

    Planes of the pair (first, second) turn about the line through both sources; zero is the
    plane through the isocentre. ``carm`` is one of the pair. Within one plane, with theta the
    angle between a ray and that line, and q the distance from it,

        integral of path(theta) / sin(theta) d theta = integral of density / q over the plane,

    which is the same for both sources (fan-beam consistency). A pixel of solid angle
    d Omega = sin(theta) d theta d kappa therefore counts with d Omega / sin(theta)^2, and sums
    over the pixels between two planes are exactly equal in both views, whatever is looked at.

    Parameters
    ----------
    first, second, carm : CArm
    pixels : (n, 2) (col, row)

    Returns
    -------
    angle : (n,) kappa, radians
    weight : (n,) d Omega / sin(theta)^2, radians squared

    Raises
    ------
    GeometryError
        Both sources coincide, or the isocentre lies between them on one line: no plane is
        defined.
    """
    return slices_along(plane_axes(first, second), carm, pixels)


def plane_axes(first: CArm, second: CArm) -> Array:
    """(3, 3) columns: across and within the plane of the isocentre, and along both sources.

    Raises
    ------
    GeometryError
        As ``plane_slices``.
    """
    source = first.source_mm
    base = second.source_mm - source
    length = _length(base)
    if length < 1e-6:
        raise GeometryError("both views have the same source: they have no epipolar planes")
    base = base / length
    towards = -source - (-source @ base) * base
    distance = _length(towards)
    if distance < 1e-6:
        raise GeometryError("the views face each other exactly: no plane through the isocentre")
    (x, y, z), (a, b, c) = base.tolist(), (towards / distance).tolist()
    # Plain numbers: for three of them np.cross takes ten times as long.
    return np.array([[y * c - z * b, a, x], [z * a - x * c, b, y], [x * b - y * a, c, z]])


def slices_along(plane_axes: Array, carm: CArm, pixels: Pixels) -> tuple[Scalars, Scalars]:
    """``plane_slices`` about the (3, 3) axes of ``plane_axes``."""
    # A pixel's ray is M^-1 (col, row, 1), of unit depth; its share along three axes.
    M = carm.world2pixel[:, :3]
    axes = np.linalg.solve(M.T, plane_axes)
    across, ahead, along = axes[:2].T @ np.asarray(pixels, dtype=np.float64).T + axes[2][:, None]
    from_base = across * across + ahead * ahead
    # d Omega is the pixel's area at unit depth (1 / |det M|) over the ray's length cubed, and
    # sin(theta) is its distance from the line over its length.
    weight = 1.0 / (abs(np.linalg.det(M)) * from_base * np.sqrt(from_base + along * along))
    return np.arctan2(across, ahead), weight


def _length(vector: Array) -> float:
    return math.sqrt(vector @ vector)


def plane_normal(first: CArm, second: CArm) -> Array:
    """(3,) unit normal of the epipolar plane through the isocentre: the visible direction.

    Motion along it shows in the pictures; motion within the plane does not.
    """
    (x, y, z), (a, b, c) = first.axes[2].tolist(), second.axes[2].tolist()
    normal = np.array([y * c - z * b, z * a - x * c, x * b - y * a])
    length = _length(normal)
    return normal / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])

"""What several views can know of a point: Cramer-Rao bounds, and what stays silent.

The bound of a point from pixel noise sigma_px is C = sigma_px^2 (J^T J)^-1 with J the stacked
Jacobians of all views. Two views at angle theta, parallel beams and s = sigma_px times the pixel
at the isocentre give the closed form RMSE = s sqrt(1/2 + 2 / sin^2 theta). Along a vessel nothing
is measured: there the bound is that across it (``worst_across``).
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np
from scipy.linalg import expm

from gcar_deploy.geometry.carm import CArm, separation_deg
from gcar_deploy.geometry.matrix import read_off
from gcar_deploy.types import Array, Points, Scalars

#: singular values below this share of the largest count as zero
RELATIVE_CUTOFF = 1e-6
#: a view that looks along the vessel within this angle measures nothing of it
ALONG_BEAM_DEG = 5.0
#: profiles of calibrated pictures that agree so well (``consistency.disagreement``) rule out an
#: angle error of a degree, which makes them differ by more
EXACT_DISAGREEMENT = 0.003
#: an error counts as silent if the pictures show less than this share of its effect
SILENT_SHARE = 0.05


def point_sigmas(
    carms: Sequence[CArm], points_mm: Points, sigma_px: float = 1.0
) -> tuple[Array, Array]:
    """Cramer-Rao standard deviations of free points.

    Parameters
    ----------
    carms : views
    points_mm : (n, 3) mm LPS
    sigma_px : float, noise of (col, row) in every view, pixels

    Returns
    -------
    sigma_mm : (n, 3) along the principal axes, smallest first; inf where no view measures
    axes : (n, 3, 3) rows are the unit axes that belong to them
    """
    J = np.concatenate([carm.jacobian(points_mm) for carm in carms], axis=1)
    _, singular, axes = np.linalg.svd(J, full_matrices=False)
    with np.errstate(divide="ignore"):
        sigma = np.where(singular > RELATIVE_CUTOFF * singular[:, :1], sigma_px / singular, np.inf)
    return sigma, axes


def curve_information(carm: CArm, points_mm: Points, tangents: Points) -> Array:
    """(n, 3, 3) Fisher information of one view about points of a vessel for 1 px of noise, mm^-2.

    A view measures only the component m = unit(d x T) of a displacement; sliding along the
    vessel leaves the picture as it is.
    """
    focal_px = math.sqrt(math.prod(carm.focal_px))
    return information_from(carm.source_mm, focal_px, points_mm, tangents)


def information_from(
    sources_mm: Points, focal_px: float, points_mm: Points, tangents: Points
) -> Array:
    """(..., n, 3, 3) ``curve_information`` of views from (..., 3) sources, all of one focal length.

    Parameters
    ----------
    sources_mm : (..., 3) mm LPS
    focal_px : float, geometric mean of both axes, pixels
    points_mm, tangents : (n, 3) mm LPS, unit vectors
    """
    rays = points_mm - sources_mm[..., None, :]
    depth = np.linalg.norm(rays, axis=-1)
    across = np.cross(rays / depth[..., None], tangents)
    sine = np.linalg.norm(across, axis=-1)
    seen = sine > math.sin(math.radians(ALONG_BEAM_DEG))
    m = across / np.maximum(sine, 1e-12)[..., None]
    weight = seen / (depth / focal_px) ** 2
    out: Array = weight[..., None, None] * m[..., :, None] * m[..., None, :]
    return out


def worst_across(information: Array) -> Scalars:
    """(...) standard deviation in the worse direction across a vessel, mm, for 1 px of noise.

    ``information`` (..., 3, 3) is what ``curve_information`` of all views adds up to; inf where at
    most one view measures.
    """
    # Only the plane across the vessel counts: along T the information is nil by construction. Of
    # the other two eigenvalues the trace is the sum, the principal minors add up to the product.
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = np.moveaxis(information, (-2, -1), (0, 1))
    total = xx + yy + zz
    product = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    high = 0.5 * (total + np.sqrt(np.maximum(total * total - 4.0 * product, 0.0)))
    low = product / np.maximum(high, 1e-300)
    with np.errstate(divide="ignore"):
        out: Scalars = np.where(
            low > RELATIVE_CUTOFF * high, 1.0 / np.sqrt(np.maximum(low, 1e-300)), np.inf
        )
    return out


def depth_and_plane(
    covariance: Array, points_mm: Points, carms: Sequence[CArm]
) -> tuple[Scalars, Scalars]:
    """Split standard deviations into depth and what a picture shows, root mean square of the views.

    Parameters
    ----------
    covariance : (n, 3, 3) mm^2
    points_mm : (n, 3) mm LPS
    carms : views

    Returns
    -------
    depth, plane : (n,) mm, along a view's beam, and per axis across it
    """
    depth2 = np.zeros(len(points_mm))
    for carm in carms:
        ray = points_mm - carm.source_mm
        ray = ray / np.linalg.norm(ray, axis=1)[:, None]
        depth2 += np.einsum("ni,nij,nj->n", ray, covariance, ray) / len(carms)
    plane2 = 0.5 * (np.trace(covariance, axis1=1, axis2=2) - depth2)
    return np.sqrt(np.maximum(depth2, 0.0)), np.sqrt(np.maximum(plane2, 0.0))


def _triangulation_shift(told: Sequence[CArm], true: Sequence[CArm], points_mm: Points) -> Points:
    """(n, 3) linearised error of points seen by ``true`` and triangulated with ``told``."""
    J = np.concatenate([carm.jacobian(points_mm) for carm in told], axis=1)
    change = np.concatenate(
        [
            b.project(points_mm)[0] - a.project(points_mm)[0]
            for a, b in zip(told, true, strict=True)
        ],
        axis=1,
    )
    return np.einsum("nij,nj->ni", np.linalg.pinv(J, rcond=RELATIVE_CUTOFF), change)


def silent_errors(carms: Sequence[CArm], *, exact: bool = False) -> tuple[str, ...]:
    """Say which usual errors of the geometry these views cannot show, and what each does.

    Each error is applied to the views in turn; it is silent if the pictures betray less than a
    twentieth of what it does to the points. Points fill a cube of +-50 mm evenly (its eight Gauss
    points have the same second moments), errors are root mean square.

    Parameters
    ----------
    carms : sequence of CArm
    exact : bool
        The vessel mass of every epipolar plane agrees within ``EXACT_DISAGREEMENT`` in all views:
        an angle error would not leave that, though it leaves each single point its rays.

    Returns
    -------
    sentences, each with the error in the geometry, its effect in mm, and that it leaves no trace
    """
    points = 50.0 / math.sqrt(3.0) * np.array(list(itertools.product((-1, 1), repeat=3)))
    # Errors are of angles and distances: what a matrix has beyond these stays out of the figures.
    carms = [carm.by_angles() for carm in carms]
    apart = [separation_deg(a, b) for a, b in itertools.combinations(carms, 2)]
    angle = max((min(s, 180 - s) for s in apart), default=0.0)
    out = []
    for name, true in _usual_errors(carms)[1 if exact else 0 :]:
        shift = _triangulation_shift(carms, true, points)
        effect = math.sqrt(float(np.mean(np.sum(shift**2, axis=1))))
        if effect > 0.05 and _trace_mm(carms, true, points, shift) < SILENT_SHARE * effect:
            out.append(
                f"{name} moves points by {effect:.1f} mm at {angle:.0f} deg, unseen in the pictures"
            )
    return tuple(out)


def _usual_errors(carms: Sequence[CArm]) -> list[tuple[str, list[CArm]]]:
    """Name what is often wrong, with the views as they would then really be."""
    rest, last = list(carms[:-1]), carms[-1]
    pitch = 1.03 if max(max(c.pixel_spacing_mm) for c in carms) < 9 else 0.97
    return [
        ("1 deg in the angle between the first and the last view", [*rest, _swung(carms, 1.0)]),
        (
            "a patient 5 mm off between the runs, within the plane of the beams",
            [*rest, last.moved(_in_plane(carms) * 5.0)],
        ),
        # A source 30 mm further away is a patient 30 mm nearer to the detector.
        ("30 mm in the source distance of all views", [c.moved(30.0 * c.axes[2]) for c in carms]),
        (
            "3 % in the pixel spacing of all views",
            [
                dataclasses.replace(
                    c,
                    pixel_spacing_mm=(pitch * c.pixel_spacing_mm[0], pitch * c.pixel_spacing_mm[1]),
                )
                for c in carms
            ],
        ),
    ]


def _trace_mm(
    told: Sequence[CArm], true: Sequence[CArm], points_mm: Points, shift_mm: Points
) -> float:
    """Residual that the triangulated points leave per coordinate, mm at the isocentre, rms."""
    squares = []
    for a, b in zip(told, true, strict=True):
        change = b.project(points_mm)[0] - a.project(points_mm)[0]
        left = change - np.einsum("nij,nj->ni", a.jacobian(points_mm), shift_mm)
        squares.append(np.mean((left * a.pixel_at_isocenter_mm) ** 2))
    return math.sqrt(float(np.mean(squares)))


def _swung(carms: Sequence[CArm], angle_deg: float) -> CArm:
    """Return the last view turned about the isocentre within the plane of the first and last."""
    normal = np.cross(_in_plane(carms), carms[-1].axes[2])
    x, y, z = math.radians(angle_deg) * normal
    last, P = carms[-1], carms[-1].world2pixel
    turn = expm(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
    told = read_off(np.column_stack([P[:, :3] @ turn, P[:, 3]]))
    return CArm.from_reading(
        told, last.sdd_mm, rows=last.rows, columns=last.columns, sod_mm=last.sod_mm
    )


def _in_plane(carms: Sequence[CArm]) -> Array:
    """Return the unit vector in the plane of the first and last beam, across the last."""
    d0, d1 = carms[0].axes[2], carms[-1].axes[2]
    across = d0 - (d0 @ d1) * d1
    length = float(np.linalg.norm(across))
    return across / length if length > 1e-9 else np.zeros(3)

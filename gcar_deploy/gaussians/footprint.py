"""The footprint of each Gaussian in a view, its window of pixels, and the exact line integral."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from gcar_deploy.gaussians.gaussians import TWO_PI_3_2, Gaussians
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.types import Array, Pixels, Points, Scalars

#: variance of a pixel's box, pixels squared
PIXEL_VARIANCE = 1.0 / 12.0
#: Gaussians nearer to the source than this are left out, mm
NEAREST_MM = 1.0
#: windows whose sides differ by less than this factor are done together
_BUCKET = 1.3
#: pixels of one block of work
_BLOCK = 1 << 20


@dataclasses.dataclass(frozen=True, eq=False)
class Footprint:
    """Projected Gaussians of one view.

    Attributes
    ----------
    seen : (n,) bool, in front of the source
    centre : (n, 2) pixels (col, row)
    depth : (n,) mm
    depth_axis : (3,) unit vector from source to detector
    J : (n, 2, 3) Jacobian of the projection, pixels per mm
    R, Sigma : (n, 3, 3) rotation and covariance (mm^2)
    inverse : (n, 2, 2) of the covariance in the picture with the pixel's box
    covariance : (n, 2, 2) pixels^2
    unit_amplitude : (n,) peak path length for intensity 1, mm
    amplitude : (n,) peak path length, mm
    """

    seen: Array
    centre: Pixels
    depth: Scalars
    depth_axis: Array
    J: Array
    R: Array
    Sigma: Array
    covariance: Array
    inverse: Array
    unit_amplitude: Scalars
    amplitude: Scalars


def footprint(gaussians: Gaussians, carm: CArm) -> Footprint:
    """Project the Gaussians; those not in front of the source get amplitude zero."""
    depth_axis = carm.world2pixel[2, :3]
    depth = carm.project(gaussians.means_mm)[1]
    seen = depth > NEAREST_MM
    # Whoever is not seen is put on the axis: finite numbers, zero weight.
    at = np.where(seen[:, None], gaussians.means_mm, carm.source_mm + 500.0 * depth_axis)
    centre, depth = carm.project(at)
    J = carm.jacobian(at)
    R = gaussians.rotations()
    half = R * gaussians.scales_mm[:, None, :]
    Sigma = half @ half.transpose(0, 2, 1)
    JT = J.transpose(0, 2, 1)
    S = J @ Sigma @ JT + PIXEL_VARIANCE * np.eye(2)
    determinant = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] * S[:, 1, 0]
    kappa = np.sqrt(np.linalg.det(J @ JT))
    unit_mass = TWO_PI_3_2 * np.prod(gaussians.scales_mm, axis=1)
    unit = np.where(seen, unit_mass * kappa / (2 * np.pi * np.sqrt(determinant)), 0.0)
    return Footprint(
        seen=seen,
        centre=centre,
        depth=depth,
        depth_axis=depth_axis,
        J=J,
        R=R,
        Sigma=Sigma,
        covariance=S,
        inverse=np.linalg.inv(S),
        unit_amplitude=unit,
        amplitude=unit * gaussians.intensity,
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Window:
    """m Gaussians with their k pixels each.

    Attributes
    ----------
    chosen : (m,) which Gaussians
    flat : (m, k) index of the pixel in the flattened picture, 0 outside
    inside : (m, k) bool, in the picture and in the Gaussian's own window
    delta : (m, k, 2) pixel minus centre, (col, row)
    """

    chosen: Array
    flat: Array
    inside: Array
    delta: Array

    def exponent(self, f: Footprint) -> Array:
        """(m, k) squared Mahalanobis distance."""
        inverse = f.inverse[self.chosen]
        d = self.delta
        q: Array = (
            inverse[:, None, 0, 0] * d[..., 0] ** 2
            + 2 * inverse[:, None, 0, 1] * d[..., 0] * d[..., 1]
            + inverse[:, None, 1, 1] * d[..., 1] ** 2
        )
        return q


def windows(f: Footprint, carm: CArm, cut_sigmas: float) -> Iterator[Window]:
    """Yield all Gaussians that touch the picture, bucket by bucket of like window size."""
    reach = cut_sigmas * np.sqrt(np.stack([f.covariance[:, 0, 0], f.covariance[:, 1, 1]], axis=1))
    size = np.array([carm.columns, carm.rows])
    low = np.clip(np.ceil(f.centre - reach), 0, size).astype(np.int64)
    high = np.clip(np.floor(f.centre + reach), -1, size - 1).astype(np.int64)
    extent = high - low + 1
    touching = f.seen & (extent > 0).all(axis=1)
    step = np.log(_BUCKET)
    bucket = np.ceil(np.log(np.maximum(extent, 1)) / step).astype(np.int64)
    key = np.where(touching, bucket[:, 0] * 1000 + bucket[:, 1], -1)
    for k in np.unique(key[touching]):
        same = np.flatnonzero(key == k)
        width, height = extent[same].max(axis=0)
        cols, rows = (a.ravel() for a in np.meshgrid(np.arange(width), np.arange(height)))
        for chosen in np.array_split(same, max(1, len(same) * int(width * height) // _BLOCK)):
            col = low[chosen, 0, None] + cols
            row = low[chosen, 1, None] + rows
            inside = (col <= high[chosen, 0, None]) & (row <= high[chosen, 1, None])
            delta = np.stack([col, row], axis=2) - f.centre[chosen, None]
            yield Window(chosen, np.where(inside, row * carm.columns + col, 0), inside, delta)


def exact_line_integral(gaussians: Gaussians, origin_mm: Points, directions: Points) -> Array:
    """Integral of every Gaussian along every ray: slow, obvious, exact.

    Shifted and whitened, so that float32 keeps its digits: with w the vector from the ray's
    point nearest to the mean, w' = S^-1 R^T w, d' = S^-1 R^T d,
    P = I sqrt(2 pi) / |d'| exp(-|d' x w'|^2 / (2 |d'|^2)).

    Parameters
    ----------
    gaussians : n Gaussians
    origin_mm : (3,) or (m, 3), mm LPS
    directions : (m, 3) unit vectors

    Returns
    -------
    (m, n) mm
    """
    R = gaussians.rotations()
    v = gaussians.means_mm[None] - np.asarray(origin_mm).reshape(-1, 1, 3)
    t = np.einsum("mnc,mc->mn", v, directions)
    w = v - t[:, :, None] * directions[:, None]
    white_w = np.einsum("nij,mni->mnj", R, w) / gaussians.scales_mm
    white_d = np.einsum("nij,mi->mnj", R, directions) / gaussians.scales_mm
    a = np.sum(white_d**2, axis=2)
    cross = np.cross(white_d, white_w)
    q = np.sum(cross**2, axis=2) / a
    path: Array = gaussians.intensity * np.sqrt(2 * np.pi / a) * np.exp(-0.5 * q)
    return path

"""Analytic projection of Gaussians to a view, integrated over the pixel, and its gradient.

The projection of a Gaussian is a Gaussian of the picture: centre pi(mu), covariance
S = J Sigma J^T in pixels (EWA, Zwicker et al. 2001), to which the pixel's own box adds 1/12.
Its amplitude follows from the mass M, which projection conserves:

    P(p) = M kappa / (2 pi sqrt|S|) exp(-1/2 (p - pi)^T S^-1 (p - pi)),  kappa = sqrt|J J^T|

kappa is the number of pixels that a square millimetre across the ray covers. M stays finite as
an axis collapses, no inverse of Sigma is needed, and no volume is ever made.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import DTypeLike

from gcar_deploy.gaussians.footprint import Footprint, footprint, windows
from gcar_deploy.gaussians.gaussians import Gaussians
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.types import Array, Points, Scalars

#: half width of a window in standard deviations; 3e-4 of the peak lies beyond
CUT_SIGMAS = 4.0


@dataclasses.dataclass(frozen=True, eq=False)
class Gradient:
    """Gradient of a scalar of the picture by the parameters of n Gaussians.

    Attributes
    ----------
    means_mm : (n, 3) per mm
    log_scales : (n, 3) per unit of log scale
    quaternions_wxyz : (n, 4)
    intensity : (n,)
    """

    means_mm: Points
    log_scales: Array
    quaternions_wxyz: Array
    intensity: Scalars


def project(
    gaussians: Gaussians,
    carm: CArm,
    *,
    dtype: DTypeLike = np.float64,
    cut_sigmas: float = CUT_SIGMAS,
) -> Array:
    """Path length of every pixel through the Gaussians.

    Parameters
    ----------
    gaussians : Gaussians; those not in front of the source are left out
    carm : CArm of the picture to make
    dtype : of the exponentials and of the picture
    cut_sigmas : half width of each Gaussian's window

    Returns
    -------
    (rows, columns), mm
    """
    f = footprint(gaussians, carm)
    image = np.zeros(carm.rows * carm.columns, dtype)
    for w in windows(f, carm, cut_sigmas):
        value = f.amplitude[w.chosen, None].astype(dtype) * np.exp(
            -0.5 * w.exponent(f).astype(dtype)
        )
        # bincount adds in a fixed order: the same bytes every time.
        image += np.bincount(
            w.flat[w.inside], weights=value[w.inside], minlength=len(image)
        ).astype(dtype)
    return image.reshape(carm.rows, carm.columns)


def project_vjp(
    gaussians: Gaussians, carm: CArm, grad_image: Array, *, cut_sigmas: float = CUT_SIGMAS
) -> Gradient:
    """Pull a gradient by the picture (rows, columns) back to the parameters."""
    f = footprint(gaussians, carm)
    flat_grad = np.asarray(grad_image, dtype=np.float64).ravel()
    n = len(gaussians)
    g0, g1, g2 = np.zeros(n), np.zeros((n, 2)), np.zeros((n, 2, 2))
    for w in windows(f, carm, cut_sigmas):
        weight = np.exp(-0.5 * w.exponent(f)) * w.inside * flat_grad[w.flat]
        g0[w.chosen] = weight.sum(axis=1)
        g1[w.chosen] = np.einsum("nk,nkc->nc", weight, w.delta)
        g2[w.chosen] = np.einsum("nk,nkc,nkd->ncd", weight, w.delta, w.delta, optimize=True)
    return _to_parameters(gaussians, f, g0, g1, g2)


def _to_parameters(g: Gaussians, f: Footprint, g0: Scalars, g1: Array, g2: Array) -> Gradient:
    """Chain the moments of (gradient times footprint) to the parameters; see the module's head."""
    A, inverse = f.amplitude, f.inverse
    by_centre = A[:, None] * np.einsum("nij,nj->ni", inverse, g1)
    by_S = 0.5 * A[:, None, None] * (inverse @ g2 @ inverse - g0[:, None, None] * inverse)
    JT = f.J.transpose(0, 2, 1)
    by_Sigma = JT @ by_S @ f.J
    # J enters through S and through kappa; it varies with the mean as perspective does.
    by_J = 2.0 * by_S @ f.J @ f.Sigma
    by_J += (g0 * A)[:, None, None] * (np.linalg.inv(f.J @ JT) @ f.J)
    by_mean = np.einsum("nij,ni->nj", f.J, by_centre)
    across = np.einsum("nij,j->ni", by_J, f.depth_axis)
    by_mean -= np.einsum("nij,ni->nj", f.J, across) / f.depth[:, None]
    scale = np.einsum("nij,nij->n", by_J, f.J) / f.depth
    by_mean -= scale[:, None] * f.depth_axis
    R, s2 = f.R, g.scales_mm**2
    by_log_scale = 2.0 * s2 * np.einsum("nji,njk,nki->ni", R, by_Sigma, R)
    by_log_scale += (g0 * A)[:, None]
    by_R = 2.0 * by_Sigma @ R * s2[:, None, :]
    return Gradient(
        means_mm=by_mean * f.seen[:, None],
        log_scales=by_log_scale * f.seen[:, None],
        quaternions_wxyz=by_quaternion(g.quaternions_wxyz, by_R) * f.seen[:, None],
        intensity=g0 * f.unit_amplitude * f.seen,
    )


def by_quaternion(quaternions: Array, by_R: Array) -> Array:
    """(n, 4) gradient by (w, x, y, z) through the normalisation; zero quaternions get none."""
    length = np.linalg.norm(quaternions, axis=1)
    safe = np.maximum(length, 1e-12)
    w, x, y, z = (quaternions / safe[:, None]).T
    B = by_R
    gw = 2 * (
        x * (B[:, 2, 1] - B[:, 1, 2])
        + y * (B[:, 0, 2] - B[:, 2, 0])
        + z * (B[:, 1, 0] - B[:, 0, 1])
    )
    gx = 2 * (
        -2 * x * (B[:, 1, 1] + B[:, 2, 2])
        + y * (B[:, 0, 1] + B[:, 1, 0])
        + z * (B[:, 0, 2] + B[:, 2, 0])
        + w * (B[:, 2, 1] - B[:, 1, 2])
    )
    gy = 2 * (
        x * (B[:, 0, 1] + B[:, 1, 0])
        - 2 * y * (B[:, 0, 0] + B[:, 2, 2])
        + z * (B[:, 1, 2] + B[:, 2, 1])
        + w * (B[:, 0, 2] - B[:, 2, 0])
    )
    gz = 2 * (
        x * (B[:, 0, 2] + B[:, 2, 0])
        + y * (B[:, 1, 2] + B[:, 2, 1])
        - 2 * z * (B[:, 0, 0] + B[:, 1, 1])
        + w * (B[:, 1, 0] - B[:, 0, 1])
    )
    unit = np.stack([gw, gx, gy, gz], axis=1)
    q = quaternions / safe[:, None]
    tangent = unit - np.sum(unit * q, axis=1, keepdims=True) * q
    gradient: Array = np.where(length[:, None] > 1e-12, tangent / safe[:, None], 0.0)
    return gradient

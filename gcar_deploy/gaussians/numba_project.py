"""The compiled twin of ``project``: footprint, window and chain rule of one Gaussian after another.

NumPy passes over arrays of all windows' pixels; thousands of iterations want the loop itself. The
formulae are those of ``footprint`` and ``project``, with the same cut. Numba is imported when a
function is called, never with the package.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from gcar_deploy.errors import UsageError
from gcar_deploy.gaussians.footprint import NEAREST_MM, PIXEL_VARIANCE
from gcar_deploy.gaussians.gaussians import TWO_PI_3_2, Gaussians
from gcar_deploy.gaussians.project import CUT_SIGMAS, Gradient, by_quaternion
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.types import Array


def check_numba() -> None:
    """Make sure that numba is there.

    Raises
    ------
    UsageError
        It is not; the sentence says what to install.
    """
    try:
        import numba  # noqa: F401
    except ImportError:
        raise UsageError("backend numba is not installed: pip install 'gcar[export]'") from None


def project_compiled(g: Gaussians, carm: CArm) -> Array:
    """Like ``project``, in float64."""
    image = np.zeros((carm.rows, carm.columns))
    _loops()[0](image, *_given(g, carm))
    return image


def vjp_compiled(g: Gaussians, carm: CArm, grad_image: Array) -> Gradient:
    """Like ``project_vjp``."""
    n = len(g)
    by_mean, by_log_scale, by_R = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3, 3))
    by_intensity = np.zeros(n)
    grad = np.ascontiguousarray(grad_image, dtype=np.float64)
    _loops()[1](by_mean, by_log_scale, by_R, by_intensity, grad, *_given(g, carm))
    return Gradient(
        means_mm=by_mean,
        log_scales=by_log_scale,
        quaternions_wxyz=by_quaternion(g.quaternions_wxyz, by_R),
        intensity=by_intensity,
    )


def _given(g: Gaussians, carm: CArm) -> tuple[Array, ...]:
    half = g.rotations() * g.scales_mm[:, None, :]
    return g.means_mm, half, g.scales_mm, g.intensity, np.ascontiguousarray(carm.world2pixel)


@functools.cache
def _loops() -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Compile both directions, once per process (and machine: numba keeps them on disk)."""
    import numba

    @numba.njit(cache=True)
    def look(mean, half, scales, P, f, J, JS):  # type: ignore[no-untyped-def]
        """Fill f with centre, depth, inverse covariance, its diagonal, kappa and unit amplitude.

        J (2, 3) is the projection's Jacobian, JS (2, 3) = J R diag(scales).
        """
        for i in range(3):
            f[i] = P[i, 0] * mean[0] + P[i, 1] * mean[1] + P[i, 2] * mean[2] + P[i, 3]
        if f[2] <= NEAREST_MM:
            return False
        f[0] /= f[2]
        f[1] /= f[2]
        for i in range(2):
            for k in range(3):
                J[i, k] = (P[i, k] - f[i] * P[2, k]) / f[2]
        for i in range(2):
            for k in range(3):
                JS[i, k] = J[i, 0] * half[0, k] + J[i, 1] * half[1, k] + J[i, 2] * half[2, k]
        xx = JS[0, 0] ** 2 + JS[0, 1] ** 2 + JS[0, 2] ** 2 + PIXEL_VARIANCE
        yy = JS[1, 0] ** 2 + JS[1, 1] ** 2 + JS[1, 2] ** 2 + PIXEL_VARIANCE
        xy = JS[0, 0] * JS[1, 0] + JS[0, 1] * JS[1, 1] + JS[0, 2] * JS[1, 2]
        det = xx * yy - xy * xy
        f[3], f[4], f[5], f[6], f[7] = yy / det, -xy / det, xx / det, xx, yy
        f[8] = J[0, 0] ** 2 + J[0, 1] ** 2 + J[0, 2] ** 2
        f[9] = J[0, 0] * J[1, 0] + J[0, 1] * J[1, 1] + J[0, 2] * J[1, 2]
        f[10] = J[1, 0] ** 2 + J[1, 1] ** 2 + J[1, 2] ** 2
        kappa = np.sqrt(f[8] * f[10] - f[9] * f[9])
        mass = TWO_PI_3_2 * scales[0] * scales[1] * scales[2]
        f[11] = mass * kappa / (2 * np.pi * np.sqrt(det))
        return True

    @numba.njit(cache=True)
    def window(f, rows, cols):  # type: ignore[no-untyped-def]
        """Return first and last column, first and last row."""
        x, y = CUT_SIGMAS * np.sqrt(f[6]), CUT_SIGMAS * np.sqrt(f[7])
        return (
            int(np.ceil(min(max(f[0] - x, 0), cols))),
            int(np.floor(min(max(f[0] + x, -1), cols - 1))),
            int(np.ceil(min(max(f[1] - y, 0), rows))),
            int(np.floor(min(max(f[1] + y, -1), rows - 1))),
        )

    @numba.njit(cache=True)
    def forward(image, means, half, scales, intensity, P):  # type: ignore[no-untyped-def]
        f, J, JS = np.zeros(12), np.zeros((2, 3)), np.zeros((2, 3))
        for n in range(len(means)):
            if not look(means[n], half[n], scales[n], P, f, J, JS):
                continue
            c0, c1, r0, r1 = window(f, image.shape[0], image.shape[1])
            amplitude = f[11] * intensity[n]
            for row in range(r0, r1 + 1):
                y = row - f[1]
                for col in range(c0, c1 + 1):
                    x = col - f[0]
                    q = f[3] * x * x + 2 * f[4] * x * y + f[5] * y * y
                    image[row, col] += amplitude * np.exp(-0.5 * q)

    @numba.njit(cache=True)
    def backward(  # type: ignore[no-untyped-def]
        by_mean, by_log_scale, by_R, by_intensity, grad, means, half, scales, intensity, P
    ):
        f, J, JS = np.zeros(12), np.zeros((2, 3)), np.zeros((2, 3))
        by_J, across = np.zeros((2, 3)), np.zeros(2)
        for n in range(len(means)):
            if not look(means[n], half[n], scales[n], P, f, J, JS):
                continue
            c0, c1, r0, r1 = window(f, grad.shape[0], grad.shape[1])
            a, b, c = f[3], f[4], f[5]
            g0 = gx = gy = gxx = gxy = gyy = 0.0
            for row in range(r0, r1 + 1):
                y = row - f[1]
                for col in range(c0, c1 + 1):
                    x = col - f[0]
                    w = np.exp(-0.5 * (a * x * x + 2 * b * x * y + c * y * y)) * grad[row, col]
                    g0 += w
                    gx += w * x
                    gy += w * y
                    gxx += w * x * x
                    gxy += w * x * y
                    gyy += w * y * y
            A = f[11] * intensity[n]
            by_intensity[n] = g0 * f[11]
            px, py = A * (a * gx + b * gy), A * (b * gx + c * gy)
            # inverse G inverse, G the second moments, then the gradient by the covariance.
            ux, uy = a * gxx + b * gxy, a * gxy + b * gyy
            vx, vy = b * gxx + c * gxy, b * gxy + c * gyy
            sxx = 0.5 * A * (ux * a + uy * b - g0 * a)
            sxy = 0.5 * A * (ux * b + uy * c - g0 * b)
            syy = 0.5 * A * (vx * b + vy * c - g0 * c)
            # J enters through the covariance and through kappa.
            det = f[8] * f[10] - f[9] * f[9]
            kxx, kxy, kyy = g0 * A * f[10] / det, -g0 * A * f[9] / det, g0 * A * f[8] / det
            total = 0.0
            for i in range(2):
                across[i] = 0.0
            for k in range(3):
                t0 = JS[0, 0] * half[n, k, 0] + JS[0, 1] * half[n, k, 1] + JS[0, 2] * half[n, k, 2]
                t1 = JS[1, 0] * half[n, k, 0] + JS[1, 1] * half[n, k, 1] + JS[1, 2] * half[n, k, 2]
                by_J[0, k] = 2 * (sxx * t0 + sxy * t1) + kxx * J[0, k] + kxy * J[1, k]
                by_J[1, k] = 2 * (sxy * t0 + syy * t1) + kxy * J[0, k] + kyy * J[1, k]
                for i in range(2):
                    across[i] += by_J[i, k] * P[2, k]
                    total += by_J[i, k] * J[i, k]
            for k in range(3):
                m = J[0, k] * (px - across[0] / f[2]) + J[1, k] * (py - across[1] / f[2])
                by_mean[n, k] = m - total / f[2] * P[2, k]
                # Columns of R diag(s): JS holds J R s, so s^2 of the chain is already in.
                along = sxx * JS[0, k] ** 2 + 2 * sxy * JS[0, k] * JS[1, k] + syy * JS[1, k] ** 2
                by_log_scale[n, k] = 2 * along + g0 * A
                w0 = 2 * (sxx * JS[0, k] + sxy * JS[1, k]) * scales[n, k]
                w1 = 2 * (sxy * JS[0, k] + syy * JS[1, k]) * scales[n, k]
                for i in range(3):
                    by_R[n, i, k] = J[0, i] * w0 + J[1, i] * w1

    return forward, backward

"""Gaussians: the scene of the paper as frozen arrays.

G_i(X) = I_i exp(-1/2 (X - mu_i)^T Sigma_i^-1 (X - mu_i)), Sigma = R diag(s^2) R^T (3DGR-CAR,
eq. 1). Optimiser state lives elsewhere.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gcar_deploy.errors import UsageError
from gcar_deploy.types import Array, Points, Scalars

TWO_PI_3_2 = (2.0 * np.pi) ** 1.5


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Gaussians:
    """n anisotropic Gaussians.

    Attributes
    ----------
    means_mm : (n, 3) mm LPS
    scales_mm : (n, 3) standard deviations along the own axes, mm, above 0
    quaternions_wxyz : (n, 4) rotation from own axes to LPS; need not be unit, zero is identity
    intensity : (n,) peak density; 1 is a vessel full of contrast
    sigma_mm : (n, 3) or None
        Uncertainty of the mean along x, y, z, mm; NaN where unknown.

    Raises
    ------
    UsageError
        Shapes disagree, a value is not finite, or a scale is not above 0.
    """

    means_mm: Points
    scales_mm: Points
    quaternions_wxyz: Array
    intensity: Scalars
    sigma_mm: Points | None = None

    def __post_init__(self) -> None:
        n = len(self.means_mm)
        shapes = {
            "means_mm": (n, 3),
            "scales_mm": (n, 3),
            "quaternions_wxyz": (n, 4),
            "intensity": (n,),
        }
        for name, shape in shapes.items():
            array = np.asarray(getattr(self, name), dtype=np.float64)
            if array.shape != shape:
                raise UsageError(f"{name} has shape {array.shape}, {shape} is needed")
            if not np.isfinite(array).all():
                raise UsageError(f"{name} holds values that are not finite")
            object.__setattr__(self, name, array)
        if n and self.scales_mm.min() <= 0:
            raise UsageError(f"scales_mm = {self.scales_mm.min():g} mm must be above 0")
        if self.sigma_mm is not None and np.shape(self.sigma_mm) != (n, 3):
            raise UsageError(f"sigma_mm has shape {np.shape(self.sigma_mm)}, {(n, 3)} is needed")

    def __len__(self) -> int:
        return len(self.means_mm)

    def rotations(self) -> Array:
        """(n, 3, 3) matrices whose columns are the own axes in LPS."""
        return rotation_matrices(self.quaternions_wxyz)

    def covariances(self) -> Array:
        """(n, 3, 3) Sigma, mm^2."""
        half = self.rotations() * self.scales_mm[:, None, :]
        covariance: Array = half @ half.transpose(0, 2, 1)
        return covariance

    def masses_mm3(self) -> Scalars:
        """(n,) integral over space, I (2 pi)^1.5 s1 s2 s3, mm^3 of vessel."""
        mass: Scalars = self.intensity * TWO_PI_3_2 * np.prod(self.scales_mm, axis=1)
        return mass

    def select(self, keep: Array) -> Gaussians:
        """Return the Gaussians at a boolean mask or index array."""
        return Gaussians(
            means_mm=self.means_mm[keep],
            scales_mm=self.scales_mm[keep],
            quaternions_wxyz=self.quaternions_wxyz[keep],
            intensity=self.intensity[keep],
            sigma_mm=None if self.sigma_mm is None else self.sigma_mm[keep],
        )


def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
    """Join Gaussians in order; uncertainty survives only where every part has it."""
    sigmas = [part.sigma_mm for part in parts if part.sigma_mm is not None]
    return Gaussians(
        means_mm=np.concatenate([part.means_mm for part in parts]),
        scales_mm=np.concatenate([part.scales_mm for part in parts]),
        quaternions_wxyz=np.concatenate([part.quaternions_wxyz for part in parts]),
        intensity=np.concatenate([part.intensity for part in parts]),
        sigma_mm=np.concatenate(sigmas) if len(sigmas) == len(parts) else None,
    )


def rotation_matrices(quaternions_wxyz: Array) -> Array:
    """(n, 4) quaternions (w, x, y, z), any length, to (n, 3, 3); zero is the identity."""
    q = np.asarray(quaternions_wxyz, dtype=np.float64)
    length = np.linalg.norm(q, axis=1, keepdims=True)
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    w, x, y, z = np.where(length > 1e-12, q / np.maximum(length, 1e-12), identity).T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
        ],
        axis=1,
    )

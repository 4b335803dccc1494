"""Grid: a regular block of voxels, axis-parallel to LPS."""

from __future__ import annotations

import dataclasses
import math
import numbers
from typing import Any

import numpy as np

from gcar_deploy.errors import GeometryError
from gcar_deploy.geometry.fields import quote
from gcar_deploy.types import Array, Points

#: voxels of a grid
MOST_VOXELS = 2**28


def _check(key: str, values: Any, low: int, high: int, unit: str) -> None:
    """Refuse all but 3 numbers within the range, which holds no NaN."""
    try:
        told = tuple(values)
    except TypeError:
        told = ()
    fine = (isinstance(x, numbers.Real) and not isinstance(x, bool) for x in told)
    if len(told) != 3 or not all(fine):
        raise GeometryError(
            f"volume.{key} = {quote(values)} must be 3 numbers of {low} .. {high} {unit}"
        )
    if not all(low <= x <= high for x in told):
        raise GeometryError(f"volume.{key} = {values!r} is outside {low} .. {high} {unit}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Grid:
    """Voxel block; array index [i, j, k] runs along x (left), y (posterior), z (head).

    Attributes
    ----------
    center_mm : (3,) middle of the block, mm LPS
    size_mm : (3,) full edge lengths, mm
    shape : (3,) number of voxels along x, y, z
    bounds : whether vessels are looked for in it alone; otherwise beside it too, where all views
        show lines that nothing in it explains

    Raises
    ------
    GeometryError
        A value is no number or out of range, or there are more than 2^28 voxels.
    """

    center_mm: tuple[float, float, float]
    size_mm: tuple[float, float, float]
    shape: tuple[int, int, int]
    bounds: bool = True

    def __post_init__(self) -> None:
        _check("center_mm", self.center_mm, -2000, 2000, "mm")
        _check("size_mm", self.size_mm, 1, 2000, "mm")
        _check("shape", self.shape, 1, 1024, "voxels")
        if any(int(n) != n for n in self.shape):
            raise GeometryError(f"volume.shape = {self.shape!r} must be 3 whole numbers")
        if math.prod(self.shape) > MOST_VOXELS:
            raise GeometryError(f"volume.shape = {self.shape!r} has more than 2^28 voxels")

    @property
    def spacing_mm(self) -> Array:
        """(3,) voxel edge lengths, mm."""
        return np.asarray(self.size_mm, dtype=np.float64) / np.asarray(self.shape)

    @property
    def lower_mm(self) -> Array:
        """(3,) outer corner of voxel [0, 0, 0], mm LPS."""
        return np.asarray(self.center_mm) - 0.5 * np.asarray(self.size_mm)

    def index2world(self, index: Array) -> Points:
        """(n, 3) voxel indices, whole or fractional, to mm LPS; integers are voxel centres."""
        out: Points = np.asarray(index, dtype=np.float64) + 0.5
        # Axis by axis: rows of three at a time take five times as long.
        for axis, (low, edge) in enumerate(zip(self.lower_mm, self.spacing_mm, strict=True)):
            out[..., axis] *= edge
            out[..., axis] += low
        return out

    def world2index(self, points_mm: Points) -> Array:
        """(n, 3) mm LPS to fractional voxel indices."""
        out: Array = np.array(points_mm, dtype=np.float64)
        for axis, (low, edge) in enumerate(zip(self.lower_mm, self.spacing_mm, strict=True)):
            out[..., axis] -= low
            out[..., axis] /= edge
        out -= 0.5
        return out

    def affine_ras(self) -> Array:
        """(4, 4) voxel index to mm RAS, as NIfTI wants it."""
        affine = np.eye(4)
        affine[:3, :3] = np.diag(self.spacing_mm * (-1, -1, 1))
        affine[:3, 3] = self.index2world(np.zeros((1, 3)))[0] * (-1, -1, 1)
        return affine

    def corners_mm(self) -> Points:
        """(8, 3) outer corners, mm LPS."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return np.asarray(self.center_mm) + 0.5 * signs * np.asarray(self.size_mm)

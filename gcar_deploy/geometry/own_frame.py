"""A scene in its own terms: where its middle is, in which order its views stand.

Where the origin of the file's coordinates lies, which view is named first, and what arithmetic
does to the last digits of an angle says nothing of the vessels. What is computed in the scene's
own terms cannot depend on it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gcar_deploy.errors import GeometryError
from gcar_deploy.geometry.carm import HARD_RANGES, SDD_OVER_SOD, CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.matrix import read_off, rounded
from gcar_deploy.types import Points

#: geometry nearer than this is the same geometry: mm, pixels, degrees; far below what any gantry
#: or calibration tells, and above what arithmetic leaves of equal values
GRAIN_DIGITS = 5
#: angles between views are compared to so many digits, deg
ORDER_DIGITS = 2


@dataclasses.dataclass(frozen=True)
class OwnFrame:
    """The scene's own order of views and origin.

    Attributes
    ----------
    order : (V,) which view of the file stands first, second ...
    origin_mm : (3,) the scene's middle in the file's coordinates, mm LPS
    given : (V,) views as they were given, in the file's order
    """

    order: tuple[int, ...]
    origin_mm: Points
    given: tuple[CArm, ...]

    def place(self, view: int) -> int:
        """Return where the file's view stands in the scene's own order."""
        return self.order.index(view)

    def carm(self, carm: CArm) -> CArm:
        """Return a view in the scene's own coordinates, its numbers to ``GRAIN_DIGITS``.

        All are read off its matrix, so that it is the same whether it was given by angles and
        distances, by a matrix, or by both.
        """
        own = carm.moved(self.origin_mm)
        low, high, _ = HARD_RANGES["pixel_spacing_mm"]
        try:
            told = read_off(own.world2pixel).rounded(GRAIN_DIGITS)
            # Nothing but the size of things at the isocentre is told; pixels stay within range.
            least, most = low * max(told.focal_px), high * min(told.focal_px)
            sdd = min(max(SDD_OVER_SOD * told.sod_mm, least), most)
            return CArm.from_reading(told, sdd, rows=own.rows, columns=own.columns)
        except GeometryError:
            # The view is at the very end of a range.
            return own

    def grid(self, grid: Grid) -> Grid:
        """Return a grid in the scene's own coordinates."""
        x, y, z = (
            rounded(float(c), GRAIN_DIGITS) for c in np.asarray(grid.center_mm) - self.origin_mm
        )
        return dataclasses.replace(grid, center_mm=(x, y, z))


def own_frame(carms: Sequence[CArm], names: Sequence[str]) -> OwnFrame:
    """Find a scene's own order and origin.

    Parameters
    ----------
    carms : V views
    names : (V,) that tell views of equal angles apart, whatever their order (hashes of pictures)

    Returns
    -------
    OwnFrame
        Its origin is the point nearest to all central rays: the isocentre, where all meet in it.
    """
    order = _order(carms, names)
    origin = nearest_point(
        np.stack([carms[k].source_mm for k in order]), np.stack([carms[k].axes[2] for k in order])
    )
    return OwnFrame(tuple(order), origin, tuple(carms))


def _order(carms: Sequence[CArm], names: Sequence[str]) -> list[int]:
    """Put views in order round the patient, from behind the widest gap between them.

    Angles between views decide alone: one direction may be called 180 or -180 deg, and a turned
    scene keeps its order. Views of one primary angle go by their secondary angles.
    """
    primary = np.array([carm.primary_angle_deg for carm in carms])

    def beyond(start: int) -> list[float]:
        """Angles from one view on to each, 0 .. 360."""
        return (np.round((primary - primary[start]) % 360.0, ORDER_DIGITS) % 360.0).tolist()

    def keys(start: int) -> list[tuple[float, float, str]]:
        return [
            (angle, round(carm.secondary_angle_deg, ORDER_DIGITS), name)
            for angle, carm, name in zip(beyond(start), carms, names, strict=True)
        ]

    # The farther the last view is from the first, the narrower is what lies between them.
    start = min(range(len(carms)), key=lambda k: (max(beyond(k)), keys(k)[k][1:]))
    told = keys(start)
    return sorted(range(len(carms)), key=told.__getitem__)


def nearest_point(sources_mm: Points, directions: Points) -> Points:
    """Return the point nearest to (V, 3) rays of length 1, (3,) mm."""
    left, right = np.zeros((3, 3)), np.zeros(3)
    for source, ray in zip(sources_mm, directions, strict=True):
        across = np.eye(3) - np.outer(ray, ray)
        left += across
        right += across @ source
    return np.linalg.lstsq(left, right, rcond=1e-6)[0].astype(np.float64)

"""A scene in its own terms: where its middle is, in which order its views stand.

Where the origin of the file's coordinates lies, which view is named first, and what arithmetic
does to the last digits of an angle says nothing of the vessels. What is computed in the scene's
own terms cannot depend on it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.types import Points

#: geometry nearer than this is the same geometry: mm, pixels, degrees; far below what any gantry
#: or calibration tells, and above what arithmetic leaves of equal values
GRAIN_DIGITS = 5
#: views are put in order by their angles to so many digits, deg
ORDER_DIGITS = 2


@dataclasses.dataclass(frozen=True)
class OwnFrame:
    """The scene's own order of views and origin.

    Attributes
    ----------
    order : (V,) which view of the file stands first, second ...
    origin_mm : (3,) the scene's middle in the file's coordinates, mm LPS
    """

    order: tuple[int, ...]
    origin_mm: Points

    def place(self, view: int) -> int:
        """Return where the file's view stands in the scene's own order."""
        return self.order.index(view)

    def carm(self, carm: CArm) -> CArm:
        """Return a view in the scene's own coordinates, its numbers to ``GRAIN_DIGITS``."""
        own = carm.moved(self.origin_mm)
        if own.projection_matrix is not None:
            return own
        point = own.principal_point_px
        x, y, z = (_even(value) for value in own.isocenter_offset_mm)
        return dataclasses.replace(
            own,
            primary_angle_deg=_even(own.primary_angle_deg),
            secondary_angle_deg=_even(own.secondary_angle_deg),
            detector_rotation_deg=_even(own.detector_rotation_deg),
            principal_point_px=None if point is None else (_even(point[0]), _even(point[1])),
            isocenter_offset_mm=(x, y, z),
        )

    def grid(self, grid: Grid) -> Grid:
        """Return a grid in the scene's own coordinates."""
        x, y, z = (_even(float(c)) for c in np.asarray(grid.center_mm) - self.origin_mm)
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
    order = sorted(
        range(len(carms)),
        key=lambda k: (
            round(carms[k].primary_angle_deg, ORDER_DIGITS),
            round(carms[k].secondary_angle_deg, ORDER_DIGITS),
            names[k],
        ),
    )
    left, right = np.zeros((3, 3)), np.zeros(3)
    for k in order:
        ray = carms[k].axes[2]
        across = np.eye(3) - np.outer(ray, ray)
        left += across
        right += across @ carms[k].source_mm
    origin = np.linalg.lstsq(left, right, rcond=1e-6)[0].astype(np.float64)
    return OwnFrame(order=tuple(order), origin_mm=origin)


def _even(value: float) -> float:
    return round(value, GRAIN_DIGITS) + 0.0  # no negative zero

"""The volume where nobody names one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gcar_deploy.errors import GeometryError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.matrix import rounded
from gcar_deploy.geometry.own_frame import GRAIN_DIGITS, nearest_point
from gcar_deploy.types import Points

#: voxels along each edge
DEFAULT_SHAPE = 128
#: it never grows beyond this edge: the heart with its vessels fits, mm
DEFAULT_EDGE_MM = 180.0
#: pictures are cut beside the isocentre where they show less than this share of what they show
#: round their middles
BESIDE = 0.5


def default_grid(carms: Sequence[CArm]) -> Grid:
    """Cube of 128^3 voxels whose middle sphere every view sees whole.

    It lies round the isocentre (the point nearest to all central rays), or, where pictures are cut
    beside it, round the middle of what they show. It bounds the volume alone, not where vessels
    are looked for (``Grid.bounds``).

    Raises
    ------
    GeometryError
        A view sees neither.
    """
    sources = np.stack([carm.source_mm for carm in carms])
    central = np.stack([carm.axes[2] for carm in carms])
    middles = np.concatenate([carm.rays(_middle(carm)) for carm in carms])
    places = [nearest_point(sources, rays) for rays in (central, middles)]
    seen = [[_room_mm(carm, place) for carm in carms] for place in places]
    isocentre, middle = (min(radii) for radii in seen)
    best = int(isocentre < BESIDE * min(middle, DEFAULT_EDGE_MM / 2))
    radius = min(seen[best])
    if radius < 0.5:  # of a volume each edge is 1 mm or more
        nth = int(np.argmin(seen[best]))
        (c0, r0), carm = carms[nth].principal_point, carms[nth]
        raise GeometryError(
            f"view {nth + 1} sees no space that the others see: its principal point "
            f"({c0:g}, {r0:g}) is at the edge of or outside the picture of {carm.columns} x "
            f"{carm.rows} pixels; correct principal_point_px, or give a volume"
        )
    edge = min(2 * radius, DEFAULT_EDGE_MM)
    x, y, z = (rounded(float(value), GRAIN_DIGITS) for value in places[best])
    return Grid(center_mm=(x, y, z), size_mm=(edge,) * 3, shape=(DEFAULT_SHAPE,) * 3, bounds=False)


def _middle(carm: CArm) -> Points:
    return np.array([[0.5 * (carm.columns - 1), 0.5 * (carm.rows - 1)]])


def _room_mm(carm: CArm, place: Points) -> float:
    """Radius of the sphere round a place that the picture shows whole; below 0 outside."""
    right, bottom = carm.columns - 0.5, carm.rows - 0.5
    rays = carm.rays(np.array([(-0.5, -0.5), (right, -0.5), (right, bottom), (-0.5, bottom)]))
    normal = np.cross(rays, np.roll(rays, -1, axis=0))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    inwards = np.sign(normal @ rays.mean(axis=0))[:, None]
    return float((inwards * normal @ (place - carm.source_mm)).min())

"""3x4 projection matrices: what makes one, and what can be read off one.

The conventions are those of ``carm``: P = K [R | t], world mm LPS to pixels.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import numpy as np

from gcar_deploy.errors import GeometryError
from gcar_deploy.types import Array, Pixels, Points, Scalars

#: the picture's axes may be so far from a right angle (cosine): half a pixel over 500, and far more
#: than what matrices written to five digits have
_SKEW = 1e-3


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReadOff:
    """What a matrix says of its view.

    Attributes
    ----------
    primary_deg, secondary_deg, rotation_deg : angles of the gantry and of the detector
    sod_mm : depth of the world's origin
    focal_px : (columns, rows): SDD over the pixel spacing
    principal_point_px : (col, row)
    offset_mm : (3,) across the central ray: the patient moved by that much
    """

    primary_deg: float
    secondary_deg: float
    rotation_deg: float
    sod_mm: float
    focal_px: tuple[float, float]
    principal_point_px: tuple[float, float]
    offset_mm: tuple[float, float, float]

    def rounded(self, digits: int) -> ReadOff:
        """Return the same with every number to so many digits."""
        even = functools.partial(rounded, digits=digits)
        (f_col, f_row), (col, row) = self.focal_px, self.principal_point_px
        x, y, z = map(even, self.offset_mm)
        return ReadOff(
            primary_deg=even(self.primary_deg),
            secondary_deg=even(self.secondary_deg),
            rotation_deg=even(self.rotation_deg),
            sod_mm=even(self.sod_mm),
            focal_px=(even(f_col), even(f_row)),
            principal_point_px=(even(col), even(row)),
            offset_mm=(x, y, z),
        )


def rounded(value: float, digits: int) -> float:
    """Round, without a negative zero."""
    return round(value, digits) + 0.0


def checked(matrix: Any) -> Array:
    """Return a matrix scaled so that its third row measures depth, mm, positive at the isocentre.

    Raises
    ------
    GeometryError
        It is not 3 rows of 4 finite numbers, or no view has it.
    """
    try:
        P = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        P = np.empty(0)
    if P.shape != (3, 4) or not np.isfinite(P).all():
        raise GeometryError("projection_matrix must be 3 rows of 4 finite numbers")
    if abs(np.linalg.det(P[:, :3])) <= 1e-12 * np.prod(np.linalg.norm(P[:, :3], axis=1)):
        raise GeometryError("projection_matrix is singular: its left 3x3 block has no inverse")
    P = P / np.linalg.norm(P[2, :3])
    return P if P[2, 3] > 0 else -P


def read_off(P: Array) -> ReadOff:
    """Read a view off its matrix (``checked``) by an RQ decomposition.

    Raises
    ------
    GeometryError
        Its pixels are skewed, or it is a mirror image.
    """
    d = P[2, :3]
    c0, r0 = float(P[0, :3] @ d), float(P[1, :3] @ d)
    u_scaled, v_scaled = P[0, :3] - c0 * d, P[1, :3] - r0 * d
    f_col, f_row = float(np.linalg.norm(u_scaled)), float(np.linalg.norm(v_scaled))
    u, v = u_scaled / f_col, v_scaled / f_row
    if abs(u @ v) > _SKEW:
        raise GeometryError("projection_matrix has skewed pixels, which are not supported")
    if np.linalg.det(np.stack([u, v, d])) > 0:
        raise GeometryError(
            "projection_matrix is a mirror image: pictures must be shown from the detector "
            "towards the source (det R = -1)"
        )
    secondary = math.degrees(math.asin(float(np.clip(d[2], -1, 1))))
    primary = math.degrees(math.atan2(d[0], -d[1])) if abs(d[2]) < 1 - 1e-12 else 0.0
    u0, v0, _ = axes(primary, secondary, 0.0)
    # t = (u.o, v.o, SOD + d.o): only the depth is a distance, the rest is an offset.
    across = u * ((P[0, 3] - c0 * P[2, 3]) / f_col) + v * ((P[1, 3] - r0 * P[2, 3]) / f_row)
    x, y, z = across.tolist()
    return ReadOff(
        primary_deg=primary,
        secondary_deg=secondary,
        rotation_deg=math.degrees(math.atan2(-float(u @ v0), float(u @ u0))),
        sod_mm=float(P[2, 3]),
        focal_px=(f_col, f_row),
        principal_point_px=(c0, r0),
        offset_mm=(x, y, z),
    )


def axes(primary_deg: float, secondary_deg: float, rotation_deg: float) -> tuple[Array, ...]:
    """(3,) unit vectors u, v, d each: picture column, picture row, source to detector."""
    a, b, g = (math.radians(x) for x in (primary_deg, secondary_deg, rotation_deg))
    u = np.array([math.cos(a), math.sin(a), 0.0])
    v = np.array([math.sin(a) * math.sin(b), -math.cos(a) * math.sin(b), -math.cos(b)])
    d = np.array([math.sin(a) * math.cos(b), -math.cos(a) * math.cos(b), math.sin(b)])
    cg, sg = math.cos(g), math.sin(g)
    # Rows run downwards, so counter-clockwise in the picture is u -> u cos g - v sin g.
    return u * cg - v * sg, u * sg + v * cg, d


def applied(P: Array, points_mm: Points) -> tuple[Pixels, Scalars]:
    """(n, 2) pixels (col, row) and (n,) depths of (n, 3) points."""
    # Coordinates as rows: several times faster than three columns, and equal to the last bit.
    homogeneous = P[:, :3] @ points_mm.T + P[:, 3:]
    pixels = np.empty((len(points_mm), 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        np.divide(homogeneous[:2], homogeneous[2], out=pixels.T)
    return pixels, homogeneous[2]

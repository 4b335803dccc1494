"""CArm: the geometry of one X-ray view as an immutable value.

World: patient LPS, millimetres, origin at the isocentre. With a = primary angle (LAO
positive), b = secondary angle (cranial positive):

    u = ( cos a,        sin a,        0     )   image column direction (to the right)
    v = ( sin a sin b, -cos a sin b, -cos b )   image row direction (down)
    d = ( sin a cos b, -cos a cos b,  sin b )   from source to detector
    source S = -SOD d,  R = rows(u, v, d),  t = (0, 0, SOD)
    K = [[SDD/ps_col, 0, c0], [0, SDD/ps_row, r0], [0, 0, 1]],  P = K [R | t]

Pictures are shown from the detector towards the source, hence det R = -1. Everything but
the constructor works on P alone, so a view given by its 3x4 matrix is a full citizen.
"""

from __future__ import annotations

import dataclasses
import math
import numbers
from functools import cached_property
from typing import Any

import numpy as np

from gcar_deploy.errors import GeometryError
from gcar_deploy.geometry.matrix import ReadOff, applied, axes, checked, read_off
from gcar_deploy.types import Array, Mask, Pixels, Points, Scalars

#: key -> (lowest, highest, unit) of what is accepted at all.
HARD_RANGES: dict[str, tuple[float, float, str]] = {
    "primary_angle_deg": (-180.0, 180.0, "deg"),
    "secondary_angle_deg": (-90.0, 90.0, "deg"),
    "detector_rotation_deg": (-360.0, 360.0, "deg"),
    "sod_mm": (300.0, 5000.0, "mm"),
    "sdd_mm": (300.0, 8000.0, "mm"),
    "rows": (1, 16384, "px"),
    "columns": (1, 16384, "px"),
    "pixel_spacing_mm": (0.02, 10.0, "mm"),
}
#: outside these only a warning: simulated and micro set-ups exist.
CLINICAL_RANGES: dict[str, tuple[float, float, str]] = {
    "sod_mm": (600.0, 900.0, "mm"),
    "sdd_mm": (850.0, 1300.0, "mm"),
}
#: a 3x4 matrix given beside the angles must agree with them to this many pixels.
MATRIX_TOLERANCE_PX = 0.5
#: where the detector stands if only a matrix is given, which does not tell it
SDD_OVER_SOD = 1.5


def _in_range(key: str, value: Any, unit_suffix: str = "") -> float:
    """Return a number as Python's own, whoever's it was."""
    low, high, unit = HARD_RANGES[key]
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise GeometryError(f"{key}{unit_suffix} must be a number, got {value!r}")
    number = value if isinstance(value, (int, float)) else float(value)
    if not math.isfinite(number) or not low <= number <= high:
        raise GeometryError(
            f"{key}{unit_suffix} = {number:.12g} {unit} is outside {low:g} .. {high:g} {unit}"
        )
    return number


def _vector(key: str, value: Any, length: int) -> tuple[float, ...]:
    try:
        out = tuple(float(x) for x in value)
    except (TypeError, ValueError):
        raise GeometryError(f"{key} must be {length} numbers, got {value!r}") from None
    if len(out) != length or not all(math.isfinite(x) for x in out):
        raise GeometryError(f"{key} must be {length} finite numbers, got {value!r}")
    return out


@dataclasses.dataclass(frozen=True, kw_only=True)
class CArm:
    """One calibrated X-ray view.

    Attributes
    ----------
    primary_angle_deg : float
        LAO positive, RAO negative, as in DICOM XA (0018,1510); within +-180.
    secondary_angle_deg : float
        Cranial positive, caudal negative (0018,1511); within +-90.
    sod_mm, sdd_mm : float
        Source to isocentre and source to detector, mm.
    rows, columns : int
        Size of the picture, pixels.
    pixel_spacing_mm : (float, float)
        At the detector, order (row, column) as in DICOM ImagerPixelSpacing, mm.
    detector_rotation_deg : float
        Turns (u, v) in plane, counter-clockwise as seen in the picture.
    principal_point_px : (float, float) or None
        (col, row) of the foot of the central ray; None means ((cols-1)/2, (rows-1)/2).
    isocenter_offset_mm : (float, float, float)
        Added to each world point before projecting: the patient moved by that much.
    projection_matrix : 3x4 nested tuple or None
        LPS mm to pixels. Replaces the angles when it is given with ``from_matrix``;
        beside angles it must agree within 0.5 px, and be one that can be read off.

    Raises
    ------
    GeometryError
        A value is not finite, out of range, or SDD does not exceed SOD; the matrix has skewed
        pixels, or is at odds with the rest.
    """

    primary_angle_deg: float
    secondary_angle_deg: float
    sod_mm: float
    sdd_mm: float
    rows: int
    columns: int
    pixel_spacing_mm: tuple[float, float]
    detector_rotation_deg: float = 0.0
    principal_point_px: tuple[float, float] | None = None
    isocenter_offset_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    projection_matrix: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        for key in HARD_RANGES:
            if key != "pixel_spacing_mm":
                object.__setattr__(self, key, _in_range(key, getattr(self, key)))
        for key in ("rows", "columns"):
            if int(getattr(self, key)) != getattr(self, key):
                raise GeometryError(f"{key} = {getattr(self, key)!r} must be a whole number")
            object.__setattr__(self, key, int(getattr(self, key)))
        if self.sdd_mm <= self.sod_mm:
            raise GeometryError(
                f"sdd_mm = {self.sdd_mm:g} must exceed sod_mm = {self.sod_mm:g} "
                "(the detector lies behind the patient; are the two swapped?)"
            )
        object.__setattr__(
            self, "pixel_spacing_mm", _vector("pixel_spacing_mm", self.pixel_spacing_mm, 2)
        )
        for i, name in enumerate((" (row)", " (column)")):
            _in_range("pixel_spacing_mm", self.pixel_spacing_mm[i], name)
        object.__setattr__(
            self, "isocenter_offset_mm", _vector("isocenter_offset_mm", self.isocenter_offset_mm, 3)
        )
        if self.principal_point_px is not None:
            object.__setattr__(
                self,
                "principal_point_px",
                _vector("principal_point_px", self.principal_point_px, 2),
            )
        if self.projection_matrix is not None:
            self._check_matrix()

    def _check_matrix(self) -> None:
        P = checked(self.projection_matrix)
        object.__setattr__(self, "projection_matrix", tuple(map(tuple, P.tolist())))
        probe = 30.0 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        own, given = applied(self._matrix_from_angles(), probe)[0], applied(P, probe)[0]
        gap = float(np.abs(own - given).max())
        if gap > MATRIX_TOLERANCE_PX:
            raise GeometryError(
                f"projection_matrix disagrees with the angles and distances by {gap:.2f} px "
                f"(limit {MATRIX_TOLERANCE_PX} px within 30 mm of the isocentre)"
            )
        # What a run will ask of it is refused here, before any work.
        self.by_angles()

    @classmethod
    def from_matrix(cls, matrix: Any, *, rows: int, columns: int) -> CArm:
        """Build a view from a 3x4 matrix (LPS mm to pixels) alone.

        The angles, distances and in-plane rotation are read off the matrix by an RQ
        decomposition; the pixel spacing at the detector, which a matrix does not carry, is
        set so that SDD = ``SDD_OVER_SOD`` SOD. Skewed pixels are refused.
        """
        P = checked(matrix)
        told = read_off(P)
        view = cls.from_reading(told, SDD_OVER_SOD * told.sod_mm, rows=rows, columns=columns)
        return dataclasses.replace(view, projection_matrix=tuple(map(tuple, P.tolist())))

    @classmethod
    def from_reading(
        cls, told: ReadOff, sdd_mm: float, *, rows: int, columns: int, sod_mm: float | None = None
    ) -> CArm:
        """Build a view from what a matrix says of it, and from where its detector stands.

        ``sod_mm`` says where the isocentre is, which a matrix does not: the rest of the depth of
        the world's origin is an offset. Without it the isocentre is as deep as the origin.
        """
        offset = told.offset_mm
        if sod_mm is not None:
            beam = axes(told.primary_deg, told.secondary_deg, 0.0)[2]
            x, y, z = (offset + (told.sod_mm - sod_mm) * beam).tolist()
            offset = x, y, z
        return cls(
            primary_angle_deg=told.primary_deg,
            secondary_angle_deg=told.secondary_deg,
            detector_rotation_deg=told.rotation_deg,
            sod_mm=told.sod_mm if sod_mm is None else sod_mm,
            sdd_mm=sdd_mm,
            rows=rows,
            columns=columns,
            pixel_spacing_mm=(sdd_mm / told.focal_px[1], sdd_mm / told.focal_px[0]),
            principal_point_px=told.principal_point_px,
            isocenter_offset_mm=offset,
        )

    # -- matrices -------------------------------------------------------------------------

    def _matrix_from_angles(self) -> Array:
        u, v, d = axes(self.primary_angle_deg, self.secondary_angle_deg, self.detector_rotation_deg)
        R = np.stack([u, v, d])
        t = np.array([0.0, 0.0, self.sod_mm]) + R @ np.asarray(self.isocenter_offset_mm)
        c0, r0 = self.principal_point
        K = np.array(
            [
                [self.sdd_mm / self.pixel_spacing_mm[1], 0.0, c0],
                [0.0, self.sdd_mm / self.pixel_spacing_mm[0], r0],
                [0.0, 0.0, 1.0],
            ]
        )
        return K @ np.column_stack([R, t])

    @property
    def principal_point(self) -> tuple[float, float]:
        """(col, row) where the central ray meets the detector, pixels."""
        if self.principal_point_px is not None:
            return self.principal_point_px
        return (self.columns - 1) / 2.0, (self.rows - 1) / 2.0

    @cached_property
    def world2pixel(self) -> Array:
        """The 3x4 matrix P; its third row gives the depth from the source in mm."""
        if self.projection_matrix is not None:
            return np.asarray(self.projection_matrix, dtype=np.float64)
        return self._matrix_from_angles()

    @cached_property
    def axes(self) -> Array:
        """(3, 3), rows u, v, d: picture column, picture row, source-to-detector, unit vectors."""
        P = self.world2pixel[:, :3]
        d = P[2]
        u = P[0] - (P[0] @ d) * d
        v = P[1] - (P[1] @ d) * d
        return np.stack([u / np.linalg.norm(u), v / np.linalg.norm(v), d])

    @cached_property
    def source_mm(self) -> Array:
        """(3,) position of the X-ray source, mm LPS, in the frame of the scene."""
        P = self.world2pixel
        return -np.linalg.solve(P[:, :3], P[:, 3])

    @cached_property
    def focal_px(self) -> tuple[float, float]:
        """(columns, rows): SDD over the pixel spacing, pixels."""
        P = self.world2pixel[:, :3]
        d = P[2]
        f_col = float(np.linalg.norm(P[0] - (P[0] @ d) * d))
        return f_col, float(np.linalg.norm(P[1] - (P[1] @ d) * d))

    @property
    def magnification(self) -> float:
        """SDD / SOD, at the isocentre."""
        return self.sdd_mm / self.sod_mm

    @property
    def pixel_at_isocenter_mm(self) -> float:
        """Geometric mean of the pixel's two sides, scaled back to the isocentre, mm."""
        return math.sqrt(self.pixel_spacing_mm[0] * self.pixel_spacing_mm[1]) / self.magnification

    def shows(self, pixels: Pixels) -> Mask:
        """(n,) whether (n, 2) pixels (col, row) lie in the picture: their centres are whole."""
        low, high = np.array([-0.5, -0.5]), np.array([self.columns - 0.5, self.rows - 0.5])
        inside: Mask = np.all((pixels >= low) & (pixels < high), axis=1)
        return inside

    def px_per_mm(self, depth_mm: Scalars) -> Scalars:
        """Pixels to a mm across the ray at depths of any shape, geometric mean of both axes."""
        out: Scalars = math.sqrt(math.prod(self.focal_px)) / np.maximum(depth_mm, 1.0)
        return out

    # -- points and rays ------------------------------------------------------------------

    def project(self, points_mm: Points) -> tuple[Pixels, Scalars]:
        """Project (n, 3) points, mm LPS.

        Returns
        -------
        pixels : (n, 2) float64
            (col, row); pixel centres are integers.
        depth_mm : (n,) float64
            Distance from the source along the central ray; not positive behind the source,
            where the pixels mean nothing.
        """
        return applied(self.world2pixel, np.asarray(points_mm, dtype=np.float64))

    def jacobian(self, points_mm: Points) -> Array:
        """(n, 2, 3) derivative of (col, row) by the point, pixels per mm."""
        pixels, depth = self.project(points_mm)
        P = self.world2pixel[:, :3]
        return (P[None, :2] - pixels[:, :, None] * P[None, 2]) / depth[:, None, None]

    def rays(self, pixels: Pixels) -> Array:
        """(n, 3) unit vectors from the source through (n, 2) pixels (col, row)."""
        pixels = np.asarray(pixels, dtype=np.float64)
        homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
        # Depth along P's third row is +1 for each of these, so they point at the detector.
        directions = np.linalg.solve(self.world2pixel[:, :3], homogeneous.T).T
        unit: Array = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        return unit

    def backproject(self, pixels: Pixels, depth_mm: Scalars) -> Points:
        """(n, 3) points, mm LPS, at (n, 2) pixels and depths (n,) as ``project`` gives them."""
        pixels = np.asarray(pixels, dtype=np.float64)
        depth = np.asarray(depth_mm, dtype=np.float64)
        homogeneous = np.column_stack([pixels, np.ones(len(pixels))]) * depth[:, None]
        P = self.world2pixel
        points: Array = np.linalg.solve(P[:, :3], homogeneous.T - P[:, 3:]).T
        return points

    # -- neighbours of this value ---------------------------------------------------------

    def resized(self, rows: int, columns: int) -> CArm:
        """Return the view with its picture resampled to (rows, columns) over the same field."""
        scale_row, scale_col = rows / self.rows, columns / self.columns
        c0, r0 = self.principal_point
        matrix = None
        if self.projection_matrix is not None:
            S = np.array([[scale_col, 0, 0.5 * scale_col - 0.5],
                          [0, scale_row, 0.5 * scale_row - 0.5], [0, 0, 1]])  # fmt: skip
            matrix = tuple(map(tuple, (S @ np.asarray(self.projection_matrix)).tolist()))
        return dataclasses.replace(
            self,
            rows=rows,
            columns=columns,
            pixel_spacing_mm=(
                self.pixel_spacing_mm[0] / scale_row,
                self.pixel_spacing_mm[1] / scale_col,
            ),
            principal_point_px=((c0 + 0.5) * scale_col - 0.5, (r0 + 0.5) * scale_row - 0.5),
            projection_matrix=matrix,
        )

    def moved(self, offset_mm: Any) -> CArm:
        """Return the view of a patient who moved by ``offset_mm`` (3,), on top of what is set."""
        offset = np.asarray(offset_mm, dtype=np.float64)
        matrix = None
        if self.projection_matrix is not None:
            P = np.array(self.projection_matrix)
            P[:, 3] += P[:, :3] @ offset
            matrix = tuple(map(tuple, P.tolist()))
        total = np.asarray(self.isocenter_offset_mm) + offset
        return dataclasses.replace(
            self, isocenter_offset_mm=tuple(total.tolist()), projection_matrix=matrix
        )

    def by_angles(self) -> CArm:
        """Return the view without a matrix: where it has one, what that says but for its skew."""
        if self.projection_matrix is None:
            return self
        return CArm.from_reading(
            read_off(self.world2pixel), self.sdd_mm,
            rows=self.rows, columns=self.columns, sod_mm=self.sod_mm,
        )  # fmt: skip

    def turned(
        self,
        primary_deg: float = 0.0,
        secondary_deg: float = 0.0,
        offset_mm: Any = (0.0, 0.0, 0.0),
    ) -> CArm:
        """Return the same view with angles changed by so many degrees, without a matrix.

        It starts from ``by_angles``: angles told beside a matrix may be half a pixel off it.
        ``offset_mm`` (3,) moves the patient as well, as ``moved`` does.

        Beyond the poles and the back the same direction is named within the allowed ranges:
        (a, b, g) = (a + 180, 180 - b, g + 180).
        """
        told = self.by_angles()
        primary = told.primary_angle_deg + primary_deg
        secondary = told.secondary_angle_deg + secondary_deg
        rotation = told.detector_rotation_deg
        if abs(secondary) > 90.0:
            primary, secondary = primary + 180.0, math.copysign(180.0, secondary) - secondary
            rotation += 180.0 if rotation <= 0 else -180.0
        return dataclasses.replace(
            told,
            primary_angle_deg=primary if abs(primary) <= 180.0 else (primary + 180) % 360 - 180,
            secondary_angle_deg=secondary,
            detector_rotation_deg=rotation,
            isocenter_offset_mm=tuple(np.add(told.isocenter_offset_mm, offset_mm).tolist()),
        )

    def clinical_name(self) -> str:
        """Name the direction as it is said in the room, for instance ``'RAO 30 CAU 20'``."""
        a, b = self.primary_angle_deg, self.secondary_angle_deg
        first = "AP" if abs(a) < 0.5 else f"{'LAO' if a > 0 else 'RAO'} {abs(a):.0f}"
        second = "" if abs(b) < 0.5 else f" {'CRA' if b > 0 else 'CAU'} {abs(b):.0f}"
        return first + second


def separation_deg(first: CArm, second: CArm) -> float:
    """Angle between the central rays of two views, degrees, 0 .. 180."""
    cosine = float(np.clip(first.axes[2] @ second.axes[2], -1.0, 1.0))
    return math.degrees(math.acos(cosine))

"""One vessel with a lumen of any shape and a stenosis of known area, and its pictures.

Paths are not traced but poured: the lumen is filled with small pieces of known volume, which fall
into fine pixels. The area of every section is in the picture whatever its shape.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.tree.tree import along, polyline_arc, polyline_tangents
from gcar_export.scenes.protocols import MASK_PATH_MM, MM_PER_COUNT
from gcar_export.scenes.raw_pictures import RawOptions, raw_picture

#: edge of the pieces across and along the vessel, mm; pixels are poured so many times finer
PIECE_MM, ALONG_MM, FINER = 0.06, 0.1, 3
#: angles at which a section's outline is given
ANGLES = np.linspace(0, 2 * np.pi, 72, endpoint=False)
#: Gaussian with this full width at half maximum has a standard deviation of 1
FWHM = 2 * np.sqrt(2 * np.log(2))
#: field at the isocentre, mm
FIELD_MM = 110.0
#: clinical views of a single vessel: primary, secondary
VIEWS = ((-30.0, -20.0), (45.0, 25.0))


@dataclasses.dataclass(frozen=True, eq=False)
class LumenVessel:
    """A vessel.

    Attributes
    ----------
    points_mm : (m, 3) axis, ``ALONG_MM`` apart
    outline_mm : (m, k) distance of the wall from the axis at ``ANGLES``
    healthy_mm : (m,) reference diameter
    lesion_mm : arc of the lesion's begin and end; None without one
    """

    name: str
    points_mm: np.ndarray
    outline_mm: np.ndarray
    healthy_mm: np.ndarray
    lesion_mm: tuple[float, float] | None

    @property
    def arc_mm(self) -> np.ndarray:
        """(m,) distance from the first point, mm."""
        return polyline_arc(self.points_mm)

    @property
    def diameter_mm(self) -> np.ndarray:
        """(m,) diameter of the circle of the lumen's area."""
        return equal_diameter(self.outline_mm)


def equal_diameter(outline_mm: np.ndarray) -> np.ndarray:
    """(m,) diameter of the circle of a star-shaped outline's area, (m, k) at even angles."""
    after = np.roll(outline_mm, -1, axis=1)
    step = 2 * np.pi / outline_mm.shape[1]
    area = 0.5 * np.sin(step) * (outline_mm * after).sum(axis=1)
    return 2 * np.sqrt(area / np.pi)


def narrowed(arc_mm: np.ndarray, middle_mm: float, length_mm: float, percent: float) -> np.ndarray:
    """(m,) factor on a healthy diameter: a raised cosine."""
    off = np.clip(2 * np.abs(arc_mm - middle_mm) / length_mm, 0, 1)
    return 1 - percent / 100 * 0.5 * (1 + np.cos(np.pi * off))


def oval_outline(diameter_mm: np.ndarray, ratio: np.ndarray, turn: float) -> np.ndarray:
    """(m, k) ellipses of a given area and ratio of axes."""
    a, b = 0.5 * diameter_mm / np.sqrt(ratio), 0.5 * diameter_mm * np.sqrt(ratio)
    angle = ANGLES - turn
    out: np.ndarray = 1 / np.sqrt(
        (np.cos(angle) / a[:, None]) ** 2 + (np.sin(angle) / b[:, None]) ** 2
    )
    return out


def ivus_shapes(path: Path) -> np.ndarray:
    """(frames, k) outlines of a pullback round their centroids, mm.

    Parameters
    ----------
    path : ``frame x y z`` a line, tab-separated, mm
    """
    rows = np.loadtxt(path)
    out, first = [], None
    for frame in np.unique(rows[:, 0]):
        contour = rows[rows[:, 0] == frame, 1:]
        contour = contour - contour.mean(axis=0)
        normal = np.linalg.svd(contour, full_matrices=False)[2][2]
        if first is None:
            first = normal, np.linalg.svd(contour, full_matrices=False)[2][0]
        normal = normal * np.sign(normal @ first[0])
        u = first[1] - (first[1] @ normal) * normal
        u /= np.linalg.norm(u)
        flat = contour @ np.stack([u, np.cross(normal, u)], axis=1)
        # The centroid of the area, not of the points: pieces are poured round it.
        angle = np.arctan2(flat[:, 1], flat[:, 0])
        order = np.argsort(angle)
        radius = np.hypot(*flat[order].T)
        out.append(np.interp(ANGLES, np.unwrap(angle[order]) % (2 * np.pi), radius,
                             period=2 * np.pi))  # fmt: skip
    return np.array(out)


def smooth_line(points_mm: np.ndarray) -> np.ndarray:
    """(m, 3) the same course in even steps of ``ALONG_MM``, without the steps of voxels."""
    from scipy.interpolate import splev, splprep

    arc = polyline_arc(points_mm)
    keep = np.append(True, np.diff(arc) > 1e-6)
    spline, _ = splprep(points_mm[keep].T, u=arc[keep], s=keep.sum() * 0.3**2, k=3)
    fine = np.stack(splev(np.arange(0, arc[-1], 0.02), spline), axis=1)
    length = polyline_arc(fine)
    return along(fine, length, np.arange(0, length[-1], ALONG_MM))


def carms_for(vessel: LumenVessel, pixel_mm: float) -> list[CArm]:
    """Clinical views in which the vessel fits, with pixels of a given size at the isocentre."""
    extent = float(np.linalg.norm(vessel.points_mm, axis=1).max())
    size = int(np.ceil(max(2 * extent + 12, FIELD_MM) / pixel_mm / 16) * 16)
    return [
        CArm(primary_angle_deg=primary, secondary_angle_deg=secondary, sod_mm=765, sdd_mm=1100,
             rows=size, columns=size, pixel_spacing_mm=(pixel_mm * 1100 / 765,) * 2)
        for primary, secondary in VIEWS
    ]  # fmt: skip


def poured(vessel: LumenVessel, carm: CArm) -> np.ndarray:
    """(3 rows, 3 columns) path lengths on pixels ``FINER`` times finer, mm."""
    points, arc = vessel.points_mm, vessel.arc_mm
    tangents = polyline_tangents(points)
    normal = _transported(tangents)
    binormal = np.cross(tangents, normal)
    turn = np.gradient(tangents, arc, axis=0)
    bend = np.einsum("ij,ij->i", turn, normal), np.einsum("ij,ij->i", turn, binormal)
    reach = float(vessel.outline_mm.max())
    line = np.arange(-reach, reach + PIECE_MM, PIECE_MM)
    gx, gy = (g.ravel() for g in np.meshgrid(line, line))
    rho, angle = np.hypot(gx, gy), np.arctan2(gy, gx) % (2 * np.pi)
    place = angle / (2 * np.pi) * len(ANGLES)
    low, share = place.astype(int) % len(ANGLES), place % 1
    rows, columns = carm.rows * FINER, carm.columns * FINER
    image = np.zeros(rows * columns)
    rng = np.random.default_rng(0)
    for k in range(len(points)):
        ring = vessel.outline_mm[k]
        wall = (1 - share) * ring[low] + share * ring[(low + 1) % len(ANGLES)]
        inside = rho < wall
        x, y = gx[inside] + rng.uniform(-0.5, 0.5) * PIECE_MM, gy[inside]
        at = points[k] + x[:, None] * normal[k] + y[:, None] * binormal[k]
        at += rng.uniform(-0.5, 0.5) * ALONG_MM * tangents[k]
        volume = PIECE_MM**2 * ALONG_MM * (1 - x * bend[0][k] - y * bend[1][k])
        # The grid's own count is off by the cells that the wall cuts.
        area = np.pi / 4 * equal_diameter(ring[None])[0] ** 2
        volume *= area / max(inside.sum() * PIECE_MM**2, 1e-9)
        pixel, depth = carm.project(at)
        col, row = np.floor((pixel.T + 0.5) * FINER).astype(int)
        good = (col >= 0) & (row >= 0) & (col < columns) & (row < rows)
        scale = np.prod(carm.focal_px) * FINER**2 / depth**2
        np.add.at(image, (row * columns + col)[good], (volume * scale)[good])
    return image.reshape(rows, columns)


def _transported(tangents: np.ndarray) -> np.ndarray:
    """(m, 3) unit vectors across, turned as little as the line allows."""
    normal = np.empty_like(tangents)
    normal[0] = np.cross(tangents[0], np.eye(3)[np.argmin(np.abs(tangents[0]))])
    for k in range(1, len(tangents)):
        normal[k] = normal[k - 1] - (normal[k - 1] @ tangents[k]) * tangents[k]
        normal[k] /= np.linalg.norm(normal[k])
    normal[0] /= np.linalg.norm(normal[0])
    return normal


@dataclasses.dataclass(frozen=True)
class Taking:
    """How pictures are taken: pixel at the isocentre, blur (full width at half maximum), noise.

    ``noise_mm`` is that of path lengths, standard deviation of a pixel; ``kind`` is ``path``,
    ``raw`` or ``mask``.
    """

    kind: str
    pixel_mm: float
    blur_mm: float
    noise_mm: float


@dataclasses.dataclass(frozen=True, eq=False)
class LumenCase:
    """A vessel with a lesion, and how it is taken."""

    shape: str
    vessel: LumenVessel
    percent: float
    taking: Taking
    seed: int


def lumen_case(
    kind: str, shape: str, seed: int, lines: Sequence[np.ndarray], shapes: Sequence[np.ndarray]
) -> LumenCase:
    """Draw a vessel of 0.8 .. 4 mm with one stenosis of 30 .. 90 %.

    Parameters
    ----------
    kind : of the pictures, see ``Taking``
    shape : ``round``, ``oval`` (the more the narrower) or ``ivus``
    seed : of everything
    lines : (m, 3) centrelines to choose from, longer than 30 mm
    shapes : ``ivus_shapes``, to choose from
    """
    rng = np.random.default_rng(seed)
    line = smooth_line(lines[int(rng.integers(len(lines)))])
    first = int(rng.integers(max(1, len(line) - 700)))
    line = line[first : first + 700]
    line = line - 0.5 * (line.min(axis=0) + line.max(axis=0))
    arc = polyline_arc(line)
    healthy = rng.uniform(1.2, 4.0) * (1.1 - 0.2 * arc / arc[-1])
    percent, length = rng.uniform(30, 90), rng.uniform(8, 16)
    middle = rng.uniform(0.35, 0.65) * arc[-1]
    # A lumen that pictures still show: no less than 0.3 mm.
    percent = min(percent, 100 * (1 - 0.3 / float(np.interp(middle, arc, healthy))))
    share = narrowed(arc, middle, length, percent)
    diameter = healthy * share
    if shape == "ivus":
        chosen = shapes[int(rng.integers(len(shapes)))]
        outline = _swept(chosen, arc) * 0.5 * diameter[:, None]
    else:
        ratio = 1 - 0.45 * (1 - share) if shape == "oval" else np.ones(len(arc))
        outline = oval_outline(diameter, ratio, rng.uniform(0, np.pi))
    ends = (middle - length / 2, middle + length / 2)
    vessel = LumenVessel(f"{shape} {seed}", line, outline, healthy, ends)
    taking = Taking(kind, float(rng.choice([0.15, 0.2, 0.3, 0.4])), rng.uniform(0.3, 0.6),
                    rng.uniform(0, 0.1))  # fmt: skip
    return LumenCase(shape, vessel, percent, taking, seed)


def _swept(outlines_mm: np.ndarray, arc_mm: np.ndarray) -> np.ndarray:
    """(m, k) a pullback's outlines along a vessel, each of the area of a circle of radius 1."""
    unit = outlines_mm / (0.5 * equal_diameter(outlines_mm)[:, None])
    place = np.linspace(0, len(unit) - 1.001, len(arc_mm))
    low, share = place.astype(int), (place % 1)[:, None]
    between = (1 - share) * unit[low] + share * unit[low + 1]
    out: np.ndarray = between / (0.5 * equal_diameter(between)[:, None])
    return out


def taken(vessel: LumenVessel, taking: Taking, rng: np.random.Generator) -> list[Angiogram]:
    """Take both pictures of a vessel."""
    out = []
    for k, carm in enumerate(carms_for(vessel, taking.pixel_mm), start=1):
        fine, sigma = poured(vessel, carm), taking.blur_mm / FWHM / taking.pixel_mm
        if taking.kind == "path":
            fine = cv2.GaussianBlur(fine, (0, 0), sigma * FINER)
        path = fine.reshape(carm.rows, FINER, carm.columns, FINER).mean(axis=(1, 3))
        if taking.kind == "raw":
            blur_px = sigma * 512 / carm.columns
            pixels, depth = raw_picture(path, rng, RawOptions(blur_px=blur_px)), 8
            intensity = Intensity(kind="raw", polarity="dark", mm_per_count=None)
        elif taking.kind == "mask":
            pixels, depth = np.uint8(255) * (path >= MASK_PATH_MM), 8
            intensity = Intensity(kind="mask", polarity="bright", mm_per_count=None)
        else:
            noisy = path + taking.noise_mm * rng.normal(size=path.shape)
            pixels, depth = np.clip(np.rint(noisy / MM_PER_COUNT), 0, 65535), 16
            intensity = Intensity(kind="path_length", polarity="bright", mm_per_count=MM_PER_COUNT)
        out.append(
            Angiogram(view_id=str(k), carm=carm, pixels=pixels.astype(np.float32),
                      bit_depth=depth, intensity=intensity, sha256="")
        )  # fmt: skip
    return out

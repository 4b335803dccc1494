"""Whether a calibrated picture's path lengths and the widths of its shadows tell one scale.

Across a round vessel of radius r, tilted by an angle t against the ray, the path length is
``2 sqrt(r^2 - x^2) / sin t``: its integral over x is ``pi r^2 / sin t``, its variance ``r^2 / 4``.
The first hangs on millimetres per count, the second on millimetres per pixel alone, so their
ratio is the factor between the two. Neither the tree's radii nor a threshold takes part, only its
course. A blurred picture has wider shadows and the same integral, which looks like paths too short;
but blur adds the same variance to thin and to thick vessels, a wrong scale a share of it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from gcar_deploy.errors import RefusedError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.predict import bilinear
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Scalars

#: a profile is followed so many radii, and at least so many pixels, to each side
_REACH_RADII, _REACH_PX, _STEP_PX = 3.0, 5.0, 0.25
#: variance that the bilinear reading adds, and a pixel's square where the picture holds means over
#: it, square pixels; a picture of the paths at the pixels' middles is not blurred by the latter
_READING_PX2, _SQUARE_PX2 = 1 / 6, 1 / 12
_BLUR_PX2 = _READING_PX2 + _SQUARE_PX2
#: a profile narrower than so many times the blur tells the blur
_LEAST_VARIANCE = 2.0
#: sine of the tilt below which a vessel runs along the ray
_LEAST_SINE = 0.5
#: fewer profiles than this tell nothing
_LEAST_PROFILES = 25
#: Factors up to which nothing is said: real lumens may be wider than deep in a view. Where pixels
#: are as wide as vessels, neighbours merge, and more is let pass
_TOLERANCE, _TOLERANCE_COARSE, _COARSE_MM = 1.2, 1.6, 0.8
#: and below 1, where soft edges can look like it; set after a tree of soft voxels had been doubted
_SHORT = 0.6
#: Mean factors of all views, which cancel what lumens are wider than deep. Right pictures of
#: generated trees, sharp or blurred by up to half a pixel, are at 0.927 .. 1.003 (``gcar_export``,
#: ``studies.scale_lines``); above there is room for lumens that are not as round as theirs
_MEAN = (0.925, 1.07)
#: lower limit where a picture was enlarged: real trees' doubled by interpolation are at 0.91
_MEAN_ENLARGED = 0.85
#: from here on paths are too long for any vessel in a picture that is not coarse
_REFUSED = 1.5
#: Of the lines of a picture alone, on their median: right ones of real and generated trees are at
#: 0.8 .. 1.0. A vessel along the ray is deeper than wide, but no course in space makes half of a
#: tree's vessels three times as deep in all views; paths of one view alone add up to another sum
_GROSS = 3.0
#: thick vessels need so many times the section of thin ones to tell blur from scale
_LEAST_RANGE = 2.0
#: paths up to so many deviations of the noise are none: in their sum they would widen a shadow
NOISE_SIGMAS = 3.0


def check_gross_scale(angiograms: Sequence[Angiogram], views: Sequence[VesselImage]) -> None:
    """Refuse calibrated pictures whose scale is far off before a tree is fitted to it.

    Vessels many times as deep as wide take many times as long to fit, and are refused then.

    Parameters
    ----------
    angiograms : V pictures; where a person drew, widths are not the picture's
    views : what is vessel in each

    Raises
    ------
    RefusedError
        Paths are several times what the width of the shadows allows.
    """
    told = []
    for angiogram, view in zip(angiograms, views, strict=True):
        drawn = (angiogram.mask, angiogram.erased, angiogram.painted)
        if not view.calibrated or any(one is not None for one in drawn):
            continue
        line = view.skeleton & view.valid
        if np.count_nonzero(line) < _LEAST_PROFILES:
            continue
        half = cv2.distanceTransform(view.mask.astype(np.uint8), cv2.DIST_L2, 5)[line]
        width_mm = 2 * half * view.carm.pixel_at_isocenter_mm
        told.append((float(np.median(view.path_mm[line] / width_mm)), view.view_id))
    factor, which = min(told, default=(0.0, ""))
    if factor > _GROSS:
        raise RefusedError(_said(f"view {which}: path lengths are about", factor))


def _said(begins: str, factor: float, *, enlarged: bool = False) -> str:
    cause = "enlarging a picture widens shadows; or " if enlarged else ""
    return (
        f"{begins} {factor:.2f} times what the width of the vessels' shadows says; {cause}is "
        "mm_per_count or the pixel spacing off by that factor?"
    )


def check_scale(tree: Tree, views: Sequence[VesselImage]) -> list[str]:
    """Judge the scale of calibrated pictures by the shape of their vessels' shadows.

    Returns
    -------
    findings that make the result ``degraded``, each with the factor

    Raises
    ------
    RefusedError
        Paths are longer by half than the shadows' width allows, in a picture that shows it.
    """
    findings = []
    factors = [scale_factor(tree, view) if view.calibrated else None for view in views]
    for view, factor in zip(views, factors, strict=True):
        if factor is None:
            continue
        coarse = _coarse(view)
        most = _TOLERANCE_COARSE if coarse else _TOLERANCE
        if (coarse or factor >= _SHORT) and factor <= most:
            continue
        large = view.enlarged > 1 and factor < 1
        said = _said(f"view {view.view_id}: path lengths are", factor, enlarged=large)
        if factor > _REFUSED and not coarse:
            raise RefusedError(said)
        findings.append(said)
    mean = None if findings else mean_factor(views, factors)
    large = any(view.enlarged > 1 for view in views)
    least = _MEAN_ENLARGED if large else _MEAN[0]
    if mean is not None and not least <= mean <= _MEAN[1]:
        large = large and mean < 1
        findings.append(_said("path lengths of all views are", mean, enlarged=large))
    return findings


def mean_factor(views: Sequence[VesselImage], factors: Sequence[float | None]) -> float | None:
    """Geometric mean of the views' factors but those of coarse ones; None of fewer than two."""
    told = [
        f for view, f in zip(views, factors, strict=True) if f is not None and not _coarse(view)
    ]
    return float(np.exp(np.mean(np.log(told)))) if len(told) > 1 else None


def scale_factor(tree: Tree, view: VesselImage) -> float | None:
    """Return how many times too long the paths of a picture are for the width of its vessels.

    Parameters
    ----------
    tree : Tree, mm LPS; its course alone is used
    view : VesselImage with path lengths, mm

    Returns
    -------
    float, 1 where both agree; None where too few vessels stand alone in the picture, or where it
    looks below 1 and all are of one calibre: blur would look the same
    """
    long = tuple(branch for branch in tree.branches if len(branch) > 2)
    lines = _profiles(dataclasses.replace(tree, branches=long), view)
    if not lines:
        return None
    # One look at the picture for all profiles.
    sizes = np.cumsum([line.pixels.size // 2 for line in lines])
    paths = bilinear(view.path_mm, np.concatenate([line.pixels.reshape(-1, 2) for line in lines]))
    least = NOISE_SIGMAS * view.noise_mm
    found = [
        _sections(line, path, least)
        for line, path in zip(lines, np.split(paths, sizes[:-1]), strict=True)
    ]
    told, shown, square = np.concatenate(found, axis=1)
    if len(told) < _LEAST_PROFILES:
        return None
    plain = float(np.median(told / shown))
    # Nobody says which of both a pixel holds: paths are too long where they are so either way.
    longer = max(1.0, float(np.median(told / (shown + square))))
    return min(plain, longer) if plain >= 1 else _without_blur(told, shown, plain)


def _without_blur(told: Scalars, shown: Scalars, plain: float) -> float | None:
    """Factor from how variances grow from thin to thick vessels; None where all are alike."""
    thin, thick = (told <= np.quantile(told, 1 / 3)), (told >= np.quantile(told, 2 / 3))
    x, y = (np.array([np.median(v[thin]), np.median(v[thick])]) for v in (told, shown))
    if x[1] < _LEAST_RANGE * x[0] or not y[1] > y[0]:
        return None
    grown = float((x[1] - x[0]) / (y[1] - y[0]))
    # Blur adds variance; where none is left over, widths may be taken as they are.
    return plain if y[0] <= x[0] / grown else max(plain, min(grown, 1.0))


@dataclasses.dataclass(frozen=True, eq=False)
class _Profiles:
    """Where n profiles across a branch's shadow are read.

    Attributes
    ----------
    pixels : (n, m, 2) samples, (col, row)
    x_px : (m,) their distance from the axis
    size_mm, sine : (n,) pixel at the vessel's depth, and of the angle between vessel and ray
    """

    pixels: Array
    x_px: Scalars
    size_mm: Scalars
    sine: Scalars


def _profiles(tree: Tree, view: VesselImage) -> list[_Profiles]:
    """Profiles across those points of each branch that do not run along the ray."""
    points = tree.points()
    pixels, depth = view.carm.project(points)
    size_mm = _pixel_mm(view.carm) * depth / view.carm.sdd_mm
    branch = tree.branch_index()
    index = np.arange(len(points))
    # Between neighbours, of a branch's ends from the point itself.
    before = index - (np.diff(branch, prepend=-1) == 0)
    after = index + (np.diff(branch, append=-1) == 0)
    along = (pixels[after] - pixels[before]) / (after - before)[:, None]
    length = np.linalg.norm(along, axis=1)
    good = (depth > 1.0) & (length > 1e-6)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.maximum(length, 1e-6)[:, None]
    ray = points - view.carm.source_mm
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    tangents = np.concatenate([np.zeros((0, 3)), *(b.tangents for b in tree.branches)])
    sine = np.linalg.norm(np.cross(ray, tangents), axis=1)
    good &= sine > _LEAST_SINE
    if view.painted is not None:
        good &= bilinear(view.painted.astype(np.float32), pixels) == 0
    radius_px = tree.radii() / size_mm
    found = []
    for k in range(len(tree.branches)):
        own = branch == k
        reach = max(_REACH_PX, _REACH_RADII * float(np.max(radius_px[own])))
        x = np.arange(-reach, reach + _STEP_PX / 2, _STEP_PX)
        own &= good
        at = pixels[own, None] + x[None, :, None] * normal[own, None]
        found.append(_Profiles(at, x, size_mm[own], sine[own]))
    return found


def _sections(line: _Profiles, path_mm: Array, least_mm: float) -> Array:
    """(3, k) variance, mm^2, of each shadow that stands alone: by its integral, by its shape.

    And what a pixel's square may have added to the latter, which is taken off.
    """
    path = path_mm.reshape(line.pixels.shape[:2])
    area, variance, alone = _moments(np.where(path > least_mm, path, 0.0), line.x_px)
    good = alone & (variance > _LEAST_VARIANCE * _BLUR_PX2)
    told = area * line.sine * line.size_mm / (4 * np.pi)
    shown = (variance - _BLUR_PX2) * line.size_mm**2
    square = _SQUARE_PX2 * line.size_mm**2
    return np.stack([told[good], shown[good], square[good]])


def _moments(path: Array, x: Scalars) -> tuple[Scalars, Scalars, Array]:
    """Integral and variance of each profile's middle part, and whether it ends on both sides."""
    middle = len(x) // 2
    empty = path <= 0
    left = np.where(empty[:, :middle], np.arange(middle), -1).max(axis=1)
    right = np.where(empty[:, middle + 1 :], np.arange(middle + 1, len(x)), len(x)).min(axis=1)
    alone = (left >= 0) & (right < len(x)) & ~empty[:, middle]
    index = np.arange(len(x))
    inside = np.where((index > left[:, None]) & (index < right[:, None]), path, 0.0)
    total = np.maximum(inside.sum(axis=1), 1e-12)
    mean = inside @ x / total
    variance = (inside * (x - mean[:, None]) ** 2).sum(axis=1) / total
    return inside.sum(axis=1) * _STEP_PX, variance, alone


def _coarse(view: VesselImage) -> bool:
    """Whether pixels are as wide as vessels; enlarged, a picture shows no more than before."""
    return view.carm.pixel_at_isocenter_mm * max(view.enlarged, 1.0) > _COARSE_MM


def _pixel_mm(carm: CArm) -> float:
    return float(np.sqrt(np.prod(carm.pixel_spacing_mm)))

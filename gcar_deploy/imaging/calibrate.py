"""How many millimetres of vessel a raw picture's contrast stands for: an estimate."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from gcar_deploy.imaging import enhance
from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.segment import Segmentation
from gcar_deploy.types import Array, Image, Mask

#: wider vessels than this many pixels (radius) have a width worth believing
_MIN_RADIUS_PX = 1.5
#: fewer pixels than this make no statistics
_ENOUGH = 20


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PathEstimate:
    """Path length per pixel and how it was found.

    Attributes
    ----------
    path_mm : (rows, cols) float32, 0 outside the mask
    mm_per_unit : float, mm of vessel per unit of contrast
    spread : float
        Interquartile range of contrast over width, divided by its median.
    domain : str
        ``"log"``: Beer's law on the grey values; ``"linear"``: the picture is already
        logarithmic, as display processing leaves it.
    """

    path_mm: Image
    mm_per_unit: float
    spread: float
    domain: str


def estimate_path(
    candidates: dict[str, Image], found: Segmentation, pixel_mm: float
) -> PathEstimate:
    """Choose the grey-value law under which contrast and width agree best, and its scale.

    A vessel's cross-section is nearly round, so the longest chord through it equals the width
    of its shadow, 2 R: contrast / 2R is one constant along the tree in the right domain. Its
    median is the scale; forks, where shadows add up, are left out. Foreshortened and
    overlapping stretches lie above the constant and move the median little.

    Parameters
    ----------
    candidates : domain name -> (rows, cols) float32 picture, vessels bright
    found : Segmentation
    pixel_mm : float, pixel size at the isocentre
    """
    chosen, sections = _simple_stretches(found), _Sections.of(found, pixel_mm)
    best: PathEstimate | None = None
    for domain, picture in candidates.items():
        ground = enhance.background(enhance.fill_holes(picture, ~found.valid), found.mask, pixel_mm)
        contrast = np.where(found.valid, picture - ground, np.float32(0))
        scale, spread = sections.agreement(contrast, chosen, pixel_mm)
        if best is None or spread < best.spread:
            path = np.where(found.mask, np.clip(contrast, 0, None), np.float32(0)) * scale
            best = PathEstimate(
                path_mm=np.asarray(path, dtype=np.float32),
                mm_per_unit=scale,
                spread=spread,
                domain=domain,
            )
    if best is None:
        raise ValueError("no candidate picture was given")
    return best


def _simple_stretches(found: Segmentation) -> Mask:
    """(rows, cols) skeleton pixels away from forks, in vessels wide enough to have a profile."""
    padded = cv2.copyMakeBorder(found.mask.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    # to the centre of the first pixel outside, half a pixel too far
    radius = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1] - 0.5
    forks = found.skeleton & (skel.neighbours(found.skeleton) >= 3)
    reach = 2 * max(2, round(float(radius[found.skeleton].max(initial=1.0)))) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    simple = found.skeleton & (cv2.dilate(forks.astype(np.uint8), disc) == 0)
    wide = simple & (radius >= _MIN_RADIUS_PX)
    if wide.sum() >= _ENOUGH:
        return wide
    return simple if simple.sum() >= _ENOUGH else found.skeleton


@dataclasses.dataclass(frozen=True, eq=False)
class _Sections:
    """Sections across the lines of a picture, whatever its grey values.

    Attributes
    ----------
    skeleton, shadow : (rows, cols) bool, the lines, and how far their sections reach
    label : (rows, cols) number of the nearest pixel of a line
    smooth_px : averages along a line are Gaussian
    length, weight : (rows, cols) float32, averages of arc length and of pixels of line
    """

    skeleton: Mask
    shadow: Mask
    label: Array
    smooth_px: float
    length: Image
    weight: Image

    @staticmethod
    def of(found: Segmentation, pixel_mm: float) -> _Sections:
        margin_px = enhance.MARGIN_MM / pixel_mm
        reach = 2 * max(1, round(margin_px)) + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
        smooth = 2.0 * max(1.0, margin_px)
        return _Sections(
            skeleton=found.skeleton,
            shadow=cv2.dilate(found.mask.astype(np.uint8), disc) > 0,
            label=skel.to_line(found.skeleton)[1],
            smooth_px=smooth,
            length=enhance.wide_blur(skel.arc_length(found.skeleton), smooth),
            weight=enhance.wide_blur(found.skeleton.astype(np.float32), smooth),
        )

    def agreement(self, contrast: Image, chosen: Mask, pixel_mm: float) -> tuple[float, float]:
        """Return (mm per unit of contrast, relative spread) on ``chosen`` pixels of the lines.

        The width comes from the profile itself, not from where the mask was cut: a chord profile
        of peak p has the area A = (pi/2) R p, hence 2 R = 4 A / (pi p).
        """
        total = np.bincount(
            self.label[self.shadow], contrast[self.shadow], minlength=int(self.label.max()) + 1
        )
        section = np.where(self.skeleton, total[self.label], 0).astype(np.float32)
        area = self._along(section) / np.maximum(self.length, 1e-9)
        peak = self._along(cv2.GaussianBlur(contrast, (0, 0), 1.0)) / np.maximum(self.weight, 1e-9)
        a, p = area[chosen].astype(np.float64), peak[chosen].astype(np.float64)
        usable = (a > 0) & (p > 0)
        if not usable.any():
            return 0.0, np.inf
        width_mm = 4 * a[usable] / (np.pi * p[usable]) * pixel_mm
        ratio = width_mm / p[usable]
        low, middle, high = np.percentile(ratio, [25, 50, 75])
        return float(middle), float((high - low) / middle)

    def _along(self, values: Array) -> Array:
        """Sum of values on the lines, each by its distance."""
        on_line = np.where(self.skeleton, values, np.float32(0))
        return enhance.wide_blur(on_line.astype(np.float32, copy=False), self.smooth_px)

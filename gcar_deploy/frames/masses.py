"""Contrast in every frame of a run, without looking for vessels in any of them.

What all frames of a run hold alike is no contrast on its way through a beating heart. Each pixel is
compared with the brightest that it is over the run, and of what is darker then only what is
narrower than a vessel may be is kept: ribs, spine and most of a catheter go by the first step, the
heart's own shadow by the second. That is coarser than a segmentation, and many times cheaper.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.consistency import BIN_MM, HALF_BINS
from gcar_deploy.geometry.epipolar import plane_axes, reach_mm, slices_along
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging import enhance
from gcar_deploy.imaging.collimator import collimator
from gcar_deploy.imaging.extract import above_half
from gcar_deploy.imaging.polarity import is_dark_run
from gcar_deploy.types import Array, Image, Mask

#: longer side of the pictures that are compared, pixels
SIDE = 320
#: share of the frames in which a pixel is no vessel, at least
_BARE_SHARE = 0.1
#: no vessel is wider, mm
_WIDEST_MM = 10.0
#: contrast counts from so many deviations of a frame's noise, and from this share of the run's best
_NOISE, _LEAST_SHARE = 3.0, 0.25
#: of what is narrow in a frame so much is left at least where anything moves, and so much of it
#: stands elsewhere in the next frame
_LEAST_LEFT, _LEAST_MOTION = 0.35, 0.1
#: smoothing of the profiles, mm at the isocentre
_SIGMA_MM = 1.0


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RunMasses:
    """Contrast of all frames of one run.

    Attributes
    ----------
    carm : CArm of the reduced pictures
    masses : (n, rows, cols) float32, about proportional to the path through contrast, any scale
    filling : (n,) contrast of each frame, 1 where it is nearly the most
    motion : (n,) share of the contrast that stands elsewhere in the neighbouring frames, 0 .. 1
    beats : whether anything moved; of a phantom at rest hardly a vessel is left
    """

    carm: CArm
    masses: Array
    filling: Array
    motion: Array
    beats: bool


def run_masses(
    pictures: Sequence[Image], carm: CArm, intensity: Intensity, valid: Mask | None = None
) -> RunMasses:
    """Find the contrast of every frame.

    Parameters
    ----------
    pictures : n frames of one size, counts; better reduced by ``reduced`` as they are read
    carm : CArm of the whole run, of any size
    intensity : what a count means
    valid : (rows, cols) bool, where the run shows anything; None for everywhere
    """
    stack = np.stack([reduced(picture) for picture in pictures]).astype(np.float32)
    carm = carm.resized(*stack.shape[1:])
    shown = None if valid is None else reduced(valid) > 0.5
    masses, left = _contrast(stack, carm, intensity, shown)
    mass = masses.sum(axis=(1, 2), dtype=np.float64)
    most = max(float(np.percentile(mass, 90)), 1e-12)
    motion = _motion(masses)
    beats = mass.any() and left >= _LEAST_LEFT and float(motion.max()) >= _LEAST_MOTION
    return RunMasses(
        carm=carm, masses=masses, filling=mass / most, motion=motion, beats=bool(beats)
    )


def reduced(picture: Image | Mask) -> Image:
    """Return a picture with at most ``SIDE`` pixels along its longer side, float32."""
    rows, columns = picture.shape
    scale = min(1.0, SIDE / max(rows, columns))
    size = (max(8, round(columns * scale)), max(8, round(rows * scale)))
    small = cv2.resize(picture.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.asarray(small)


def plane_profiles(first: RunMasses, second: RunMasses) -> tuple[Array, Array]:
    """Share of each frame's contrast in every epipolar plane of the two runs, its square root.

    The square root keeps a few planes along a wide vessel from outweighing all others.

    Returns
    -------
    (n, 2 HALF_BINS + 1), (m, 2 HALF_BINS + 1), zero for frames without contrast
    """
    axes = plane_axes(first.carm, second.carm)
    reach = reach_mm(first.carm, second.carm)
    return _profiles(first, axes, reach), _profiles(second, axes, reach)


def _profiles(run: RunMasses, axes: Array, reach_mm: float) -> Array:
    rows, columns = run.masses.shape[1:]
    row, col = np.mgrid[0:rows, 0:columns]
    pixels = np.column_stack([col.ravel(), row.ravel()]).astype(np.float64)
    angle, weight = slices_along(axes, run.carm, pixels)
    at = angle * reach_mm / BIN_MM + HALF_BINS
    low = np.clip(np.floor(at).astype(np.int64), 0, 2 * HALF_BINS - 1)
    part = np.clip(at - low, 0.0, 1.0)
    n = 2 * HALF_BINS + 1
    out = np.zeros((len(run.masses), n))
    for profile, mass in zip(out, run.masses, strict=True):
        value = mass.ravel() * weight
        profile += np.bincount(low, value * (1 - part), n)
        profile += np.bincount(low + 1, value * part, n)
    out = gaussian_filter1d(out, _SIGMA_MM / BIN_MM, axis=1, mode="constant")
    share: Array = np.sqrt(out / np.maximum(out.sum(axis=1, keepdims=True), 1e-12))
    return share


def _contrast(
    stack: Array, carm: CArm, intensity: Intensity, valid: Mask | None
) -> tuple[Array, float]:
    """(n, rows, cols) contrast, and which share of what is narrow in the frames it is."""
    if intensity.kind == "mask":
        return np.stack([above_half(one) & (one > 0) for one in stack]).astype(np.float32), 1.0
    if intensity.kind == "path_length":
        return stack, 1.0
    bright, holes = _bright(stack, carm, intensity)
    if valid is not None:
        holes |= ~valid
    bright = np.stack([cv2.GaussianBlur(one, (0, 0), 0.8) for one in bright])
    whole = bright[len(bright) // 2].copy()
    bare = int(_BARE_SHARE * (len(bright) - 1))
    bright -= np.partition(bright, bare, axis=0)[bare]
    across = 2 * round(0.5 * _WIDEST_MM / carm.pixel_at_isocenter_mm) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (across, across))
    # Edges of the collimator move with nothing, but its rim is as narrow as a vessel.
    seen = cv2.dilate(holes.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    if not seen.any():
        return np.zeros_like(bright), 0.0
    narrow = np.stack([cv2.morphologyEx(one, cv2.MORPH_TOPHAT, disc) for one in bright])
    middle = np.median(narrow[:, seen], axis=1)
    noise = 1.48 * np.median(np.abs(narrow[:, seen] - middle[:, None]), axis=1)
    best = float(np.percentile(np.percentile(narrow[:, seen], 99, axis=1), 90))
    least = np.maximum(middle + _NOISE * noise, _LEAST_SHARE * best)
    out = np.where(seen, np.maximum(narrow - least[:, None, None], 0), 0).astype(np.float32)
    whole = cv2.morphologyEx(whole, cv2.MORPH_TOPHAT, disc)
    return out, best / max(float(np.percentile(whole[seen], 99)), 1e-12)


def _bright(stack: Array, carm: CArm, intensity: Intensity) -> tuple[Array, Mask]:
    """Frames with bright vessels in which paths about add up, and where nothing is shown."""
    dark = is_dark_run(stack, carm.pixel_at_isocenter_mm, intensity)
    if intensity.kind == "attenuation":
        return -stack if dark else stack.copy(), np.zeros(stack.shape[1:], bool)
    holes = collimator(np.median(stack, axis=0).astype(np.float32), negative=not dark)
    # One white level for the whole run: what its display does to one frame it does to all.
    level = np.asarray(stack if dark else stack.max() - stack, dtype=np.float32)
    return enhance.absorbance(level), holes


def _motion(masses: Array) -> Array:
    if len(masses) < 2:
        return np.zeros(len(masses))
    flat = masses.reshape(len(masses), -1)
    total = np.maximum(flat.sum(axis=1, keepdims=True), 1e-12)
    share = flat / total
    change = 0.5 * np.abs(np.diff(share, axis=0)).sum(axis=1)
    before, after = np.append(change[0], change), np.append(change, change[-1])
    motion: Array = 0.5 * (before + after)
    return motion

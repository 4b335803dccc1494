"""Do two pictures show the same tree? The vessel mass of every epipolar plane must agree.

Weighted as ``plane_slices`` says, the agreement is exact for path lengths, cone beam and all: what
differs is the geometry, the pixels, or the tree.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.ndimage import gaussian_filter1d

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import plane_angles, plane_axes, reach_mm, slices_along
from gcar_deploy.types import Array, Image, Pixels, Scalars

#: bins of a profile: width at the isocentre, and how many to each side of it
BIN_MM = 0.25
HALF_BINS = 600


@dataclasses.dataclass(frozen=True, eq=False)
class Mass:
    """Vessel pixels of one view.

    Attributes
    ----------
    carm : CArm
    pixels : (n, 2) (col, row)
    path : (n,) path length, mm where ``calibrated``, else in any scale
    calibrated : bool
    mask : bool, the path is told by a mask's width alone: of two vessels that overlap one counts
    grain : (n,) the path with the sign of every second pixel turned, as of a chessboard; where the
        pixels were averaged since, so is this. None where nobody asks
    """

    carm: CArm
    pixels: Pixels
    path: Scalars
    calibrated: bool = False
    mask: bool = False
    grain: Scalars | None = None


def chequered(path_mm: Image) -> Image:
    """Turn the sign of every second pixel, as of a chessboard."""
    row, column = np.indices(path_mm.shape)
    return np.where((row + column) % 2 == 0, path_mm, -path_mm)


def vessel_mass(
    carm: CArm, path_mm: Image, calibrated: bool = False, mask: bool = False,
    grain: Image | None = None,
) -> Mass | None:  # fmt: skip
    """Collect the pixels with vessel; None where there is none.

    Parameters
    ----------
    carm : CArm of the picture's size
    path_mm : (rows, cols) path length, zero outside vessels; any scale unless ``calibrated``
    calibrated, mask : see ``Mass``
    grain : (rows, cols), see ``Mass``
    """
    rows, cols = np.nonzero(path_mm > 0)
    if len(rows) == 0:
        return None
    pixels = np.column_stack([cols, rows]).astype(np.float64)
    fine = None if grain is None else grain[rows, cols].astype(np.float64)
    return Mass(carm, pixels, path_mm[rows, cols].astype(np.float64), calibrated, mask, fine)


def mass_profiles(fixed: Mass, moving: Mass, carm: CArm, sigma_mm: float) -> tuple[Array, Array]:
    """Mass per epipolar plane in both views, smoothed.

    Parameters
    ----------
    fixed, moving : Mass of the two views
    carm : CArm to use for ``moving`` in place of its own (a corrected pose)
    sigma_mm : smoothing, mm at the isocentre

    Returns
    -------
    two (2 HALF_BINS + 1,) arrays, each summing to 1; on average where both are calibrated
    """
    (first, second), sums = _summed(fixed, moving, carm, sigma_mm)
    if fixed.calibrated and moving.calibrated:
        sums = [0.5 * (sums[0] + sums[1])] * 2
    return first / sums[0], second / sums[1]


def _summed(fixed: Mass, moving: Mass, carm: CArm, sigma_mm: float) -> tuple[Array, list[float]]:
    """(2, bins) mass per epipolar plane of both views, smoothed, and how much it is in all."""
    reach = reach_mm(fixed.carm, carm)
    axes = plane_axes(fixed.carm, carm)
    out, sums = [], []
    for mass, view in ((fixed, fixed.carm), (moving, carm)):
        angle, weight = slices_along(axes, view, mass.pixels)
        at = angle * reach / BIN_MM + HALF_BINS
        # Not np.clip, which takes as long as all the rest for a picture of 128 pixels.
        low = np.minimum(np.maximum(np.floor(at).astype(np.int64), 0), 2 * HALF_BINS - 1)
        part = np.minimum(np.maximum(at - low, 0.0), 1.0)
        n = 2 * HALF_BINS + 1
        value = mass.path * weight
        profile = np.bincount(low, value * (1 - part), n)
        profile += np.bincount(low + 1, value * part, n)
        out.append(profile)
        sums.append(float(value.sum()))
    return gaussian_filter1d(np.stack(out), sigma_mm / BIN_MM, mode="constant"), sums


def sampling_noise(fixed: Mass, moving: Mass, carm: CArm, sigma_mm: float) -> float:
    """``mismatch`` that comes of the pixels alone; 0 without ``grain`` of both views.

    Every second pixel, as of a chessboard, shows the same tree: what profiles of the two halves
    differ by, halved, is what those of all pixels are off. Of pictures whose pixels hold the path
    at their middle the mismatch of right geometry is 0.4 to 2.4 times this.

    Parameters
    ----------
    fixed, moving, carm, sigma_mm : as of ``mass_profiles``
    """
    if fixed.grain is None or moving.grain is None:
        return 0.0
    whole, _ = _summed(fixed, moving, carm, sigma_mm)
    first = dataclasses.replace(fixed, path=fixed.grain)
    grain, _ = _summed(first, dataclasses.replace(moving, path=moving.grain), carm, sigma_mm)
    return float(np.sqrt(((grain**2).sum(axis=1) / (whole**2).sum(axis=1)).sum()))


def uncovered_mm(fixed: Mass, moving: Mass, carm: CArm) -> float:
    """Length across the epipolar planes that one view shows vessel on and the other does not, mm.

    Of outlines that touch the same planes it is zero, however vessels overlap within them
    (silhouette coherence, Hernandez et al., IEEE PAMI 29 (2007) 343).

    Parameters
    ----------
    fixed, moving, carm : as of ``mass_profiles``
    """
    base = carm.source_mm - fixed.carm.source_mm
    lever = np.linalg.norm(np.cross(fixed.carm.source_mm, carm.source_mm)) / np.linalg.norm(base)
    axes = plane_axes(fixed.carm, carm)
    covered = []
    for mass, view in ((fixed, fixed.carm), (moving, carm)):
        at = slices_along(axes, view, mass.pixels)[0] * lever / BIN_MM + HALF_BINS
        # A pixel covers all bins up to half its diagonal from its middle.
        half = np.sqrt(0.5) * view.pixel_at_isocenter_mm / BIN_MM
        low, high = (
            np.clip(np.rint(at + part).astype(np.int64), 0, 2 * HALF_BINS + 1)
            for part in (-half, half)
        )
        n = 2 * HALF_BINS + 2
        open_pixels = np.cumsum(np.bincount(low, minlength=n) - np.bincount(high, minlength=n))
        covered.append(open_pixels > 0)
    return BIN_MM * float(np.logical_xor(*covered).sum())


def match_rate(first: CArm, second: CArm, a: Pixels, b: Pixels, near_mm: float) -> float | None:
    """Share of the first view's vessel pixels with a possible partner in the second.

    A partner is a vessel pixel whose epipolar plane passes within ``near_mm`` at the isocentre.

    Parameters
    ----------
    first, second : CArm
    a, b : (n, 2) and (m, 2) (col, row) of skeleton pixels
    near_mm : float

    Returns
    -------
    0 .. 1, or None where a view has no pixels
    """
    if len(a) == 0 or len(b) == 0:
        return None
    reach = reach_mm(first, second)
    own = plane_angles(first, second, first, a) * reach
    other = np.sort(plane_angles(first, second, second, b) * reach)
    after = np.searchsorted(other, own).clip(0, len(other) - 1)
    before = (after - 1).clip(0)
    gap = np.minimum(np.abs(other[after] - own), np.abs(other[before] - own))
    return float((gap <= near_mm).mean())


def disagreement(fixed: Mass, moving: Mass, carm: CArm, sigma_mm: float) -> float:
    """Half the summed difference of both profiles: 0 (equal) .. 1 (nothing in common)."""
    a, b = mass_profiles(fixed, moving, carm, sigma_mm)
    return float(0.5 * np.abs(a - b).sum())


def mismatch(fixed: Mass, moving: Mass, carm: CArm, sigma_mm: float) -> float:
    """Root mean square difference of both profiles, as a share of the first's."""
    a, b = mass_profiles(fixed, moving, carm, sigma_mm)
    return float(np.sqrt(((a - b) @ (a - b)) / (a @ a)))

"""Filtered backprojection for cone beams (Feldkamp, Davis, Kress 1984) with itk-rtk."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.types import Array, Image, Volume
from gcar_export.methods import rtk_geometry


@dataclasses.dataclass(frozen=True, kw_only=True)
class FdkOptions:
    """Settings of ``fdk``.

    Attributes
    ----------
    hann_cut : float
        Cut-off of the Hann window as a share of the Nyquist frequency; 0 is the plain ramp.
    """

    hann_cut: float = 0.0


def fdk(
    path_mm: Sequence[Image],
    carms: Sequence[CArm],
    grid: Grid,
    options: FdkOptions | None = None,
) -> Volume:
    """Reconstruct occupancy from path-length pictures.

    Every view gets the weight pi / n: evenly spaced views over a half circle, which is FDK's
    case for a distant source. Views off the plane of rotation are outside its theory and are
    used as they are. The result is clipped to 0 .. 1.

    Parameters
    ----------
    path_mm : pictures (rows, columns), mm of vessel along each pixel's ray
    carms : their views
    grid : voxels wanted
    options : FdkOptions

    Returns
    -------
    (nx, ny, nz) float32, 0 .. 1
    """
    options = options or FdkOptions()
    weights = _undo_gap_weights(carms)
    weighted = [w * picture for w, picture in zip(weights, path_mm, strict=True)]
    method = rtk_geometry.rtk().FDKConeBeamReconstructionFilter[rtk_geometry.image_type()].New()
    method.GetRampFilter().SetHannCutFrequency(options.hann_cut)
    # Coronary trees lie inside every picture: no truncation correction.
    method.GetRampFilter().SetTruncationCorrection(0.0)
    return rtk_geometry.reconstructed(method, weighted, carms, grid)


def _undo_gap_weights(carms: Sequence[CArm]) -> Array:
    """(n,) factors that turn RTK's weights into pi / n for every view.

    RTK multiplies each view by half the mean angular gap to its two neighbours round the
    full circle, which is right for full scans only.
    """
    sources = np.array([carm.source_mm for carm in carms])
    angles = np.arctan2(sources[:, 1], sources[:, 0]) % (2 * np.pi)
    order = np.argsort(angles)
    ahead = np.diff(angles[order], append=angles[order[0]] + 2 * np.pi)
    gaps = np.empty(len(carms))
    gaps[order] = 0.5 * (ahead + np.roll(ahead, 1))
    return (2 * np.pi / len(carms)) / gaps

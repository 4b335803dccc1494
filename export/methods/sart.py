"""Simultaneous algebraic reconstruction (Andersen, Kak 1984), non-negative, with itk-rtk."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.types import Image, Volume
from gcar_export.methods import rtk_geometry


@dataclasses.dataclass(frozen=True, kw_only=True)
class SartOptions:
    """Settings of ``sart``.

    Attributes
    ----------
    iterations : int
        Passes over all views.
    relaxation : float
        Share of each correction that is applied, 0 .. 2.
    """

    iterations: int = 20
    relaxation: float = 0.5


def sart(
    path_mm: Sequence[Image],
    carms: Sequence[CArm],
    grid: Grid,
    options: SartOptions | None = None,
) -> Volume:
    """Reconstruct occupancy from path-length pictures, never below 0 in between.

    One view per sub-iteration; the result is clipped to 0 .. 1.

    Parameters
    ----------
    path_mm : pictures (rows, columns), mm of vessel along each pixel's ray
    carms : their views
    grid : voxels wanted
    options : SartOptions

    Returns
    -------
    (nx, ny, nz) float32, 0 .. 1
    """
    options = options or SartOptions()
    kind = rtk_geometry.image_type()
    method = rtk_geometry.rtk().SARTConeBeamReconstructionFilter[kind, kind].New()
    method.SetNumberOfIterations(options.iterations)
    method.SetLambda(options.relaxation)
    method.SetEnforcePositivity(True)
    return rtk_geometry.reconstructed(method, path_mm, carms, grid)

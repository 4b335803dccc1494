"""CArm and Grid in the terms of RTK (itk-rtk): geometry objects, image stacks, volumes.

RTK turns its gantry round its y axis, so its world is (x, z, -y) of LPS: a rotation, not a
mirror image. Each view is given by its source, its detector corner and its two detector
axes; u x v = -d in both conventions, so pictures pass as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gcar_deploy.errors import UsageError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.types import Image, Points, Volume

#: LPS to RTK world, a proper rotation.
_LPS2RTK = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
#: size and spacing of all views must agree to this share, as RTK stacks them in one image.
_TOLERANCE = 1e-6


def rtk() -> Any:
    """Import and return ``itk.RTK`` (some seconds the first time)."""
    from itk import RTK

    return RTK


def lps2rtk(points_mm: Points) -> Points:
    """Turn (n, 3) points, mm LPS, into RTK's world."""
    return np.asarray(points_mm, dtype=np.float64) @ _LPS2RTK.T


def geometry(carms: Sequence[CArm]) -> Any:
    """RTK circular projection geometry of the views, one projection each.

    The detector of every view is put at the (virtual) distance where its pixels have the
    first view's spacing, so that views of different SDD and spacing fit one stack.

    Raises
    ------
    UsageError
        If the views differ in rows, columns or pixel aspect ratio.
    """
    _same_detector(carms)
    import itk

    out = rtk().ThreeDCircularProjectionGeometry.New()
    spacing = _spacing(carms)
    for carm in carms:
        u, v, _ = carm.axes
        # Depth at which a pixel is as large as the stack's: f_col * spacing = distance.
        depth = carm.focal_px[0] * spacing[0]
        corner = carm.backproject(np.zeros((1, 2)), np.array([depth]))[0]
        source, corner, u, v = (lps2rtk(x) for x in (carm.source_mm, corner, u, v))
        added = out.AddProjection(
            itk.Point[itk.D, 3](source.tolist()),
            itk.Point[itk.D, 3](corner.tolist()),
            itk.Vector[itk.D, 3](u.tolist()),
            itk.Vector[itk.D, 3](v.tolist()),
        )
        if added is False:
            raise UsageError(f"RTK does not accept the view {carm.clinical_name()}")
    return out


def stack(pictures: Sequence[Image] | None, carms: Sequence[CArm]) -> Any:
    """ITK image (columns, rows, views) of path lengths in mm; zeros if ``pictures`` is None."""
    import itk

    _same_detector(carms)
    shape = (len(carms), carms[0].rows, carms[0].columns)
    array = np.zeros(shape, np.float32) if pictures is None else np.asarray(pictures, np.float32)
    if array.shape != shape:
        raise UsageError(f"pictures are {array.shape}, the views say {shape}")
    image = itk.image_from_array(np.ascontiguousarray(array))
    # Index (0, 0) lies at the corner given to AddProjection, coordinate (0, 0).
    image.SetSpacing([*_spacing(carms), 1.0])
    image.SetOrigin([0.0, 0.0, 0.0])
    return image


def volume_image(volume: Volume | None, grid: Grid) -> Any:
    """ITK image of a volume (nx, ny, nz) in RTK's world; zeros if ``volume`` is None."""
    import itk

    array = np.zeros(grid.shape, np.float32) if volume is None else np.asarray(volume, np.float32)
    # RTK x = LPS x, RTK y = LPS z, RTK z = -LPS y; ITK arrays are indexed (z, y, x).
    turned = np.transpose(array[:, ::-1, :], (1, 2, 0))
    image = itk.image_from_array(np.ascontiguousarray(turned))
    spacing = grid.spacing_mm[[0, 2, 1]]
    first = np.array([0, grid.shape[1] - 1, 0])
    image.SetSpacing(spacing.tolist())
    image.SetOrigin(lps2rtk(grid.index2world(first)).tolist())
    return image


def volume_array(image: Any) -> Volume:
    """Inverse of ``volume_image``: (nx, ny, nz) float32 on the grid it was made for."""
    import itk

    turned = itk.array_from_image(image)
    return np.ascontiguousarray(np.transpose(turned, (2, 0, 1))[:, ::-1, :], dtype=np.float32)


def image_type() -> Any:
    """Type of the stacks and volumes here, which RTK's filters are made for."""
    import itk

    return itk.Image[itk.F, 3]


def reconstructed(
    method: Any, path_mm: Sequence[Image], carms: Sequence[CArm], grid: Grid
) -> Volume:
    """Run a reconstruction filter on pictures, from an empty volume; occupancy 0 .. 1."""
    method.SetInput(0, volume_image(None, grid))
    method.SetInput(1, stack(path_mm, carms))
    method.SetGeometry(geometry(carms))
    method.Update()
    out: Volume = np.clip(volume_array(method.GetOutput()), 0, 1)
    return out


def forward(volume: Volume, grid: Grid, carms: Sequence[CArm]) -> list[Image]:
    """Joseph forward projection: line integrals of (nx, ny, nz), one picture per view, mm."""
    import itk

    empty, filled = stack(None, carms), volume_image(volume, grid)
    projector = rtk().JosephForwardProjectionImageFilter[type(empty), type(filled)].New()
    projector.SetInput(0, empty)
    projector.SetInput(1, filled)
    projector.SetGeometry(geometry(carms))
    projector.Update()
    return list(itk.array_from_image(projector.GetOutput()))


def _spacing(carms: Sequence[CArm]) -> tuple[float, float]:
    """(columns, rows) spacing of the stack: the first view's detector."""
    return carms[0].pixel_spacing_mm[1], carms[0].pixel_spacing_mm[0]


def _same_detector(carms: Sequence[CArm]) -> None:
    first = carms[0]
    for carm in carms:
        if (carm.rows, carm.columns) != (first.rows, first.columns):
            raise UsageError("RTK needs all pictures of one size")
        aspect = carm.pixel_spacing_mm[0] / carm.pixel_spacing_mm[1]
        expected = first.pixel_spacing_mm[0] / first.pixel_spacing_mm[1]
        if abs(aspect / expected - 1) > _TOLERANCE:
            raise UsageError("RTK needs all pictures of one pixel aspect ratio")

"""A vessel image at another picture size."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import sparse

from gcar_deploy.errors import UsageError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.types import Array, Image


def resized(vessel_image: VesselImage, rows: int, columns: int) -> VesselImage:
    """Resample to (rows, columns) over the same field.

    Path lengths are averaged over the area of the new pixel, so their sum times the pixel
    area stays. A new pixel is vessel where at least half of it is, or where a line of the old
    skeleton would break without it.

    Raises
    ------
    UsageError
        ``rows`` or ``columns`` below 1.
    """
    if rows < 1 or columns < 1:
        raise UsageError(f"cannot resize a view to {columns} x {rows} pixels")
    old = vessel_image
    if (rows, columns) == old.mask.shape:
        return old
    path = area_average(old.path_mm, rows, columns)
    line = area_average(old.skeleton.astype(np.float32), rows, columns) > 0
    mask = (area_average(old.mask.astype(np.float32), rows, columns) >= 0.5) | line
    mask &= path > 0
    valid = area_average(old.valid.astype(np.float32), rows, columns) >= 0.5
    response, catheter = old.vesselness, old.catheter
    if catheter is not None:
        catheter = (area_average(catheter.astype(np.float32), rows, columns) >= 0.5) & ~mask
    return dataclasses.replace(
        old,
        alone=None,
        carm=old.carm.resized(rows, columns),
        path_mm=path,
        mask=mask,
        skeleton=skel.skeletonize(mask),
        valid=valid,
        vesselness=None if response is None else area_average(response, rows, columns),
        catheter=catheter,
    )


def area_average(picture: Image, rows: int, columns: int) -> Image:
    """(rows, columns) mean of ``picture`` over each new pixel's area, any factor."""
    down = _overlap(picture.shape[0], rows)
    across = _overlap(picture.shape[1], columns)
    return np.ascontiguousarray((across @ (down @ picture).T).T, dtype=np.float32)


def _overlap(old: int, new: int) -> Array:
    """Return the (new, old) sparse share of new cell i that old cell j covers; rows sum to 1."""
    edges = np.union1d(np.arange(old + 1) * new, np.arange(new + 1) * old)  # in 1 / (old new)
    middle = 0.5 * (edges[:-1] + edges[1:])
    length = np.diff(edges) / old
    return sparse.csr_matrix(
        (length, ((middle // old).astype(int), (middle // new).astype(int))), shape=(new, old)
    )


def sampled(view: VesselImage, pixel_mm: float) -> VesselImage:
    """Return the view with pixels of about ``pixel_mm`` at the isocentre, never finer."""
    scale = view.carm.pixel_at_isocenter_mm / pixel_mm
    if scale >= 1:
        return view
    rows, columns = (max(round(n * scale), 1) for n in view.mask.shape)
    return resized(view, rows, columns)


def sampled_path(view: VesselImage, pixel_mm: float) -> tuple[CArm, Image]:
    """Like ``sampled``, but only the C-arm and the path lengths: no mask, no skeleton."""
    scale = view.carm.pixel_at_isocenter_mm / pixel_mm
    if scale >= 1:
        return view.carm, view.path_mm
    rows, columns = (max(round(n * scale), 1) for n in view.mask.shape)
    return view.carm.resized(rows, columns), area_average(view.path_mm, rows, columns)

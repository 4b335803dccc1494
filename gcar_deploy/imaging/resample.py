"""Pictures, vessel images and their C-arms at other pixel sizes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import cv2
import numpy as np
from scipy import sparse

from gcar_deploy.errors import UsageError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.types import Array, Image, Mask

#: edges of pixels this near to each other, in pixels, are one: less is rounding (``GRAIN_DIGITS``),
#: and a sliver of vessel would make a pixel vessel
ONE_EDGE = 1e-4


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
    if (rows, columns) == vessel_image.mask.shape:
        return vessel_image
    carm = vessel_image.carm.resized(rows, columns)
    return averaged(vessel_image, carm, lambda picture: area_average(picture, rows, columns))


def coarser_view(view: VesselImage, factor: int) -> VesselImage:
    """``resized`` to pixels ``factor`` times as large, which meet at the principal point."""
    carm, _ = coarsened(view.carm, (), factor)
    return averaged(view, carm, lambda picture: coarsened(view.carm, (picture,), factor)[1][0])


def averaged(old: VesselImage, carm: CArm, average: Callable[[Image], Image]) -> VesselImage:
    """Return the view of larger pixels that hold the ``average`` of the old ones."""

    def share(of: Mask) -> Image:
        return average(of.astype(np.float32))

    path = average(old.path_mm)
    mask = (share(old.mask) >= 0.5) | (share(old.skeleton) > 0)
    mask &= path > 0
    response, catheter, device = old.vesselness, old.catheter, old.device
    painted = old.painted
    return dataclasses.replace(
        old,
        others=(),
        kept=None,
        carm=carm,
        path_mm=path,
        mask=mask,
        skeleton=skel.skeletonize(mask),
        valid=share(old.valid) >= 0.5,
        vesselness=None if response is None else average(response),
        catheter=None if catheter is None else (share(catheter) >= 0.5) & ~mask,
        painted=None if painted is None else share(painted) > 0,
        device=None if device is None else average(device),
    )


def resize(picture: Image, size: tuple[int, ...]) -> Image:
    """Resample to (columns, rows): area average when shrinking, linear when growing."""
    rows, columns = picture.shape
    if size == (columns, rows):
        return picture
    shrink = size[0] < columns or size[1] < rows
    interpolation = cv2.INTER_AREA if shrink else cv2.INTER_LINEAR
    size = (size[0], size[1])
    return np.asarray(cv2.resize(picture, size, interpolation=interpolation), dtype=np.float32)


def blocks(picture: Array, down: int, across: int) -> Iterator[Array]:
    """Cut a picture into about equal blocks, so many down and across, row by row."""
    for band in np.array_split(picture, down):
        yield from np.array_split(band, across, axis=1)


def area_average(picture: Image, rows: int, columns: int) -> Image:
    """(rows, columns) mean of ``picture`` over each new pixel's area, any factor."""
    return weighted(picture, _overlap(picture.shape[0], rows), _overlap(picture.shape[1], columns))


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
    """C-arm and path lengths with pixels of ``pixel_mm`` at the isocentre, never finer."""
    carm, (path,) = coarsened(
        view.carm, (view.path_mm,), pixel_mm / view.carm.pixel_at_isocenter_mm
    )
    return carm, path


def coarsened(
    carm: CArm, pictures: Sequence[Image], factor: float
) -> tuple[CArm, tuple[Image, ...]]:
    """Average pictures over pixels ``factor`` times as large, which meet at the principal point.

    So the pixels belong to the scene, not to the corner of the picture: a border more or less
    changes nothing. Pixels that reach beyond the picture hold the mean of what is inside.

    Parameters
    ----------
    carm : CArm of the pictures
    pictures : (rows, cols) each
    factor : 1 or less returns them as they are

    Returns
    -------
    carm : CArm of the new pictures
    pictures : (new rows, new cols) float32 each
    """
    if factor <= 1 + 1e-6:
        return carm, tuple(pictures)
    new, down, across = stretched(carm, (1 / factor, 1 / factor))
    return new, tuple(weighted(picture, down, across) for picture in pictures)


def stretched(carm: CArm, scales: tuple[float, float]) -> tuple[CArm, Array, Array]:
    """Lay other pixels over a view, ``scales`` times as many, which meet at the principal point.

    Parameters
    ----------
    carm : CArm
    scales : down, across; 1 leaves the pixels that way as they are

    Returns
    -------
    carm : CArm of the new pixels; they may reach beyond the old ones' field by less than one
    down, across : (new rows, rows), (new cols, cols) sparse, for ``weighted``: means over the area
        of larger pixels, linear between the old pixels for smaller ones
    """
    column, row = carm.principal_point
    (down, new_row), (across, new_column) = (
        _shares(old, anchor, scale)
        for old, anchor, scale in zip((carm.rows, carm.columns), (row, column), scales, strict=True)
    )
    shape = down.shape[0], across.shape[0]
    return _on_pixels(carm, shape, scales, (new_column, new_row)), down, across


def weighted(picture: Image, down: Array, across: Array) -> Image:
    """Sum a picture's pixels with sparse weights each way, (new rows, new cols) float32."""
    return np.ascontiguousarray((across @ (down @ picture).T).T, dtype=np.float32)


def _on_pixels(
    carm: CArm, shape: tuple[int, int], scales: tuple[float, float], point: tuple[float, float]
) -> CArm:
    """View with ``scales`` (down, across) times as many pixels, principal point (col, row)."""
    matrix = None
    down, across = scales
    if carm.projection_matrix is not None:
        old = carm.principal_point
        S = np.array(
            [[across, 0, point[0] - old[0] * across], [0, down, point[1] - old[1] * down],
             [0, 0, 1]]
        )  # fmt: skip
        matrix = tuple(map(tuple, (S @ np.asarray(carm.projection_matrix)).tolist()))
    row_mm, column_mm = carm.pixel_spacing_mm
    return dataclasses.replace(
        carm,
        rows=shape[0],
        columns=shape[1],
        pixel_spacing_mm=(row_mm / down, column_mm / across),
        principal_point_px=point,
        projection_matrix=matrix,
    )


def _shares(old: int, anchor: float, scale: float) -> tuple[Array, float]:
    """Weights of old pixels in new ones whose edges lie at ``anchor`` and whole pixels from it.

    Returns
    -------
    weights : (new, old) sparse, rows sum to 1
    anchor : where the anchor is on the new pixels
    """
    if scale == 1:
        return sparse.identity(old, format="csr"), anchor
    first = int(np.floor((-0.5 - anchor) * scale + 1e-9))
    last = int(np.ceil((old - 0.5 - anchor) * scale - 1e-9))
    if scale < 1:
        return area_shares(anchor + np.arange(first, last + 1) / scale, old), -first - 0.5
    at = np.clip(_snapped(anchor + (np.arange(first, last) + 0.5) / scale, 0.0), 0, old - 1)
    before = np.floor(at).astype(np.int64)
    after = np.minimum(before + 1, old - 1)
    new = np.arange(len(at))
    weight = np.concatenate([1 - (at - before), at - before])
    places = np.concatenate([new, new]), np.concatenate([before, after])
    return sparse.csr_matrix((weight, places), shape=(len(at), old)), -first - 0.5


def _snapped(places: Array, off: float) -> Array:
    """Put places within ``ONE_EDGE`` of a whole number and ``off`` there."""
    whole = np.rint(places - off) + off
    return np.where(np.abs(places - whole) < ONE_EDGE, whole, places)


def area_shares(edges: Array, old: int) -> Array:
    """Share of each new pixel, between ``edges`` (new + 1,), that old ones fill, (new, old) sparse.

    Rows sum to 1: what lies beyond the old pixels does not count.
    """
    edges = np.clip(_snapped(edges, 0.5), -0.5, old - 0.5)
    cuts = np.union1d(edges, np.arange(old + 1) - 0.5)
    middle = 0.5 * (cuts[:-1] + cuts[1:])
    new = np.clip(np.searchsorted(edges, middle) - 1, 0, len(edges) - 2)
    share = np.diff(cuts) / np.maximum(np.diff(edges), 1e-12)[new]
    at = np.rint(middle).astype(np.int64).clip(0, old - 1)
    return sparse.csr_matrix((share, (new, at)), shape=(len(edges) - 1, old))

"""The single-view predictor's picture and its map of centres: what goes in, what comes out.

Training and deployment share this file, so they cannot drift apart. The network of the paper
(3DGR-CAR, section 2.2) sees one picture of n x n pixels and answers (n/alpha) x (n/alpha) x 4:
depth d and an offset (dx, dy, dz) per cell. A cell is lifted along its true cone-beam ray:

    t = |S| + (d - 1/2) DEPTH_PIXELS p                       distance from the source S, mm
    X = S + t r + p (dx u + dy v + dz w)                      mm LPS

with p the edge of a picture's pixel at the isocentre, r the unit ray through the cell's centre
and (u, v, w) the view's axes. In these units nothing depends on the size of the patient.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging.resample import area_average
from gcar_deploy.types import Array, Image, Points, Scalars

#: depth 0 .. 1 covers so many pixel edges along a ray, the isocentre in the middle
DEPTH_PIXELS = 160.0
#: largest offset along each axis of the view, pixel edges
OFFSET_PIXELS = 3.0
#: outputs per cell: depth and three offsets
OUTPUTS = 4
#: a cell stands for vessel where a pixel of it shows more path than this, pixel edges
MIN_PATH_PIXELS = 0.5
#: path lengths beyond this are cut, and divided by it, pixel edges
MAX_PATH_PIXELS = 8.0


@dataclasses.dataclass(frozen=True, eq=False)
class NetPicture:
    """One view as the network sees it.

    Attributes
    ----------
    carm : CArm of the n x n picture
    path_mm : (n, n) float32, path length in mm
    """

    carm: CArm
    path_mm: Image

    @property
    def pixel_mm(self) -> float:
        """Edge of a pixel at the isocentre, mm."""
        return self.carm.pixel_at_isocenter_mm

    def network_input(self) -> Array:
        """(1, 1, n, n) float32, 0 .. 1."""
        path = np.clip(self.path_mm / self.pixel_mm, 0.0, MAX_PATH_PIXELS) / MAX_PATH_PIXELS
        return np.ascontiguousarray(path[None, None], dtype=np.float32)

    def axes_input(self) -> Array:
        """(1, 3, 3) float32, the axes u, v, d of the view, for networks that are told the pose."""
        return np.ascontiguousarray(self.carm.axes[None], dtype=np.float32)

    def cells(self, alpha: int) -> Array:
        """(n/alpha, n/alpha) bool: which cells stand for vessel."""
        inside: Array = blocks(self.path_mm, alpha).max(axis=2) > MIN_PATH_PIXELS * self.pixel_mm
        return inside

    def rays(self, alpha: int) -> Array:
        """(n/alpha, n/alpha, 3) unit vectors from the source through the cells' centres."""
        m = len(self.path_mm) // alpha
        row, col = np.mgrid[:m, :m]
        middle = (np.column_stack([col.ravel(), row.ravel()]) + 0.5) * alpha - 0.5
        return self.carm.rays(middle).reshape(m, m, 3)


@dataclasses.dataclass(frozen=True, eq=False)
class ViewCenters:
    """Centres that one view predicts.

    Attributes
    ----------
    points_mm : (n, 3) mm LPS, offsets included
    ray_mm : (n,) distance from the source along the true ray, mm, offsets not included
    cell : (n, 2) int64, (row, col) of each centre's cell
    alpha : int, pixels of the network's picture per cell edge
    picture : NetPicture that they were predicted from
    """

    points_mm: Points
    ray_mm: Scalars
    cell: Array
    alpha: int
    picture: NetPicture


def net_picture(carm: CArm, path_mm: Image, pixels: int) -> NetPicture:
    """Bring a view to ``pixels`` x ``pixels`` square pixels over its whole field.

    The longer side fills the picture; a shorter one leaves empty columns on the right or rows
    below. Path lengths are averaged over each new pixel.
    """
    height, width = (
        n * side for n, side in zip((carm.rows, carm.columns), carm.pixel_spacing_mm, strict=True)
    )
    edge = max(height, width) / pixels
    rows, cols = (min(max(round(s / edge), 1), pixels) for s in (height, width))
    small = carm.resized(rows, cols)
    path = np.zeros((pixels, pixels), np.float32)
    path[:rows, :cols] = area_average(path_mm, rows, cols)
    return NetPicture(dataclasses.replace(small, rows=pixels, columns=pixels), path)


def encode_depth(ray_mm: Array, picture: NetPicture) -> Array:
    """Depth 0 .. 1 of distances from the source along true rays, mm; any shape."""
    middle = float(np.linalg.norm(picture.carm.source_mm))
    out: Array = 0.5 + (np.asarray(ray_mm) - middle) / (DEPTH_PIXELS * picture.pixel_mm)
    return out


def decode(output: Array, picture: NetPicture, alpha: int) -> ViewCenters:
    """Lift the network's answer along the true rays.

    Parameters
    ----------
    output : (4, n/alpha, n/alpha): depth 0 .. 1, offsets (dx, dy, dz) in pixel edges along the
        view's axes (column, row, source to detector)
    picture : NetPicture that was the input
    alpha : int

    Returns
    -------
    ViewCenters, one per cell that stands for vessel, row by row
    """
    inside = picture.cells(alpha)
    depth, offset = output[0][inside].astype(np.float64), output[1:, inside].T.astype(np.float64)
    source = picture.carm.source_mm
    ray_mm = np.linalg.norm(source) + (depth - 0.5) * DEPTH_PIXELS * picture.pixel_mm
    on_ray = source + ray_mm[:, None] * picture.rays(alpha)[inside]
    return ViewCenters(
        points_mm=on_ray + picture.pixel_mm * offset @ picture.carm.axes,
        ray_mm=ray_mm,
        cell=np.argwhere(inside),
        alpha=alpha,
        picture=picture,
    )


def blocks(picture: Array, alpha: int) -> Array:
    """(n, n) to (n/alpha, n/alpha, alpha^2): the pixels of each cell."""
    m = len(picture) // alpha
    tiles = picture.reshape(m, alpha, m, alpha).transpose(0, 2, 1, 3)
    return tiles.reshape(m, m, alpha * alpha)

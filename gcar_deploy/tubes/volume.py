"""From the fitted tubes to voxels, corrected by what pictures and starting points still say.

Sections of real vessels are not round. Near the tubes' surface the occupancy x of each voxel is
a Gaussian variable about the tubes' x0, correlated over about a voxel along the vessel:

    x = x0 + G z,  z ~ N(0, 1),
    pictures: A x = path + noise,   starting points: K x = density + noise

(A the voxel projector, K the blur of points that scatter). The most probable z solves
(1 + G^T O^T R^-1 O G) z = G^T O^T R^-1 e, by conjugate gradients on some thousands of voxels.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.linalg import LinearOperator, cg
from scipy.spatial import cKDTree

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.geometry.carm import HARD_RANGES, separation_deg
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.tree.centerline import usable_points
from gcar_deploy.tree.occupancy import tree_occupancy
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.model import footprint, tubes_of
from gcar_deploy.tubes.settle import scatter_is_none
from gcar_deploy.tubes.splat import cell_view, shrink_factor, shrunk
from gcar_deploy.types import Array, Points, Scalars, Volume

#: standard deviation of a voxel half inside a tube, and of one far from its surface
SURFACE_SIGMA, FLOOR_SIGMA = 0.3, 0.03
#: how far such differences reach along a vessel and across it, voxels (sigma)
ALONG_VOXELS, ACROSS_VOXELS = 1.0, 0.6
#: noise of the path length per pixel of about a voxel: constant part, share of the path
NOISE_MM, NOISE_SHARE = 0.3, 0.1
#: least noise of a lattice point's confidence; of scattered points: variance per occupancy
CONFIDENCE_SIGMA, SCATTER_VARIANCE = 0.08, 0.25
#: points scattered more than this say nothing about single voxels, voxels (sigma)
MAX_SCATTER_VOXELS = 0.8
#: more voxels than this near a surface are left to the round tubes
MOST_VOXELS = 60_000
#: voxels are free where the slightly blurred tubes reach this occupancy.
BAND = 0.02
BAND_BLUR = 0.6
#: neighbours within this many voxels are correlated, and take part in the points' blur.
REACH = 2
#: the projector needs voxels about as wide as they are deep.
MAX_ANISOTROPY = 1.01
#: pixels about as large as the voxels are no picture where no C-arm could have them, mm
MAX_PIXEL_MM = HARD_RANGES["pixel_spacing_mm"][1]
#: points stand for voxels where their spacing is the voxel's to this factor.
SAME_SPACING = 1.2
#: error at their surface of round tubes fitted to two views, which the points' own noise comes on
#: top of, and the share of its variance that no number of views removes; the rest falls with
#: their number (generated trees: 0.15, 0.09, 0.08 at 2, 8, 16 views).
TUBE_ERROR = 0.18
LASTING_SHARE = 0.2
#: what a predictor gets wrong beyond that it gets wrong for whole stretches, not voxel by voxel:
#: its excess variance counts so many times with two views, and less the more views tell such
#: stretches apart.
BIAS_WEIGHT = 12.0
#: views that differ by less make the same errors of voxels: how far a vessel fills its voxels
#: looks alike from both. Measured on generated trees: with views 11 deg apart the pictures' pull
#: errs 2 to 3 times as much as independent errors would, at 45 deg and more as much, deg (sigma)
SAME_DIRECTION_DEG = 12.0
CG_STEPS = 40
CG_TOLERANCE = 2e-2


@dataclasses.dataclass(frozen=True, eq=False)
class _Band:
    """Free voxels: (n, 3) index, (n, 3) mm, prior mean and sigma, and their neighbours.

    ``offsets`` (o, 3) are those within ``REACH``, ``free`` (n, o) says whether the voxel there is
    one of the n, ``column`` which one, row by row.
    """

    index: Array
    points_mm: Points
    mean: Scalars
    sigma: Scalars
    offsets: Array
    free: Array
    column: Array

    def matrix(self, weight: Array) -> sparse.csr_matrix:
        """(n, n) of (n, o) weights of each voxel's neighbours."""
        n = len(self.index)
        pointer = np.concatenate([[0], np.cumsum(np.count_nonzero(self.free, axis=1))])
        return sparse.csr_matrix((weight[self.free], self.column, pointer), shape=(n, n))


def tube_volume(
    tree: Tree,
    grid: Grid,
    views: Sequence[VesselImage],
    contrast: Sequence[float],
    centers: CenterPoints | None,
    edge_blur_mm: float,
    model_mm: Sequence[Array] = (),
) -> Volume:
    """Occupancy of each voxel, 0 .. 1.

    Parameters
    ----------
    tree : fitted Tree
    grid : Grid wanted
    views : the pictures the tree was fitted to
    contrast : per view, factor of the picture's path on the model's
    centers : the points the fit started from, or None
    edge_blur_mm : as in the fit
    model_mm : per view (rows, cols) path of the tubes where the fit has it already, or empty

    Returns
    -------
    (nx, ny, nz) float32
    """
    volume = tree_occupancy(tree, grid)
    spacing = grid.spacing_mm
    if not tree.branches or spacing.max() / spacing.min() > MAX_ANISOTROPY:
        return volume
    h = float(spacing.mean())
    if any(shrink_factor(v.carm, h) * max(v.carm.pixel_spacing_mm) > MAX_PIXEL_MM for v in views):
        return volume
    near = _box_round(volume)
    if near is None:
        return volume
    inner = volume[near]
    blurred = ndimage.gaussian_filter(inner, BAND_BLUR, truncate=3.0)
    if np.count_nonzero(blurred > BAND) > MOST_VOXELS:
        return volume
    band = _band(inner, blurred, grid, np.array([part.start for part in near]))
    if not len(band.index):
        return volume
    G = _correlation(band, tree)
    operators, errors, variances = _pictures(
        band, tree, grid, views, contrast, edge_blur_mm, model_mm
    )
    centers = None if centers is None else usable_points(centers)
    if centers is not None and len(centers):
        told = _points(band, tree, grid, centers, len(views))
        if told is not None:
            operators.append(told[0])
            errors.append(told[1])
            variances.append(told[2])
    if not operators:
        return volume
    change = _solve(
        G, sparse.vstack(operators).tocsr(), np.concatenate(errors), np.concatenate(variances)
    )
    volume[tuple(band.index.T)] = np.clip(band.mean + change, 0.0, 1.0)
    return volume


def _box_round(volume: Volume) -> tuple[slice, ...] | None:
    """Box of the voxels above 0 with as much room as the blur needs; None where there are none."""
    some = volume > 0
    room = int(3.0 * BAND_BLUR + 0.5)
    out = []
    for axis in range(3):
        at = np.flatnonzero(some.any(axis=tuple(k for k in range(3) if k != axis)))
        if not len(at):
            return None
        out.append(slice(max(int(at[0]) - room, 0), int(at[-1]) + room + 1))
    return tuple(out)


def _band(volume: Volume, blurred: Array, grid: Grid, corner: Array) -> _Band:
    """Voxels near the surface in a box of the grid whose first voxel is ``corner``."""
    near = blurred > BAND
    index = np.argwhere(near)
    room = np.asarray(near.shape) + 2 * REACH
    stride = np.array([room[1] * room[2], room[2], 1])
    lookup = np.full(int(room.prod()), -1, np.int32)
    flat = (index + REACH) @ stride
    lookup[flat] = np.arange(len(index))
    span = np.arange(-REACH, REACH + 1)
    offsets = np.stack(np.meshgrid(span, span, span, indexing="ij"), -1).reshape(-1, 3)
    offsets = offsets[np.linalg.norm(offsets, axis=1) <= REACH]
    found = lookup[flat[:, None] + offsets @ stride]
    free = found >= 0
    half = np.clip(blurred[near].astype(np.float64), 0.0, 1.0)
    sigma2 = FLOOR_SIGMA**2 + SURFACE_SIGMA**2 * 4 * half * (1 - half)
    index += corner
    return _Band(
        index=index,
        points_mm=grid.index2world(index),
        mean=volume[near].astype(np.float64),
        sigma=np.sqrt(sigma2),
        offsets=offsets,
        free=free,
        column=found[free],
    )


def _correlation(band: _Band, tree: Tree) -> sparse.csr_matrix:
    """G with G G^T the prior covariance: Gaussian along and across the nearest vessel."""
    tangents = np.concatenate([branch.tangents for branch in tree.branches])
    nearest = cKDTree(tree.points()).query(band.points_mm)[1]
    along = tangents[nearest] @ band.offsets.T
    across2 = np.maximum(np.einsum("ij,ij->i", band.offsets, band.offsets) - along**2, 0.0)
    weight = np.exp(-0.5 * ((along / ALONG_VOXELS) ** 2 + across2 / ACROSS_VOXELS**2))
    weight *= band.free
    weight *= (band.sigma / np.sqrt(np.einsum("ij,ij->i", weight, weight)))[:, None]
    return band.matrix(weight)


def _pictures(
    band: _Band,
    tree: Tree,
    grid: Grid,
    views: Sequence[VesselImage],
    contrast: Sequence[float],
    edge_blur_mm: float,
    model_mm: Sequence[Array],
) -> tuple[list[sparse.csr_matrix], list[Scalars], list[Scalars]]:
    """Projector, path that the tubes leave unexplained, and its variance, per view."""
    tubes = tubes_of(tree)
    h = float(grid.spacing_mm.mean())
    operators: list[sparse.csr_matrix] = []
    errors: list[Scalars] = []
    variances: list[Scalars] = []
    alike = _alike(views)
    for k, (view, factor) in enumerate(zip(views, contrast, strict=True)):
        if not view.calibrated:
            continue
        box = max(edge_blur_mm / view.carm.pixel_at_isocenter_mm, 0.05)
        if len(model_mm):
            model = model_mm[k]
        else:
            model = footprint(tubes, view.carm, box).image(view.path_mm.shape)
        rest = np.where(view.valid, view.path_mm / factor - model, 0.0)
        cells = cell_view(view.carm, view.path_mm, band.points_mm, h)
        rest = shrunk(view.carm, rest.astype(np.float32), h)[1]
        operators.append(cells.matrix)
        errors.append(rest.reshape(-1)[cells.pixel].astype(np.float64))
        path = cells.path_mm.reshape(-1)[cells.pixel].astype(np.float64)
        variances.append(alike[k] * (NOISE_MM + NOISE_SHARE * path) ** 2)
    return operators, errors, variances


def _alike(views: Sequence[VesselImage]) -> Scalars:
    """Count the views that see what each view sees, itself among them: (views,), 1 and above."""
    apart = np.array([separation_deg(a.carm, b.carm) for a in views for b in views])
    # From the front and from the back the paths are the same.
    apart = np.minimum(apart, 180.0 - apart).reshape(len(views), len(views))
    out: Scalars = np.exp(-0.5 * (apart / SAME_DIRECTION_DEG) ** 2).sum(axis=1)
    return out


def _points(
    band: _Band, tree: Tree, grid: Grid, centers: CenterPoints, views: int
) -> tuple[sparse.csr_matrix, Scalars, Scalars] | None:
    """Read what the starting points say of the voxels; None where they are too coarse."""
    h = float(grid.spacing_mm.mean())
    ratio = centers.spacing_mm / h
    if not 1 / SAME_SPACING < ratio < SAME_SPACING:
        return None
    density = _deposited(centers, grid, band.index) * ratio**3
    n = len(band.index)
    at = grid.world2index(centers.points_mm)
    if scatter_is_none(centers) and np.abs(at - np.rint(at)).max() < 0.02:
        error = density - band.mean
        rim = band.sigma > 0.5 * SURFACE_SIGMA
        spread = float(np.mean(error[rim] ** 2)) if rim.any() else 0.0
        few = 2 / max(views, 2)
        tubes = TUBE_ERROR**2 * (LASTING_SHARE + (1 - LASTING_SHARE) * few)
        noise = CONFIDENCE_SIGMA**2 + BIAS_WEIGHT * few * max(spread - tubes, 0.0)
        return sparse.eye(n, format="csr"), error, np.full(n, noise)
    sigma = scatter_voxels(tree, centers)
    if sigma > MAX_SCATTER_VOXELS:
        return None
    # Trilinear deposit adds the variance of its tent, 1/6.
    width2 = sigma**2 + 1 / 6
    weight = np.exp(-0.5 * np.einsum("ij,ij->i", band.offsets, band.offsets) / width2)
    K = band.matrix(np.broadcast_to(weight / weight.sum(), band.free.shape))
    expected = K @ band.mean
    # Dropped points lower the whole density: compare shapes only.
    scale = float(density.sum() / max(expected.sum(), 1e-9))
    variance = 0.01 + SCATTER_VARIANCE * np.maximum(expected, 0.02)
    return K, density / max(scale, 1e-9) - expected, variance


def _deposited(centers: CenterPoints, grid: Grid, index: Array) -> Scalars:
    """(n,) confidence deposited on the (n, 3) voxels, trilinear."""
    at = grid.world2index(centers.points_mm)
    at = np.where(np.abs(at - np.rint(at)) < 1e-6, np.rint(at), at)
    base = np.floor(at).astype(np.int64)
    share = at - base
    low = index.min(axis=0)
    shape = index.max(axis=0) + 1 - low
    # Of either neighbour along each axis: its place, its share, and whether it lies inside.
    sides = [
        [(place, part, (place >= 0) & (place < n) & (part > 0))
         for place, part in ((b, 1 - s), (b + 1, s))]
        for b, s, n in zip((base - low).T, share.T, shape, strict=True)
    ]  # fmt: skip
    out = np.zeros(int(shape.prod()))
    for (x, by_x, in_x), (y, by_y, in_y), (z, by_z, in_z) in itertools.product(*sides):
        ok = np.flatnonzero(in_x & in_y & in_z)
        if len(ok):
            flat = (x[ok] * shape[1] + y[ok]) * shape[2] + z[ok]
            weight = centers.confidence[ok] * (by_x[ok] * by_y[ok] * by_z[ok])
            out += np.bincount(flat, weight, minlength=len(out))
    here: Scalars = out[np.ravel_multi_index(tuple((index - low).T), tuple(shape))]
    return here


def scatter_voxels(tree: Tree, centers: CenterPoints) -> float:
    """Scatter of the points about the tubes, in point spacings: excess of their second moment.

    A round section of radius r has mean squared distance r^2 / 2 from its axis; each cell adds
    h^2 / 6 across, a scatter sigma adds 2 sigma^2.
    """
    h = centers.spacing_mm
    distance, nearest = cKDTree(tree.points()).query(centers.points_mm)
    radius = tree.radii()[nearest]
    near = distance < radius + 3 * h
    weight = centers.confidence * near
    if weight.sum() <= 0:
        return np.inf
    excess = float((weight * (distance**2 - 0.5 * radius**2)).sum() / weight.sum())
    return float(np.sqrt(max(0.5 * (excess - h * h / 6), 0.0))) / h


def _solve(
    G: sparse.csr_matrix,
    O: sparse.csr_matrix,
    error: Scalars,
    variance: Scalars,
) -> Scalars:
    inverse = 1.0 / variance
    GT, OT = G.T, O.T

    def apply(z: Scalars) -> Scalars:
        out: Scalars = z + GT @ (OT @ (inverse * (O @ (G @ z))))
        return out

    n = G.shape[0]
    z, _ = cg(
        LinearOperator((n, n), matvec=apply, dtype=np.float64),
        GT @ (OT @ (inverse * error)),
        rtol=CG_TOLERANCE,
        maxiter=CG_STEPS,
    )
    change: Scalars = G @ z
    return change

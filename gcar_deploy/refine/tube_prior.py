"""What is known of vessels before the pictures: they bend and taper slowly, near the start.

How slowly they taper depends on the pictures' pixel. A random walk of the log radius with one
step size rounds off the core of a stenosis; where fine pixels show the core, the step is larger
(``taper_easing``). Coarse pixels need the small one, or the radius follows the pixels' raster.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import sparse

from gcar_deploy.config import TubeOptions
from gcar_deploy.refine.tube_model import Tubes
from gcar_deploy.types import Array, Scalars

#: confidence below which a starting point still holds a little.
LEAST_TRUST = 0.05


@dataclasses.dataclass(frozen=True, eq=False)
class Prior:
    """Quadratic prior 0.5 |A x - b|^2 over the unknowns.

    Attributes
    ----------
    A : (m, unknowns) sparse
    b : (m,)
    hessian : (unknowns, unknowns) A^T A, with a place for every entry that the pictures add
    slots : (s, 8, 8) where in ``hessian.data`` a segment's unknowns meet
    start, trust : what it was made of
    easing : factor on the taper's random walk
    """

    A: sparse.csr_matrix
    b: Scalars
    hessian: sparse.csc_matrix
    slots: Array
    start: Tubes
    trust: Scalars
    easing: float

    def at_pixel(self, pixel_mm: float, options: TubeOptions) -> Prior:
        """Return the prior round the same start for pictures of that pixel."""
        if taper_easing(pixel_mm, options) == self.easing:
            return self
        return make_prior(self.start, self.trust, options, pixel_mm)

    def value(self, x: Scalars) -> float:
        """Half the squared norm."""
        r = self.A @ x - self.b
        return 0.5 * float(r @ r)

    def gradient(self, x: Scalars) -> Scalars:
        """A^T (A x - b)."""
        out: Scalars = self.A.T @ (self.A @ x - self.b)
        return out

    def added(self, blocks: Array) -> sparse.csc_matrix:
        """Hessian of the prior and of (s, 8, 8) blocks, one per segment, together."""
        H = self.hessian
        data = H.data + np.bincount(
            self.slots.reshape(-1), blocks.reshape(-1), minlength=len(H.data)
        )
        return sparse.csc_matrix((data, H.indices, H.indptr), shape=H.shape)


def taper_easing(pixel_mm: float, options: TubeOptions) -> float:
    """Return the factor on the taper's random walk for pixels of that edge at the isocentre, mm.

    1 down to ``taper_pixel_mm``, then growing as pixels shrink, to ``most_taper_easing``.
    """
    return min(max(options.taper_pixel_mm / pixel_mm, 1.0), options.most_taper_easing)


def make_prior(
    tubes: Tubes, trust: Scalars, options: TubeOptions, pixel_mm: float = np.inf
) -> Prior:
    """Bending, taper and anchors of a tree at its start, per mm of centreline.

    Parameters
    ----------
    tubes : Tubes at the start
    trust : (n,) 0 .. 1, confidence in each branch point
    options : TubeOptions
    pixel_mm : pixel of the pictures at the isocentre
    """
    easing = taper_easing(pixel_mm, options)
    p, n = len(tubes.positions_mm), len(tubes.log_radius)
    points = tubes.points_mm
    gap = np.maximum(np.linalg.norm(points[tubes.second] - points[tubes.first], axis=1), 1e-3)
    own = np.bincount(tubes.first, 0.5 * gap, n) + np.bincount(tubes.second, 0.5 * gap, n)
    bend = _bending(tubes, gap, options.bend)
    taper = _taper(tubes, gap, options.taper * easing)
    weight = np.bincount(tubes.owner, own * np.maximum(trust, LEAST_TRUST), p)
    hold = np.concatenate(
        [
            np.repeat(np.sqrt(weight) / options.anchor_mm, 3),
            np.sqrt(own) / options.anchor_log_radius,
        ]
    )
    start = np.concatenate([tubes.positions_mm.reshape(-1), tubes.log_radius])
    A = sparse.vstack(
        [
            sparse.hstack(
                [sparse.kron(bend, sparse.eye(3)), sparse.csr_matrix((3 * bend.shape[0], n))]
            ),
            sparse.hstack([sparse.csr_matrix((len(gap), 3 * p)), taper]),
            sparse.diags(hold),
        ]
    ).tocsr()
    b = np.concatenate([np.zeros(3 * bend.shape[0] + len(gap)), hold * start])
    hessian, slots = _with_places((A.T @ A).tocoo(), columns_of(tubes))
    return Prior(A, b, hessian, slots, tubes, trust, easing)


def columns_of(tubes: Tubes) -> Array:
    """(s, 8) unknowns of each segment: position a (3), position b (3), log radius a, b."""
    a, b = tubes.owner[tubes.first], tubes.owner[tubes.second]
    axis = np.arange(3)
    offset = 3 * len(tubes.positions_mm)
    return np.concatenate(
        [
            3 * a[:, None] + axis,
            3 * b[:, None] + axis,
            (offset + tubes.first)[:, None],
            (offset + tubes.second)[:, None],
        ],
        axis=1,
    )


def _with_places(matrix: sparse.coo_matrix, columns: Array) -> tuple[sparse.csc_matrix, Array]:
    """Add zeros where segments' unknowns meet; (s, 8, 8) says where they are in the data."""
    size = matrix.shape[0]
    # Columns first: sorted, the keys are in the order of a CSC matrix.
    met = (columns[:, None, :] * np.int64(size) + columns[:, :, None]).reshape(-1)
    own = matrix.col.astype(np.int64) * size + matrix.row
    keys = np.unique(np.concatenate([own, met]))
    data = np.bincount(np.searchsorted(keys, own), matrix.data, minlength=len(keys))
    pointer = np.searchsorted(keys, np.arange(size + 1) * np.int64(size))
    hessian = sparse.csc_matrix(
        (data.astype(np.float64), (keys % size).astype(np.int32), pointer.astype(np.int32)),
        shape=(size, size),
    )
    return hessian, np.searchsorted(keys, met).reshape(len(columns), 8, 8)


def _taper(tubes: Tubes, gap: Scalars, taper: float) -> sparse.csr_matrix:
    """(s, n) steps of the log radius, scaled to a random walk."""
    w = 1.0 / (taper * np.sqrt(gap))
    row = np.tile(np.arange(len(gap)), 2)
    column = np.concatenate([tubes.first, tubes.second])
    return sparse.csr_matrix(
        (np.concatenate([w, -w]), (row, column)), shape=(len(gap), len(tubes.log_radius))
    )


def _bending(tubes: Tubes, gap: Scalars, bend: float) -> sparse.csr_matrix:
    """(m, p) second differences along the branches, scaled to a random walk of direction."""
    k = np.flatnonzero(tubes.second[:-1] == tubes.first[1:])
    a, b, c = (tubes.owner[x] for x in (tubes.first[k], tubes.second[k], tubes.second[k + 1]))
    left, right = gap[k], gap[k + 1]
    scale = 1.0 / (bend * np.sqrt(0.5 * (left + right)))
    value = np.concatenate([scale / left, -scale * (1 / left + 1 / right), scale / right])
    row = np.tile(np.arange(len(k)), 3)
    return sparse.csr_matrix(
        (value, (row, np.concatenate([a, b, c]))), shape=(len(k), len(tubes.positions_mm))
    )

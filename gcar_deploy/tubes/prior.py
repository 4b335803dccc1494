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
from gcar_deploy.tubes.arrow import Arrow, plan_of
from gcar_deploy.tubes.model import Tubes
from gcar_deploy.types import Array, Scalars

#: pixels below this at the isocentre show narrow cores, and loosen the taper in proportion, mm
TAPER_PIXEL_MM = 0.85
#: ... but at most so many times
MOST_TAPER_EASING = 3.0
#: confidence below which a starting point still holds a little.
LEAST_TRUST = 0.05


@dataclasses.dataclass(frozen=True, eq=False)
class Prior:
    """Quadratic prior 0.5 |A x - b|^2 over the unknowns.

    Attributes
    ----------
    A : (m, unknowns) sparse
    b : (m,)
    hessian : A^T A
    slots : (s, 8, 8) where in ``hessian.data`` a segment's unknowns meet
    hold : (unknowns,) share of the diagonal of ``hessian`` that the anchors are
    start, trust : what it was made of
    easing : factor on the taper's random walk
    """

    A: sparse.csr_matrix
    b: Scalars
    hessian: Arrow
    slots: Array
    hold: Scalars
    start: Tubes
    trust: Scalars
    easing: float

    def at_pixel(self, pixel_mm: float, options: TubeOptions) -> Prior:
        """Return the prior round the same start for pictures of that pixel."""
        if taper_easing(pixel_mm) == self.easing:
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

    def added(self, blocks: Array) -> Arrow:
        """Hessian of the prior and of (s, 8, 8) blocks, one per segment, together."""
        size = len(self.hessian.data)
        sums = np.bincount(self.slots.reshape(-1), blocks.reshape(-1), minlength=size + 1)
        return Arrow(self.hessian.plan, self.hessian.data + sums[:size])


def taper_easing(pixel_mm: float) -> float:
    """Return the factor on the taper's random walk for pixels of that edge at the isocentre, mm.

    1 down to ``TAPER_PIXEL_MM``, then growing as pixels shrink, to ``MOST_TAPER_EASING``.
    """
    return min(max(TAPER_PIXEL_MM / pixel_mm, 1.0), MOST_TAPER_EASING)


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
    easing = taper_easing(pixel_mm)
    p, n = len(tubes.positions_mm), len(tubes.log_radius)
    points = tubes.points_mm
    gap = np.maximum(np.linalg.norm(points[tubes.second] - points[tubes.first], axis=1), 1e-3)
    own = np.bincount(tubes.first, 0.5 * gap, n) + np.bincount(tubes.second, 0.5 * gap, n)
    weight = np.bincount(tubes.owner, own * np.maximum(trust, LEAST_TRUST), p)
    hold = np.concatenate(
        [
            np.repeat(np.sqrt(weight) / options.anchor_mm, 3),
            np.sqrt(own) / options.anchor_log_radius,
        ]
    )
    start = np.concatenate([tubes.positions_mm.reshape(-1), tubes.log_radius])
    # Rows of A with the unknowns that each one joins: three, two and one of them.
    parts = [
        _bending(tubes, gap, options.bend),
        _taper(tubes, gap, options.taper * easing),
        (np.arange(len(hold))[:, None], hold[:, None]),
    ]
    b = np.concatenate([np.zeros(len(parts[0][0]) + len(gap)), hold * start])
    plan = plan_of(tubes)
    slots, values = [], []
    for column, value in parts:
        product = value[:, :, None] * value[:, None, :]
        pair = np.broadcast_arrays(column[:, :, None], column[:, None, :])
        slots.append(plan.slots(*pair).reshape(-1))
        values.append(product.reshape(-1))
    data = np.bincount(
        np.concatenate(slots), np.concatenate(values), minlength=plan.size + 1
    ).astype(np.float64)[: plan.size]
    columns = columns_of(tubes)
    met = plan.slots(*np.broadcast_arrays(columns[:, :, None], columns[:, None, :]))
    return Prior(
        A=_rows(parts, len(start)), b=b, hessian=Arrow(plan, data), slots=met, hold=hold**2,
        start=tubes, trust=trust, easing=easing,
    )  # fmt: skip


def _rows(parts: list[tuple[Array, Array]], unknowns: int) -> sparse.csr_matrix:
    """Stack (rows, k) columns and values, k the same within a part."""
    counts = np.concatenate([np.full(len(column), column.shape[1]) for column, _ in parts])
    return sparse.csr_matrix(
        (
            np.concatenate([value.reshape(-1) for _, value in parts]),
            np.concatenate([column.reshape(-1) for column, _ in parts]),
            np.concatenate([[0], np.cumsum(counts)]),
        ),
        shape=(len(counts), unknowns),
    )


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


def _taper(tubes: Tubes, gap: Scalars, taper: float) -> tuple[Array, Array]:
    """(s, 2) unknowns and factors of the log radius' steps, scaled to a random walk."""
    w = 1.0 / (taper * np.sqrt(gap))
    column = 3 * len(tubes.positions_mm) + np.stack([tubes.first, tubes.second], axis=1)
    return column, np.stack([w, -w], axis=1)


def _bending(tubes: Tubes, gap: Scalars, bend: float) -> tuple[Array, Array]:
    """(m, 3) unknowns and factors of second differences, scaled to a random walk of direction."""
    k = np.flatnonzero(tubes.second[:-1] == tubes.first[1:])
    points = np.stack([tubes.first[k], tubes.second[k], tubes.second[k + 1]], axis=1)
    left, right = gap[k], gap[k + 1]
    scale = 1.0 / (bend * np.sqrt(0.5 * (left + right)))
    value = np.stack([scale / left, -scale * (1 / left + 1 / right), scale / right], axis=1)
    column = 3 * tubes.owner[points][:, None, :] + np.arange(3)[:, None]
    return column.reshape(-1, 3), np.repeat(value, 3, axis=0)

"""Covariance of each centreline point: what the fit leaves open, and what the geometry does.

The fit's part is the inverse of its true Gauss-Newton Hessian (``hessian``), pictures and prior
together, so that all that couples is in it: neighbours along a vessel, branches at a fork, vessels
that share rays. The geometry's part is what this fit makes of views that stand elsewhere: their
angles and the patient are further unknowns with the stated prior. What the pictures would notice
is not left open; what they would not (a move along the beams) is, and adds

    X C X^T,   X = -H^-1 B,   C = (S^-1 + G - B^T H^-1 B)^-1,

B and G the blocks of the joint Hessian, S the prior (Schur complement of the points). Both parts
hold if the branch is there at all: another vessel behind the same rays is another question.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from gcar_deploy.beside import side_by_side
from gcar_deploy.errors import NumericalError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.prior import LEFT_DEG, LEFT_MM
from gcar_deploy.tubes.hessian import Seen
from gcar_deploy.tubes.model import Tubes
from gcar_deploy.tubes.prior import Prior
from gcar_deploy.types import Array, Pixels, Points

#: covariances are solved for every so many points and interpolated between.
EVERY = 5
#: ... so many right-hand sides at once: from eight on BLAS sends small products to its threads,
#: which costs far more than the products where another program has a core
TOGETHER = 4
#: a starting point errs as its neighbours do, and moves with the geometry it was found in: the
#: starting points hold so many times less than the fit lets them
SHARED_STARTS = 100.0
#: a Hessian of more entries takes minutes to factorise and to solve, in calls that nothing ends:
#: vessels that share rays, but no fork, then count as known to each other. Of a tree of 60 branches
#: sigma is 0.93 to 1.17 times as large then, the median 1.00 in two views and 1.04 in four
MOST_ENTRIES = 2_000_000
#: error of a tube between the pixels, as a share of the coarsest pixel at the isocentre
PIXEL_SHARE = 0.15
#: step of the first differences by a view's place, mm and degrees
_STEP = 0.1


@dataclasses.dataclass(frozen=True, eq=False)
class Spread:
    """Covariances of n branch points across their vessel, mm^2 LPS; along it they are 0.

    Along a vessel a point may slide without changing the tube.

    Attributes
    ----------
    fit, geometry : (n, 3, 3) parts that add
    """

    fit: Array
    geometry: Array


def spread(
    tubes: Tubes, tangents: Points, views: Sequence[Seen], prior: Prior,
    should_stop: Callable[[], bool] | None = None,
) -> Spread:  # fmt: skip
    """Work out both parts of the covariance of every branch point.

    Parameters
    ----------
    tubes : Tubes at the fit
    tangents : (n, 3) unit vector along the vessel at each branch point
    views : what each view says of them
    prior : Prior of the fit
    should_stop : asked on the way: where it raises, that ends it; what is late is not waited for
        longer than it must be

    Raises
    ------
    NumericalError
        The Hessian is singular.
    """
    n = len(tubes.owner)
    if not n:
        return Spread(np.zeros((0, 3, 3)), np.zeros((0, 3, 3)))
    late = should_stop is not None and should_stop()
    hessian = sum(view.hessian() for view in views)
    if late or hessian.nnz > MOST_ENTRIES:
        hessian = _within_branches(hessian, tubes)
    factor = _factorised(hessian, prior)
    ends = np.flatnonzero(np.diff(tubes.point_branch, prepend=-1, append=-1))
    places = np.unique(np.concatenate([np.arange(0, n, EVERY), ends[:-1], ends[1:] - 1]))
    row = 3 * tubes.owner[places][:, None] + np.arange(3)
    parts = [_fit(factor, row, should_stop), _geometry(factor, row, tubes, views)]
    across = np.eye(3) - tangents[:, :, None] * tangents[:, None, :]
    coarsest = max(view.carm.pixel_at_isocenter_mm for view in views)
    parts[0] = parts[0] + (PIXEL_SHARE * coarsest) ** 2 * np.eye(3)
    return Spread(*(across @ _between(part, places, n) @ across for part in parts))


def _within_branches(hessian: sparse.csc_matrix, tubes: Tubes) -> sparse.csc_matrix:
    """Leave out what couples branches otherwise than by the node where they meet."""
    count = len(tubes.positions_mm)
    first, last = np.full(count, len(tubes.owner)), np.full(count, -1)
    np.minimum.at(first, tubes.owner, tubes.point_branch)
    np.maximum.at(last, tubes.owner, tubes.point_branch)
    # Three coordinates of every position, then the radius of every point; -1 is every branch's.
    of = np.concatenate([np.repeat(np.where(first == last, first, -1), 3), tubes.point_branch])
    whole = hessian.tocoo()
    row, column = of[whole.row], of[whole.col]
    keep = (row == column) | (row < 0) | (column < 0)
    kept = whole.data[keep], (whole.row[keep], whole.col[keep])
    return sparse.csc_matrix(kept, shape=hessian.shape)


def _factorised(hessian: sparse.csc_matrix, prior: Prior) -> SuperLU:
    starts = sparse.diags((1.0 - 1.0 / SHARED_STARTS) * prior.hold)
    whole = (hessian + prior.A.T @ prior.A - starts).tocsc()
    # Positions of no branch have no equation: any value will do.
    whole = whole + sparse.diags((whole.diagonal() == 0).astype(np.float64), format="csc")
    try:
        # Symmetric and positive definite: no pivoting, and the order suits both triangles.
        factor = splu(whole, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                      options={"SymmetricMode": True})  # fmt: skip
    except RuntimeError as error:
        raise NumericalError(f"the Hessian of the fit is singular: {error}") from None
    return factor


def _fit(factor: SuperLU, row: Array, should_stop: Callable[[], bool] | None) -> Array:
    """(k, 3, 3) blocks of the inverse at (k, 3) rows."""
    rows, back = np.unique(row, return_inverse=True)
    back = back.reshape(row.shape)
    parts = [rows[start : start + TOGETHER] for start in range(0, len(rows), TOGETHER)]
    solved = np.concatenate(
        side_by_side([functools.partial(_columns, factor, part, should_stop) for part in parts]),
        axis=1,
    )
    out: Array = solved[row[:, :, None], back[:, None, :]]
    return 0.5 * (out + np.swapaxes(out, 1, 2))


def _columns(factor: SuperLU, rows: Array, should_stop: Callable[[], bool] | None) -> Array:
    """(unknowns, m) columns of the inverse."""
    if should_stop is not None:
        should_stop()  # Whoever cancelled raises here.
    unit = np.zeros((factor.shape[0], len(rows)), order="F")
    unit[rows, np.arange(len(rows))] = 1.0
    out: Array = factor.solve(unit)
    return out


def _geometry(factor: SuperLU, row: Array, tubes: Tubes, views: Sequence[Seen]) -> Array:
    """(k, 3, 3) what views that may stand elsewhere add at (k, 3) rows."""
    if len(views) < 2:
        return np.zeros((len(row), 3, 3))
    pulls = [view.pull(_moved(view.carm, tubes.points_mm)) for view in views[1:]]
    B = np.concatenate([pull for pull, _ in pulls], axis=1)
    X = -factor.solve(B)
    inverse = np.diag(np.tile([LEFT_MM**-2] * 3 + [LEFT_DEG**-2] * 2, len(pulls)))
    inverse += sparse.block_diag([own for _, own in pulls]).toarray() + B.T @ X
    here = X[row]
    out: Array = here @ np.linalg.inv(inverse) @ np.swapaxes(here, 1, 2)
    return out


def _moved(carm: CArm, points_mm: Points) -> list[Pixels]:
    """(n, 2) pixels per mm and degree that points move by: table x, y, z, then both angles."""
    base = carm.project(points_mm)[0]
    other = [carm.moved(_STEP * axis) for axis in np.eye(3)]
    other += [carm.turned(primary_deg=_STEP), carm.turned(secondary_deg=_STEP)]
    return [
        np.nan_to_num((view.project(points_mm)[0] - base) / _STEP, posinf=0.0, neginf=0.0)
        for view in other
    ]


def _between(known: Array, places: Array, n: int) -> Array:
    """(n, 3, 3) linear in between (k, 3, 3) at ``places``, which hold both ends of branches."""
    flat = known.reshape(-1, 9)
    at = np.arange(n)
    return np.stack([np.interp(at, places, column) for column in flat.T], 1).reshape(-1, 3, 3)

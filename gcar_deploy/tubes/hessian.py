"""The true Gauss-Newton Hessian of a tube fit, with the couplings that its steps leave out.

A pixel that a ray crosses several vessels for is one equation for all of them: its row of the
Jacobian is the sum of theirs. The steps of the fit weigh each vessel by the number of crossings
instead (``gauss_newton``), a matrix that is never smaller than the true one, so that its inverse
promises too much where vessels overlap. What a fit leaves open is the inverse of the true one.

Each view is taken in its own terms first: pixel (col, row) and log radius of every branch point.
A C-arm that stands elsewhere moves the pixels alone, so the same matrix says what that pulls at.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import sparse

from gcar_deploy.config import TubeOptions
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.tubes.gauss_newton import basis_of, moments_of, sums_of, weights_of
from gcar_deploy.tubes.model import Footprint, Tubes
from gcar_deploy.tubes.targets import Target
from gcar_deploy.types import Array, Pixels, Scalars

#: patches of a picture that err together, mm^2 at the isocentre
PATCH_MM2 = 22.0
#: mean squared residual that is always there, in units of the fit's own noise
LEAST_MISFIT = 0.2
#: ... and times so much where vessels share rays: which of them a residual is due to is open
CROSSED = 10.0
#: residuals are averaged over so many segments to either side
STRETCH = 4


@dataclasses.dataclass(frozen=True, eq=False)
class Seen:
    """What one view says of all branch points together.

    Attributes
    ----------
    carm : CArm
    information : (3 n, 3 n) sparse J^T W J by the n points' pixels (2 n), then log radii (n)
    by_unknowns : (3 n, 3 p + n) sparse change of those with the unknowns: positions, log radii
    """

    carm: CArm
    information: sparse.csc_matrix
    by_unknowns: sparse.csr_matrix

    def hessian(self) -> sparse.csc_matrix:
        """(3 p + n, 3 p + n) sparse J^T W J by the unknowns."""
        return (self.by_unknowns.T @ self.information @ self.by_unknowns).tocsc()

    def pull(self, moved: list[Pixels]) -> tuple[Array, Array]:
        """Say what pictures whose points lie elsewhere pull at.

        Parameters
        ----------
        moved : k times (n, 2) pixels, by how much all points lie elsewhere

        Returns
        -------
        (3 p + n, k) gradients of half the squared residuals, and (k, k) their second derivatives
        """
        n = len(moved[0])
        shift = np.concatenate([np.stack([m.ravel() for m in moved], 1), np.zeros((n, len(moved)))])
        pulled = self.information @ shift
        return self.by_unknowns.T @ pulled, shift.T @ pulled


def seen_by(tubes: Tubes, target: Target, seen: Footprint, options: TubeOptions) -> Seen:
    """Read what one picture says of the tubes at the fit, as far as the fit explains it.

    Weights are those of the fit, robustness included, over the misfit there (``misfit``).
    """
    n, segments = len(tubes.owner), len(tubes.first)
    a, b = tubes.first, tubes.second
    columns = np.stack([2 * a, 2 * a + 1, 2 * b, 2 * b + 1, 2 * n + a, 2 * n + b], axis=1)
    weight, left = weights_of(target, seen, options)
    weight = weight * target.contrast**2 / misfit(tubes, target, seen, left)
    basis = basis_of(seen)
    one, other, crossed = _crossed(seen, basis, weight, segments)
    parts = (
        (columns, columns, moments_of(seen, basis, weight)),
        (columns[one], columns[other], crossed),
        (columns[other], columns[one], np.swapaxes(crossed, 1, 2)),
    )
    row = np.concatenate([np.repeat(rows, 6, axis=1).ravel() for rows, _, _ in parts])
    column = np.concatenate([np.tile(cols, (1, 6)).ravel() for _, cols, _ in parts])
    value = np.concatenate([block.ravel() for _, _, block in parts])
    information = sparse.csc_matrix((value, (row, column)), shape=(3 * n, 3 * n))
    return Seen(target.carm, information, _by_unknowns(tubes, target.carm))


def misfit(tubes: Tubes, target: Target, seen: Footprint, left: Scalars) -> Scalars:
    """(e,) variance of each entry's pixel over what the fit takes it for, both per mm^2.

    What a fit leaves of a picture is no white noise: sections that are not round, and vessels that
    are taken for each other, make whole patches err together. Left-overs of mean square m over
    patches of ``PATCH_MM2`` are a noise of m ``PATCH_MM2`` per mm^2 of picture. The mean square is
    that of the stretch of vessel; where several share a pixel, the largest of theirs.

    Parameters
    ----------
    left : (e,) what the model leaves of each entry's path, mm
    """
    z2 = (left / target.sigma_mm.reshape(-1)[seen.pixel]) ** 2
    told = seen.path_mm > 0
    total, pixels = (
        _along(sums, tubes.branch) for sums in sums_of(seen, np.stack([z2 * told, told]))
    )
    local = np.where(told, (total / np.maximum(pixels, 1.0) + LEAST_MISFIT)[seen.segment], 0.0)
    most = np.full(len(seen.covered), LEAST_MISFIT)
    np.maximum.at(most, seen.group, local)
    local = most[seen.group]
    # A mask shows one of several, and which one is open all the same.
    there = seen.crossings if target.shown == "path" else np.bincount(seen.group)[seen.group]
    out: Scalars = PATCH_MM2 * local * np.where(there > 1, CROSSED, 1.0)
    return out


def _along(values: Scalars, branch: Array) -> Scalars:
    """(s,) sums over ``STRETCH`` segments of the same branch to either side."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    here = np.arange(len(values))
    first = np.searchsorted(branch, branch)
    last = np.searchsorted(branch, branch, side="right")
    return total[np.minimum(here + STRETCH + 1, last)] - total[np.maximum(here - STRETCH, first)]


def _by_unknowns(tubes: Tubes, carm: CArm) -> sparse.csr_matrix:
    n, free = len(tubes.owner), 3 * len(tubes.positions_mm)
    column = np.repeat(3 * tubes.owner[:, None] + np.arange(3), 2, axis=0)
    return sparse.csr_matrix(
        (
            np.concatenate([carm.jacobian(tubes.points_mm).ravel(), np.ones(n)]),
            np.concatenate([column.ravel(), free + np.arange(n)]),
            np.concatenate([np.arange(0, 6 * n + 1, 3), 6 * n + 1 + np.arange(n)]),
        ),
        shape=(3 * n, free + n),
    )


def _crossed(
    seen: Footprint, basis: Array, weight: Scalars, count: int
) -> tuple[Array, Array, Array]:
    """Pairs of segments that share pixels, (k,) and (k,), and (k, 6, 6) their moments."""
    one, other = _pairs(seen)
    key = seen.segment[one] * count + seen.segment[other]
    order = np.argsort(key, kind="stable")
    one, other, key = one[order], other[order], key[order]
    start = np.flatnonzero(np.diff(key, prepend=-1))
    if not len(start):
        return start, start, np.zeros((0, 6, 6))
    second = basis[:, other]
    out = np.stack(
        [np.add.reduceat(second * (weight[one] * first), start, axis=1) for first in basis[:, one]]
    )
    return key[start] // count, key[start] % count, np.moveaxis(out, -1, 0)


def _pairs(seen: Footprint) -> tuple[Array, Array]:
    """Every two entries above 0 that share a pixel, each pair once."""
    entry = np.flatnonzero((seen.crossings > 1) & (seen.path_mm > 0))
    entry = entry[np.argsort(seen.group[entry], kind="stable")]
    group = seen.group[entry]
    one, other = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for step in range(1, int(seen.crossings.max(initial=1))):
        same = group[step:] == group[:-step]
        one.append(entry[:-step][same])
        other.append(entry[step:][same])
    return np.concatenate(one), np.concatenate(other)

"""Normal equations of a tree of chains: a band per branch, bordered by the joints they share.

Positions and log radii of a branch, in order along it, couple within a narrow band. Branches
meet only in the positions they share (joints), so the matrix is

    [ T  B ]      T banded, one block per branch
    [ B' C ]      C the joints, B six columns per branch: its joints at both ends

and is solved by a banded Cholesky factorisation of T and a dense one of the Schur complement
S = C - B' T^-1 B of the joints (block elimination; Golub and Van Loan, Matrix Computations, 4.3 and
4.5). The cost grows with the number of points.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.linalg.lapack import dpbtrf, dpbtrs, dpotrf, dpotrs

from gcar_deploy.tubes.model import Tubes
from gcar_deploy.types import Array, Scalars

#: diagonals of the band below the main one: second differences of positions, four unknowns a point
BAND = 10
#: a branch's columns of the border: its first joint (x, y, z), its last
SIDES = 6


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """Where the unknowns of some tubes go: positions (3 p), then log radii (n).

    Attributes
    ----------
    place : (3 p + n,) row of each unknown: chain rows first, then those of the joints
    chain, border : int, how many rows of each
    branch : (chain,) branch of each chain row
    first : (branches,) first chain row of each branch
    columns : (branches, 6) rows of S of each branch's border columns; ``border`` where it has none
    """

    place: Array
    chain: int
    border: int
    branch: Array
    first: Array
    columns: Array

    @property
    def size(self) -> int:
        """Numbers that make up the matrix."""
        return (BAND + 1 + SIDES) * self.chain + self.border**2

    def slots(self, row: Array, column: Array) -> Array:
        """Where entries (row, column) of the matrix stand among its numbers.

        Of a pair of mirrored entries outside the corner one is kept; the other goes to ``size``,
        beyond the last number.
        """
        i, j = self.place[row], self.place[column]
        out = np.full(i.shape, self.size, np.int64)
        band = (i < self.chain) & (j <= i)
        out[band] = j[band] * (BAND + 1) + (i - j)[band]
        edge = (i >= self.chain) & (j < self.chain)
        joint = i[edge] - self.chain
        own = self.columns[self.branch[j[edge]]]
        side = np.where(own[:, 0] == joint - joint % 3, 0, 3)
        out[edge] = (BAND + 1) * self.chain + j[edge] * SIDES + side + joint % 3
        corner = (i >= self.chain) & (j >= self.chain)
        out[corner] = (BAND + 1 + SIDES) * self.chain + (
            (i[corner] - self.chain) * self.border + j[corner] - self.chain
        )
        return out


def plan_of(tubes: Tubes) -> Plan:
    """Order the unknowns of some tubes along their branches, shared positions last."""
    positions, points = len(tubes.positions_mm), len(tubes.owner)
    shared = np.bincount(tubes.owner, minlength=positions) != 1
    joint = np.cumsum(shared) - 1
    width = np.where(shared[tubes.owner], 1, 4)
    base = np.cumsum(width) - width
    chain = int(width.sum())
    place = np.empty(3 * positions + points, np.int64)
    at = place[: 3 * positions].reshape(-1, 3)
    at[shared] = chain + 3 * joint[shared][:, None] + np.arange(3)
    free = np.flatnonzero(~shared[tubes.owner])
    at[tubes.owner[free]] = base[free][:, None] + np.arange(3)
    place[3 * positions :] = base + width - 1
    border = 3 * int(shared.sum())
    starts = np.flatnonzero(np.diff(tubes.point_branch, prepend=-1))
    ends = np.append(starts[1:], points)[: len(starts)] - 1
    columns = np.full((len(starts), SIDES), border, np.int64)
    for side, point in ((0, starts), (3, ends)):
        owner = tubes.owner[point]
        own = shared[owner]
        columns[own, side : side + 3] = 3 * joint[owner[own]][:, None] + np.arange(3)
    # Both ends on one joint: one set of columns for both.
    loop = (columns[:, 0] == columns[:, 3]) & (columns[:, 0] < border)
    columns[loop, 3:] = border
    branch = np.repeat(np.cumsum(np.diff(tubes.point_branch, prepend=-1) != 0) - 1, width)
    return Plan(place, chain, border, branch, base[starts], columns)


@dataclasses.dataclass(frozen=True, eq=False)
class Arrow:
    """Symmetric matrix over the unknowns of a plan; (plan.size,) numbers."""

    plan: Plan
    data: Scalars

    @property
    def band(self) -> Array:
        """(chain, BAND + 1) T[j + d, j]; a view."""
        return self.data[: (BAND + 1) * self.plan.chain].reshape(-1, BAND + 1)

    @property
    def edge(self) -> Array:
        """(chain, 6) B, each row's own six columns; a view."""
        start = (BAND + 1) * self.plan.chain
        return self.data[start : start + SIDES * self.plan.chain].reshape(-1, SIDES)

    @property
    def corner(self) -> Array:
        """(border, border) C; a view."""
        return self.data[(BAND + 1 + SIDES) * self.plan.chain :].reshape(
            self.plan.border, self.plan.border
        )

    def damped(self, share: float, least: float) -> Arrow:
        """Add ``share`` of itself and ``least`` to the diagonal (Levenberg and Marquardt)."""
        out = Arrow(self.plan, self.data.copy())
        out.band[:, 0] += share * out.band[:, 0] + least
        diagonal = np.einsum("ii->i", out.corner)
        diagonal += share * diagonal + least
        return out

    def factorised(self) -> Factor | None:
        """Factorise; None where the matrix is not positive definite (or not finite)."""
        plan = self.plan
        band, info = dpbtrf(self.band.T, lower=1)
        if info != 0 or not np.isfinite(band[0]).all():
            return None
        edge = np.ascontiguousarray(self.edge)
        inner = dpbtrs(band, edge, lower=1)[0] if plan.chain else np.zeros((0, SIDES))
        schur = np.zeros((plan.border + 1, plan.border + 1))
        schur[:-1, :-1] = self.corner
        if plan.chain:
            # Along the chain, which is long: rows of six at a time take three times as long.
            product = np.ascontiguousarray(edge.T)[:, None] * inner.T
            blocks = np.moveaxis(np.add.reduceat(product, plan.first, axis=2), 2, 0)
            np.subtract.at(schur, (plan.columns[:, :, None], plan.columns[:, None, :]), blocks)
        schur = schur[:-1, :-1]
        # Positions of no branch have no equation: any value will do.
        lone = np.diagonal(self.corner) == 0
        schur[lone, lone] = 1.0
        lower, info = dpotrf(schur, lower=1) if plan.border else (schur, 0)
        finite = info == 0 and bool(np.isfinite(lower).all())
        return Factor(plan, band, edge, inner, lower) if finite else None

    def dense(self) -> Array:
        """(unknowns, unknowns) all entries, in the order of the unknowns; slow."""
        plan = self.plan
        out = np.zeros((plan.chain + plan.border,) * 2)
        for d in range(BAND + 1):
            j = np.arange(plan.chain - d)
            out[j + d, j] = out[j, j + d] = self.band[: plan.chain - d, d]
        columns = plan.columns[plan.branch]
        row, side = np.nonzero(columns < plan.border)
        out[plan.chain + columns[row, side], row] = self.edge[row, side]
        out[row, plan.chain + columns[row, side]] = self.edge[row, side]
        out[plan.chain :, plan.chain :] = self.corner
        return out[np.ix_(plan.place, plan.place)]


@dataclasses.dataclass(frozen=True, eq=False)
class Factor:
    """Factorised ``Arrow``: Cholesky factors of T (band) and S (lower), B and T^-1 B."""

    plan: Plan
    band: Array
    edge: Array
    inner: Array
    lower: Array

    def solve(self, right: Scalars) -> Scalars:
        """(unknowns,) solution for one right-hand side."""
        plan = self.plan
        placed = np.empty(plan.chain + plan.border)
        placed[plan.place] = right
        chain, joints = placed[: plan.chain], np.append(placed[plan.chain :], 0.0)
        if plan.chain:
            chain = dpbtrs(self.band, chain, lower=1)[0]
        if plan.border:
            pull = np.add.reduceat(self.edge * chain[:, None], plan.first, axis=0)
            np.subtract.at(joints, plan.columns, pull)
            joints[:-1] = dpotrs(self.lower, joints[:-1], lower=1)[0]
            joints[-1] = 0.0
            chain = chain - np.einsum("ij,ij->i", self.inner, joints[plan.columns[plan.branch]])
        out: Scalars = np.concatenate([chain, joints[:-1]])[plan.place]
        return out

"""Shares between 0 and 1 that minimise a convex quadratic: the exact answer, not a near one.

An iterative minimiser that stops when it gains little leaves shares that depend on where it
began; along a flat direction by half, which keeps a ghost or drops a vessel.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gcar_deploy.types import Array, Scalars

#: most Newton steps; trees of a hundred pieces need about ten
STEPS = 200
#: curvature added, of the greatest: pieces with the same pictures share alike
RIDGE = 1e-9
#: a step shorter than this share of Newton's gains nothing any more
SHORTEST = 1e-6
#: shares move no more
SETTLED = 1e-12


def best_shares(gram: Array, pull: Scalars, start: Scalars) -> Scalars:
    """Minimise ``0.5 a.G a - pull.a`` over ``0 <= a <= 1`` by projected Newton (Bertsekas 1982).

    Parameters
    ----------
    gram : (k, k) G, symmetric, positive semidefinite
    pull : (k,)
    start : (k,) where to begin

    Returns
    -------
    (k,) the shares
    """
    largest = float(np.diag(gram).max(initial=0.0))
    if largest <= 0.0:
        return np.where(pull > 0, 1.0, 0.0)
    curved = gram + RIDGE * largest * np.eye(len(pull))

    def value(shares: Scalars) -> float:
        return float(0.5 * shares @ (curved @ shares) - pull @ shares)

    shares: Scalars = np.clip(start, 0.0, 1.0)
    for _ in range(STEPS):
        slope = curved @ shares - pull
        plain = np.clip(shares - slope / largest, 0.0, 1.0)
        if np.abs(plain - shares).max() < SETTLED:
            break
        # Held at a bound are shares that the slope pushes against it.
        free = ~((shares <= 0.0) & (slope >= 0.0) | (shares >= 1.0) & (slope <= 0.0))
        step = np.zeros_like(shares)
        step[free] = -np.linalg.solve(curved[np.ix_(free, free)], slope[free])
        moved = _decreased(value, shares, step)
        if moved is None:
            moved = _decreased(value, shares, plain - shares)
        if moved is None:
            break
        shares = moved
    return shares


def _decreased(value: Callable[[Scalars], float], shares: Scalars, step: Scalars) -> Scalars | None:
    """Go along the step, halved until the value falls; None where it does not."""
    before, size = value(shares), 1.0
    while size > SHORTEST:
        moved: Scalars = np.clip(shares + size * step, 0.0, 1.0)
        if value(moved) < before:
            return moved
        size *= 0.5
    return None

"""Standard deviation of each centreline point: noise of the fit, and a prior on the geometry.

The fit's part is the inverse of the Gauss-Newton Hessian (prior and data), its largest
eigenvalue per point; the geometry's part is how far the point moves when an angle or the table
is off by the stated prior, triangulated with the point's own rays (NUMERICAL: first differences).
"""

from __future__ import annotations

import numpy as np

from gcar_deploy.errors import NumericalError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.prior import LEFT_DEG, LEFT_MM
from gcar_deploy.tubes.arrow import Arrow
from gcar_deploy.types import Array, Points, Scalars

#: covariances are solved for every so many points and interpolated between.
EVERY = 5
#: model error (sections that are not round, overlaps) makes neighbouring pixels err together;
#: the pictures count as if they had so many times fewer independent pixels.
CORRELATED_PIXELS = 6.0
#: smallest eigenvalue of the normal matrix, relative to the largest, that counts as seen.
RELATIVE_CUT = 1e-6


def fit_sigma(hessian: Arrow, owner: Array, tangents: Points) -> Scalars:
    """(p,) largest standard deviation of each position across its vessel, mm.

    Along the vessel a point may slide without changing the tube, so that direction is left out.

    Parameters
    ----------
    hessian : Arrow over the (3 p + n) unknowns
    owner : (n,) position of each branch point, in order along the branches
    tangents : (p, 3) unit vector along the vessel at each position

    Raises
    ------
    NumericalError
        The matrix is not positive definite.
    """
    positions = len(tangents)
    if not positions:
        return np.zeros(0)
    factor = hessian.factorised()
    if factor is None:
        raise NumericalError("the normal matrix of the fit is not positive definite")
    chosen = np.unique(np.concatenate([owner[::EVERY], owner[-1:]]))
    own = factor.position_blocks(chosen)
    t = tangents[chosen]
    across = np.eye(3) - t[:, :, None] * t[:, None, :]
    own = across @ own @ across
    largest = np.linalg.eigvalsh(0.5 * (own + np.swapaxes(own, 1, 2)))[:, -1]
    sigma = np.sqrt(np.maximum(largest, 0.0) * CORRELATED_PIXELS)
    # Along the order of the branch points, every position is next to a solved one.
    place = np.flatnonzero(np.isin(owner, chosen))
    known = sigma[np.searchsorted(chosen, owner[place])]
    along = np.interp(np.arange(len(owner)), place, known)
    out = np.zeros(positions)
    out[owner] = along
    return out


def geometry_sigma(points_mm: Points, carms: list[CArm]) -> Scalars:
    """(n,) movement of triangulated points under the stated prior of the geometry, mm.

    Each view after the first may have its two angles off by ``LEFT_DEG`` and the table by
    ``LEFT_MM`` along each axis, independently.
    """
    if len(carms) < 2 or not len(points_mm):
        return np.zeros(len(points_mm))
    J = np.concatenate([carm.jacobian(points_mm) for carm in carms], axis=1)
    normal = np.swapaxes(J, 1, 2) @ J
    pinv = np.linalg.pinv(normal, rcond=RELATIVE_CUT, hermitian=True) @ np.swapaxes(J, 1, 2)
    total = np.zeros(len(points_mm))
    for v, carm in enumerate(carms[1:], start=1):
        base = carm.project(points_mm)[0]
        changed = [carm.moved(LEFT_MM * axis) for axis in np.eye(3)]
        changed += [
            carm.turned(primary_deg=LEFT_DEG),
            carm.turned(secondary_deg=LEFT_DEG),
        ]
        for other in changed:
            shift = np.nan_to_num(other.project(points_mm)[0] - base, posinf=0.0, neginf=0.0)
            total += np.sum(
                (pinv[:, :, 2 * v : 2 * v + 2] @ shift[:, :, None])[:, :, 0] ** 2, axis=1
            )
    return np.sqrt(total)

"""From confidences to a decision: every pixel explained once, vessels whole.

The network hedges where two places explain a pixel equally well: both get a little. The decision
minimises, by mean field with falling temperature,

    E(x) = - sum_i x_i logit_i                     what the network says
           - J sum_i x_i (min(sum_nbrs x, m) - m/2)  a vessel cell has vessel neighbours
           + sum_rays (sum_i w_i x_i - path)^2 / 2c  each ray's path is accounted for once

with one multiplier per ray for the last term (a relaxed entropic projection). Where the picture
is not calibrated, its paths are first scaled to what the network expects of the view as a whole,
and held more loosely.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import sparse
from scipy.special import expit, logit

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.predict.encoding import Encoded
from gcar_deploy.types import Array, Scalars

#: steps of the falling temperature, and its inverse reached at the last
STEPS, FINAL_SHARPNESS = 24, 3.0
#: J above, and m: how many of the 26 neighbours are support enough
COUPLING, ENOUGH_NEIGHBOURS = 1.0, 3.0
#: c above, how freely a ray may differ from its path length, cells squared per unit of evidence;
#: and more by this times the square of the paths' relative error
LOOSENESS, LOOSENESS_OF_ERROR = 0.5, 56.0


def decide(centers: CenterPoints, encoded: Encoded, path_error: float) -> CenterPoints:
    """Sharpen the confidences of ``centers``; points, order and count stay as they are.

    Parameters
    ----------
    centers : CenterPoints, one per candidate of ``encoded``
    encoded : Encoded
    path_error : float, relative error of the paths; 0 only where they are true mm in every view
    """
    evidence = logit(np.clip(centers.confidence, 1e-4, 1 - 1e-4))
    views = _Rays.of(encoded, centers.confidence, path_error)
    x = expit(evidence)
    neighbours = _adjacent(encoded.neighbours[0])
    for step in range(STEPS):
        share = step / (STEPS - 1)
        beta = 1.0 + (FINAL_SHARPNESS - 1.0) * share
        enough = np.minimum(neighbours @ x, ENOUGH_NEIGHBOURS) - 0.5 * ENOUGH_NEIGHBOURS
        field = beta * (evidence + COUPLING * enough)
        x = 0.5 * (x + views.project(field, beta))
    return dataclasses.replace(centers, confidence=x)


def _adjacent(neighbours: Array) -> sparse.csr_matrix:
    """(n, n) ones where two cells touch, from their (n, 27) rows with n for none."""
    n = len(neighbours)
    others = np.delete(neighbours, neighbours.shape[1] // 2, axis=1)
    some = others < n
    pointer = np.concatenate([[0], np.cumsum(some.sum(axis=1))])
    column = others[some]
    return sparse.csr_matrix((np.ones(len(column)), column, pointer), shape=(n, n))


@dataclasses.dataclass(eq=False)
class _Rays:
    """Rays of all views with their multipliers."""

    ray: Array
    path: list[Array]
    weight: Array
    pull: list[Array]
    looseness: float

    @staticmethod
    def of(encoded: Encoded, expected: Scalars, path_error: float) -> _Rays:
        path = []
        for ray, p, w in zip(encoded.ray, encoded.ray_path, encoded.weight, strict=True):
            # Padding rays behind no point have no say.
            seen = p[: int(ray.max()) + 1].astype(np.float64) if len(ray) else p[:0]
            if path_error > 0:
                seen = seen * np.clip((expected * w).sum() / max(seen.sum(), 1e-9), 0.25, 4.0)
            path.append(seen)
        loose = LOOSENESS + LOOSENESS_OF_ERROR * path_error**2
        weight = encoded.weight.astype(np.float64)
        return _Rays(encoded.ray, path, weight, [np.zeros(len(p)) for p in path], loose)

    def project(self, field: Scalars, beta: float) -> Scalars:
        """Occupancies for ``field`` after one Newton pass over each view's multipliers."""
        soft = self.looseness / beta
        total = field.copy()
        for ray, weight, pull in zip(self.ray, self.weight, self.pull, strict=True):
            total += pull[ray] * weight
        for ray, path, weight, pull in zip(
            self.ray, self.path, self.weight, self.pull, strict=True
        ):
            x = expit(total)
            made = np.bincount(ray, x * weight, len(path))
            slope = np.bincount(ray, x * (1 - x) * weight * weight, len(path)) + soft
            change = -np.clip((made - path + soft * pull) / slope, -1.5, 1.5)
            pull += change
            total += change[ray] * weight
        return expit(total)

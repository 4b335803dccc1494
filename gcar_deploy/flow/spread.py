"""How far diameters may be off, and trees drawn with such errors.

Every section states its own standard deviation s (``measure.sections``): small where two views show
the lumen alone, large where other vessels lie over it. On average a narrow core comes out too wide,
since it is smoothed over:

    sigma^2 = FLOOR^2 + (FACTOR s)^2,  mean = d - LOST n,  n = healthy - d.

Errors along a vessel go together. A part is common to a branch (calibration, threshold), the rest
changes over ``REACH_MM``. The first three are what ``gcar-export flow-table --fit`` finds most
likely on generated trees (apart from those that are reported); they belong to the present fit of
the lumen.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gcar_deploy.measure.lumen import BranchLumen
from gcar_deploy.tree.tree import Branch, Tree
from gcar_deploy.types import Array, Scalars

FLOOR_MM, FACTOR, LOST = 0.028, 1.067, 0.035
#: share of the diameter and mm, where no section states its own: a guess, and on the wide side
UNSTATED_SHARE, UNSTATED_MM = 0.05, 0.14
#: share of the variance that is common to a branch, and how far the rest reaches along it, mm
COMMON, REACH_MM = 0.3, 4.0
#: a diameter is known to a factor of this at worst; a wider spread says nothing more
_MOST_LOG = 0.5


def diameter_sigma_mm(branch: Branch, lumen: BranchLumen) -> Scalars:
    """(m,) standard deviation of the diameter at each point of a branch, mm."""
    stated = lumen.sections.sigma_mm
    unstated = np.hypot(UNSTATED_MM, UNSTATED_SHARE * 2.0 * branch.radius_mm)
    out: Scalars = np.where(np.isfinite(stated), np.hypot(FLOOR_MM, FACTOR * stated), unstated)
    return out


def narrowing_mm(branch: Branch, lumen: BranchLumen) -> Scalars:
    """(m,) how much narrower than its healthy diameter a branch is, mm; 0 where none is known."""
    out: Scalars = np.maximum(np.nan_to_num(lumen.healthy_mm - 2.0 * branch.radius_mm), 0.0)
    return out


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Draws:
    """Errors of the log diameter.

    Attributes
    ----------
    points : (samples, points) of each point of ``tree.points()``
    branches : (samples, branches) of each branch's calibre
    """

    points: Array
    branches: Array


def draw(
    tree: Tree, lumens: Sequence[BranchLumen], samples: int, rng: np.random.Generator
) -> Draws:
    """Draw trees as they may be.

    Parameters
    ----------
    tree : Tree with a branch
    lumens : of its branches, with a section at each point
    samples : how many
    """
    pairs = list(zip(tree.branches, lumens, strict=True))
    sigma_mm = np.concatenate([diameter_sigma_mm(*pair) for pair in pairs])
    lost = LOST * np.concatenate([narrowing_mm(*pair) for pair in pairs])
    owner = tree.branch_index()
    n = len(tree.branches)
    relative = np.minimum(sigma_mm / (2.0 * tree.radii()), _MOST_LOG)
    common = rng.standard_normal((samples, n))
    # A value every REACH_MM, a straight line between: neighbours go together, and draws are few.
    knot, share, count = [], [], 0
    for branch in tree.branches:
        at = branch.arc_mm / REACH_MM
        knot.append(count + np.floor(at).astype(int))
        share.append(at - np.floor(at))
        count += int(np.floor(at[-1])) + 2
    k, t = np.concatenate(knot), np.concatenate(share)
    own = rng.standard_normal((samples, count))
    # The mean of two values scatters less than either.
    local = (own[:, k] * (1 - t) + own[:, k + 1] * t) / np.sqrt((1 - t) ** 2 + t**2)
    z = np.sqrt(COMMON) * common[:, owner] + np.sqrt(1 - COMMON) * local
    centre = np.log1p(-np.minimum(lost / (2.0 * tree.radii()), _MOST_LOG))
    points = centre + z * relative
    of_branch = np.array([relative[owner == b].mean() for b in range(n)])
    return Draws(points=points, branches=np.sqrt(COMMON) * common * of_branch)

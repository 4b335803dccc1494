"""What speaks for and against each stretch of a tree: the figures that ghosts are known by.

A ghost is a piece of one vessel in one view married to a piece of another in the other view. Its
rays are explained without it, the predictor saw more on them elsewhere, and it hangs on little.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import logit

from gcar_deploy.geometry.epipolar import plane_normal
from gcar_deploy.predict import Evidence
from gcar_deploy.quality.shown import CELLS_OFF, CELLS_ON, Shown
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Mask, Scalars

#: branches are judged in stretches of at most this length, mm
STRETCH_MM = 8.0
#: figures of a stretch; ``least`` and ``most`` are over the views. Ghosts are whole branches, so
#: those named ``branch`` are means over the branch. That both views show one width tells nothing
#: beyond these on generated trees, nor does the residual
FIGURES = (
    "branch_network",  # log odds of the predictor's confidence at the centreline
    "branch_elsewhere_least",  # share of the rays' evidence that lies at other depths
    "elsewhere_most",
    "branch_seen_least",  # share of its path that the picture leaves to it beyond all others
    "seen_most",
    "branch_alone_least",  # share of its path on rays that nothing else of the tree crosses
    "unclaimed_least",  # share of the rays' evidence that lies off the tree
    "branch_length",  # logarithm, mm
    "loose_ends",  # of the branch
    "apart",  # share of the tree that it does not hang on
    "along_planes",  # how far it runs within the epipolar planes, 0 .. 1
    "exact",  # 1 of true path lengths
    "mask",  # 1 of masks
)
#: evidence nearer than so many cells is here
_HERE_CELLS = 3.0
#: a ray is a stretch's own where all others add less than this share of its path
_ALONE_SHARE = 0.3
_LEAST_ODDS = 0.01


@dataclasses.dataclass(frozen=True, eq=False)
class Stretches:
    """A tree cut into stretches, k of them.

    Attributes
    ----------
    point : (n,) stretch of each point of ``Tree.points()``
    segment : (s,) stretch of each segment of ``tubes_of``
    branch : (k,) branch of each stretch; stretches of a branch follow each other
    length_mm : (k,)
    """

    point: Array
    segment: Array
    branch: Array
    length_mm: Scalars

    def __len__(self) -> int:
        return len(self.branch)

    def mean(self, values: Scalars, of: Array | None = None) -> Scalars:
        """(k,) mean of (n,) values at points, or at what ``of`` gives the stretches of."""
        of = self.point if of is None else of
        total = np.bincount(of, values, minlength=len(self))
        out: Scalars = total / np.maximum(np.bincount(of, minlength=len(self)), 1)
        return out

    def of_branch(self, values: Scalars) -> Scalars:
        """(k,) mean over each stretch's branch of (k,) values."""
        whole = np.bincount(self.branch, values * self.length_mm)
        out: Scalars = (whole / np.bincount(self.branch, self.length_mm))[self.branch]
        return out


def stretches_of(tree: Tree) -> Stretches:
    """Cut every branch evenly."""
    points: list[Array] = []
    segments: list[Array] = []
    branches: list[int] = []
    lengths: list[float] = []
    first = 0
    for number, branch in enumerate(tree.branches):
        arc = branch.arc_mm
        whole = max(branch.length_mm, 1e-9)
        pieces = max(int(np.ceil(branch.length_mm / STRETCH_MM)), 1)
        for at, out in ((arc, points), (0.5 * (arc[1:] + arc[:-1]), segments)):
            piece = np.minimum((at / whole * pieces).astype(np.int64), pieces - 1)
            out.append(first + piece)
        branches += [number] * pieces
        lengths += [whole / pieces] * pieces
        first += pieces
    none = [np.zeros(0, np.int64)]
    return Stretches(
        point=np.concatenate(points or none),
        segment=np.concatenate(segments or none),
        branch=np.array(branches, np.int64),
        length_mm=np.array(lengths),
    )


def ghost_figures(shown: Shown, evidence: Evidence, stretches: Stretches) -> Array:
    """(k, figures) of each stretch, by the names of ``FIGURES``.

    Parameters
    ----------
    shown : a tree with a branch, two views or more, in the order and with the C-arms that its
        evidence was made with
    evidence : that evidence
    stretches : of the tree
    """
    tree, views = shown.tree, shown.views
    told = evidence.points
    # A plain tree of cells is built several times faster than a balanced one.
    search = cKDTree(told.points_mm, balanced_tree=False, compact_nodes=False)
    near = search.query(tree.points(), distance_upper_bound=2 * told.spacing_mm)[1]
    network = stretches.mean(np.append(told.confidence, 0.0)[near])
    network = logit(np.clip(network, _LEAST_ODDS, 1 - _LEAST_ODDS))
    elsewhere, unclaimed = _on_rays(shown, evidence, stretches)
    seen, alone = _in_pictures(shown, stretches)
    lengths = np.array([branch.length_mm for branch in tree.branches])
    component = tree.parts()
    hanging = np.bincount(component, lengths)[component] / lengths.sum()
    loose = [int((tree.degrees[[b.start, b.end]] == 1).sum()) for b in tree.branches]
    tangents = np.concatenate([branch.tangents for branch in tree.branches])
    across = np.abs(tangents @ plane_normal(views[0].carm, views[1].carm))
    ones = np.ones(len(stretches))
    columns = {
        "branch_network": stretches.of_branch(network),
        "branch_elsewhere_least": stretches.of_branch(elsewhere.min(axis=0)),
        "elsewhere_most": elsewhere.max(axis=0),
        "branch_seen_least": stretches.of_branch(seen.min(axis=0)),
        "seen_most": seen.max(axis=0),
        "branch_alone_least": stretches.of_branch(alone.min(axis=0)),
        "unclaimed_least": unclaimed.min(axis=0),
        "branch_length": np.log(np.maximum(lengths, 1e-9))[stretches.branch],
        "loose_ends": np.array(loose, np.float64)[stretches.branch],
        "apart": 1.0 - hanging[stretches.branch],
        "along_planes": 1.0 - stretches.mean(across),
        "exact": ones * all(view.calibrated for view in views),
        "mask": ones * any(view.kind == "mask" for view in views),
    }
    return np.stack([columns[name] for name in FIGURES], axis=1)


def _on_rays(shown: Shown, evidence: Evidence, stretches: Stretches) -> tuple[Array, Array]:
    """Share the evidence on a stretch's rays, (views, k): at other depths, and off the tree."""
    told, cell = evidence.points, evidence.points.spacing_mm
    gap, at = shown.gap
    on = np.flatnonzero(gap < CELLS_ON * cell)
    of, near = stretches.point[at[on]], _HERE_CELLS * cell + shown.tree.radii()[at[on]]
    elsewhere, unclaimed = [], []
    for view, ray, weight in zip(shown.views, evidence.ray, evidence.weight, strict=True):
        amount = told.confidence * weight
        depth = np.linalg.norm(told.points_mm - view.carm.source_mm, axis=1)
        whole = np.maximum(np.bincount(ray, amount), 1e-9)[ray[on]]
        here = _between(ray, depth, amount, on, near)
        off = np.bincount(ray, amount * (gap > CELLS_OFF * cell))[ray[on]]
        elsewhere.append(stretches.mean(1.0 - here / whole, of))
        unclaimed.append(stretches.mean(off / whole, of))
    return np.stack(elsewhere), np.stack(unclaimed)


def _between(ray: Array, depth: Scalars, amount: Scalars, on: Array, near: Scalars) -> Scalars:
    """Sum of the amounts on the ray of each cell ``on`` that lie within ``near`` of its depth."""
    # Rays one behind the other on a single axis, further apart than anything on them.
    apart = float(np.ptp(depth)) + 2.0 * float(near.max(initial=0.0)) + 1.0
    place = ray * apart + (depth - depth.min())
    order = np.argsort(place, kind="stable")
    total = np.concatenate([[0.0], np.cumsum(amount[order])])
    first, last = (np.searchsorted(place[order], place[on] + s * near) for s in (-1, 1))
    found: Scalars = total[last] - total[first]
    return found


def _in_pictures(shown: Shown, stretches: Stretches) -> tuple[Array, Array]:
    """Share a stretch's path, (views, k): what pictures leave to it, what lies on own rays."""
    seen: list[Scalars] = []
    alone: list[Scalars] = []
    for view, falls in zip(shown.views, shown.prints, strict=True):
        of = stretches.segment[falls.segment]
        total = falls.image(view.mask.shape).reshape(-1)
        data = view.path_mm.reshape(-1).astype(np.float64)
        if not view.calibrated:
            data = data * (float(total @ total) / max(float(total @ data), 1e-9))
        mine = _own_path(falls.pixel, of, falls.path_mm, stretches)
        rest = np.maximum(total[falls.pixel] - mine, 0.0)
        claim = np.clip(data[falls.pixel] - rest, 0.0, falls.path_mm)
        single: Mask = rest < _ALONE_SHARE * mine
        claimed = np.maximum(np.bincount(of, falls.path_mm, minlength=len(stretches)), 1e-9)
        for part, out in ((claim, seen), (falls.path_mm * single, alone)):
            out.append(np.bincount(of, part, minlength=len(stretches)) / claimed)
    return np.stack(seen), np.stack(alone)


def _own_path(pixel: Array, of: Array, path: Scalars, stretches: Stretches) -> Scalars:
    """(e,) path in an entry's pixel of its stretch and the neighbours along the branch."""
    # Stretches of a branch are numbered one after the other; two more for those beyond the ends.
    wide = len(stretches) + 2
    key = pixel.astype(np.int64) * wide + of + 1
    known, entry = np.unique(key, return_inverse=True)
    total: Scalars = np.bincount(entry, path).astype(np.float64)
    out: Scalars = total[entry]
    for step in (-1, 1):
        beside = np.clip(of + step, 0, len(stretches) - 1)
        same = (stretches.branch[beside] == stretches.branch[of]) & (beside != of)
        at = np.minimum(np.searchsorted(known, key + step), len(known) - 1)
        out = out + np.where(same & (known[at] == key + step), total[at], 0.0)
    return out

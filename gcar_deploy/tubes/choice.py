"""Choose among candidate vessel pieces: those that together explain every view once.

Two views leave ghosts: a piece of one vessel in view 1 married to a piece of another in view 2.
A ghost's rays are explained without it, so with every piece as thick as the pictures would allow
if it were alone, the shares a of

    min over 0 <= a <= 1 of  0.5 sum_pixels ((path - sum_k a_k path_k) / sigma)^2 area + cost . a

go to 0 for ghosts and to 1 for vessels. The cost per mm grows as the starting points' confidence
falls (and is a reward where it is high): evidence decides where the pictures leave two ways open.

Where paths are estimates, a drop that tears a tree apart must be worth it (``wanted_parts``).
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import scipy  # its optimize is imported where it is first used: most runs never need it
from scipy import ndimage, sparse

from gcar_deploy.tree.edit import kept_branches, part_of
from gcar_deploy.tree.tree import Branch, Tree
from gcar_deploy.tubes.model import Tubes, footprint, tubes_of
from gcar_deploy.tubes.shares import best_shares
from gcar_deploy.tubes.support import least_seen
from gcar_deploy.tubes.targets import Target, exact_paths
from gcar_deploy.types import Array, Points, Scalars

#: branches are judged in pieces of at most this length, mm
PIECE_MM = 100.0
#: where paths are estimates, a part of the tree that hangs on no other must be worth so many mm,
#: each weighed by its share less ``MIN_SHARE``; on generated trees 8 and 15 choose alike
PART_MM = 8.0
#: cost of a mm of piece per confidence below ``FAIR_CONFIDENCE``, units of the objective
PIECE_COST = 20.0
FAIR_CONFIDENCE = 0.4
#: a piece is wanted whatever the pictures say whose confidence is at least this share of the kept
#: ones' median; where paths are estimates, a part that hangs on no other must still be worth
#: ``PART_MM``
TRUSTED_SHARE = 0.8
#: a piece standing alone is at most so many times as thick as the starting points say
PIECE_GROWTH = 2.5
#: a piece is kept from this share on; a dropped one comes back where every view misses at least
#: ``MISSED_SHARE`` of it
MIN_SHARE, MISSED_SHARE = 0.5, 0.45
#: a share this near to ``MIN_SHARE`` is a near-tie: told, since small errors decide it
TIE = 0.05
#: least sine between vessel and ray when a path is turned into a radius.
MIN_SINE = 0.35
#: radii believed when a piece stands alone, mm.
ALONE_BOUNDS_MM = (0.3, 3.5)


@dataclasses.dataclass(frozen=True, eq=False)
class Pieces:
    """Stretches of branches that are kept or dropped as one.

    Attributes
    ----------
    segment : (s,) piece of each segment
    length_mm, confidence : (k,)
    share : (k,) 0 .. 1, how much of it the pictures want
    tie : (k,) whether that was a near-tie
    """

    segment: Array
    length_mm: Scalars
    confidence: Scalars
    share: Scalars
    tie: Array


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class CloseCall:
    """A piece of vessel that was kept or dropped by a hair.

    Attributes
    ----------
    middle_mm : (3,) its middle, mm LPS
    length_mm : float
    kept : bool
    """

    middle_mm: Points
    length_mm: float
    kept: bool


def close_calls(tree: Tree, pieces: Pieces) -> tuple[CloseCall, ...]:
    """Return the near-ties among the pieces of a tree, in the order of its branches."""
    tubes = tubes_of(tree)
    out = []
    for k in np.flatnonzero(pieces.tie):
        own = np.flatnonzero(pieces.segment == k)
        middle = tubes.points_mm[tubes.first[own[len(own) // 2]]]
        kept = bool(pieces.share[k] >= MIN_SHARE)
        out.append(CloseCall(middle_mm=middle, length_mm=float(pieces.length_mm[k]), kept=kept))
    return tuple(out)


def kept_tree(tree: Tree, pieces: Pieces) -> Tree:
    """Rebuild the tree from the wanted pieces; where a branch is cut, new free ends appear."""
    tubes = tubes_of(tree)
    branches: list[Branch] = []
    nodes = list(tree.nodes_mm)
    for k, branch in enumerate(tree.branches):
        own = np.flatnonzero(tubes.branch == k)
        wanted = pieces.share[pieces.segment[own]] >= MIN_SHARE
        edges = np.flatnonzero(np.diff(np.concatenate([[0], wanted.astype(int), [0]])))
        for first, stop in edges.reshape(-1, 2):
            part = part_of(branch, int(first), int(stop))
            start, end = branch.start, branch.end
            if first > 0:
                start = len(nodes)
                nodes.append(part.points_mm[0])
            if stop < len(own):
                end = len(nodes)
                nodes.append(part.points_mm[-1])
            branches.append(dataclasses.replace(part, start=start, end=end))
    cut = Tree(nodes_mm=np.array(nodes), branches=tuple(branches))
    return kept_branches(cut, np.ones(len(branches), bool))


def reinstated(
    tree: Tree,
    pieces: Pieces,
    start_radius: Scalars,
    targets: list[Target],
    left: list[Array],
) -> Pieces:
    """Take back dropped pieces that the views miss after all (``least_seen``).

    Vessels that overlap each other in all views seem too thick alone, and the shares may call
    one of them a ghost; once the others are fitted without it, its path is missing.

    Parameters
    ----------
    tree : Tree before any piece was dropped
    pieces : Pieces of it
    start_radius : (n,) radius of its branch points by the starting points, mm
    targets : one per view
    left : per view (rows, cols), path that the kept pieces leave unexplained, mm
    """
    tubes, radius = tubes_of(tree), start_radius
    if exact_paths(targets):
        # The points know no stenosis: a narrow vessel shows too small a share of so wide a path.
        # Where paths are estimates they run low, and a ghost as narrow as they say comes back.
        radius = np.minimum(radius, radius_alone(tubes, targets))
    tubes = dataclasses.replace(tubes, log_radius=np.log(radius))
    dropped = pieces.share < MIN_SHARE
    count = len(pieces.share)
    found = []
    for target, rest in zip(targets, left, strict=True):
        seen = footprint(tubes, target.carm, target.box_px)
        piece = pieces.segment[seen.segment]
        claim = np.minimum(rest.reshape(-1)[seen.pixel], seen.path_mm)
        whole = np.bincount(piece, seen.path_mm, minlength=count)
        found.append(np.bincount(piece, claim, minlength=count) / np.maximum(whole, 1e-9))
    missed = dropped & (least_seen(np.stack(found)) >= MISSED_SHARE)
    return dataclasses.replace(pieces, share=np.where(missed, 1.0, pieces.share))


def weigh_pieces(
    tree: Tree,
    tubes: Tubes,
    start_radius: Scalars,
    targets: list[Target],
) -> Pieces:
    """Cut the branches into pieces and solve for their shares."""
    segment, joints = _cut(tree, tubes, PIECE_MM)
    count = len(joints)
    points = tubes.points_mm
    length = np.linalg.norm(points[tubes.second] - points[tubes.first], axis=1)
    total: Scalars = np.bincount(segment, length, minlength=count).astype(np.float64)
    trust = np.concatenate([branch.confidence for branch in tree.branches])
    own = 0.5 * (trust[tubes.first] + trust[tubes.second])
    confidence: Scalars = np.bincount(segment, own * length, minlength=count) / np.maximum(
        total, 1e-9
    )
    # Vessels that overlap each other in every view would all seem thick: the points say less.
    radius = np.minimum(radius_alone(tubes, targets), PIECE_GROWTH * start_radius)
    alone = dataclasses.replace(tubes, log_radius=np.log(radius))
    gram, pull = _normal(alone, segment, count, targets)
    cost = PIECE_COST * total * (FAIR_CONFIDENCE - confidence)
    share = best_shares(gram, pull - cost, confidence)
    tie = np.abs(share - MIN_SHARE) < TIE
    kept = share >= MIN_SHARE
    if kept.any():
        # The level of confidence depends on the predictor; ghosts stand out below its usual.
        usual = _weighted_median(confidence[kept], total[kept])
        trusted = confidence >= TRUSTED_SHARE * usual
        share, tie = np.where(trusted, 1.0, share), tie & ~trusted
    if not exact_paths(targets):
        share = wanted_parts((share - MIN_SHARE) * total, joints, PART_MM).astype(np.float64)
    return Pieces(segment, total, confidence, share, tie)


def wanted_parts(gain: Scalars, joints: Array, part_cost: float) -> Array:
    """Choose the pieces of greatest gain, less a price for every connected part of the choice.

    In a forest the parts are the joints in use less the pieces kept. So each piece earns its gain
    and the price back, each joint in use costs the price once: a closure problem, whose linear
    programme has a solution in whole numbers (Picard 1976).

    Parameters
    ----------
    gain : (k,) of keeping each piece, below 0 where it is not wanted
    joints : (k, 2) int, what each piece's ends hang on; the graph has no loops
    part_cost : price of a part, in the unit of the gain

    Returns
    -------
    (k,) bool, kept
    """
    count = len(gain)
    used, end = np.unique(joints, return_inverse=True)
    # A piece is kept only with both its joints: piece - joint <= 0.
    needs = sparse.hstack(
        [
            sparse.csr_matrix(np.repeat(np.eye(count), 2, axis=0)),
            sparse.csr_matrix((-np.ones(2 * count), (np.arange(2 * count), end.reshape(-1)))),
        ]
    )
    found = scipy.optimize.linprog(
        np.concatenate([-(gain + part_cost), np.full(len(used), part_cost)]),
        A_ub=needs, b_ub=np.zeros(2 * count), bounds=(0, 1), method="highs",
    )  # fmt: skip
    kept: Array = found.x[:count] > 0.5
    return kept


def radius_alone(tubes: Tubes, targets: list[Target]) -> Scalars:
    """(n,) radius each point could have if no other vessel lay on its rays: least over views."""
    out = np.full(len(tubes.log_radius), np.inf)
    points = tubes.points_mm
    tangent = np.zeros_like(points)
    step = points[tubes.second] - points[tubes.first]
    np.add.at(tangent, tubes.first, step)
    np.add.at(tangent, tubes.second, step)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    for target in targets:
        pixels, _ = target.carm.project(points)
        ray = points - target.carm.source_mm
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        sine = np.maximum(np.linalg.norm(np.cross(tangent, ray), axis=1), MIN_SINE)
        # The blurred picture's ridge: the highest value within about a pixel.
        ridge = ndimage.maximum_filter(target.path_mm / target.contrast, size=3)
        at = [np.nan_to_num(pixels[:, 1], nan=-9.0), np.nan_to_num(pixels[:, 0], nan=-9.0)]
        path = ndimage.map_coordinates(ridge, at, order=1, mode="constant", cval=0.0)
        out = np.minimum(out, 0.5 * sine * path)
    smooth = np.empty_like(out)
    for k in range(int(tubes.point_branch.max()) + 1):
        part = tubes.point_branch == k
        smooth[part] = ndimage.median_filter(out[part], size=7, mode="nearest")
    return np.clip(smooth, *ALONE_BOUNDS_MM)


def _cut(tree: Tree, tubes: Tubes, piece_mm: float) -> tuple[Array, Array]:
    """Piece of each segment (s,), and the joints (k, 2) that the pieces' ends hang on."""
    out = np.zeros(len(tubes.first), np.int64)
    joints: list[tuple[int, int]] = []
    new = len(tree.nodes_mm)
    for k, branch in enumerate(tree.branches):
        own = tubes.branch == k
        middle = 0.5 * (branch.arc_mm[1:] + branch.arc_mm[:-1])
        pieces = max(int(np.ceil(branch.length_mm / piece_mm)), 1)
        share = middle / max(branch.length_mm, 1e-9)
        out[own] = len(joints) + np.minimum((share * pieces).astype(np.int64), pieces - 1)
        joints += itertools.pairwise([branch.start, *range(new, new + pieces - 1), branch.end])
        new += pieces - 1
    return out, np.array(joints)


def _normal(tubes: Tubes, piece: Array, count: int, targets: list[Target]) -> tuple[Array, Scalars]:
    """Gram matrix (k, k) of the pieces' pictures and their products with the data (k,)."""
    gram = np.zeros((count, count))
    pull = np.zeros(count)
    for target in targets:
        seen = footprint(tubes, target.carm, target.box_px)
        size = target.path_mm.size
        weight = (target.weight / target.sigma_mm**2).reshape(-1) * target.pixel_mm**2
        U = sparse.csr_matrix(
            (seen.path_mm * target.contrast, (seen.pixel, piece[seen.segment])),
            shape=(size, count),
        )
        WU = sparse.diags(weight) @ U
        gram += np.asarray((U.T @ WU).todense())
        pull += WU.T @ target.path_mm.reshape(-1)
    return gram, pull


def _weighted_median(values: Scalars, weight: Scalars) -> float:
    order = np.argsort(values, kind="stable")
    part = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(part, 0.5 * part[-1])])

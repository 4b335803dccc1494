"""Other trees that explain both pictures, from the pictures' lines, and the best of all.

Starting points are chosen place by place; where the predictor is in doubt, that makes trees that
no small change mends. Trees of ways through the pairs of both views' lines are wrong elsewhere.
From the best of them on, each place where another tree differs is tried with its word. Of true
paths the tree that was found may be the best; of masks, whose objective tells less, it is no start.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.tree.combine import Difference, Net, combined, differences
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.exchange import costs
from gcar_deploy.tubes.line_pairs import LinePairs, line_pairs
from gcar_deploy.tubes.proposal import Told
from gcar_deploy.tubes.run import Run, Trial
from gcar_deploy.tubes.targets import Target, exact_paths, true_mm
from gcar_deploy.tubes.ways import Trust, tree_of_ways
from gcar_deploy.types import Array, Points, Scalars

#: how far ways trust the predictor and the widths: the first makes the best trees, each of the
#: others is wrong elsewhere
TRUSTS = (Trust(5.0, 1.0), Trust(2.0, 1.0), Trust(10.0, 0.5), Trust(4.0, 2.0))
#: a difference is tried where so large a share of the objective is left beside it, mm at the
#: isocentre; kept is what lowers the objective by so much, and by so much for each mm of tree
DOUBTED, BESIDE_MM = 0.04, 1.0
BETTER, PER_MM = 0.005, 0.05
#: a trial whose objective is so many times as large after its first steps is given up
HOPELESS = 1.5
#: nothing is made of ways where the first tree of them leaves so many times as much: on generated
#: pairs that were right already most do; of true paths, and of masks
FAR_EXACT, FAR = 4.0, 1.7
#: so many trials at most
MOST_TRIALS = 100


@dataclasses.dataclass(frozen=True, eq=False)
class Ways:
    """What trees of ways are made of, and the first of them.

    Attributes
    ----------
    pairs : LinePairs
    told : (n,) what the predictor said of each pair's point
    first : Tree
    """

    pairs: LinePairs
    told: Scalars
    first: Tree


def ways_beside(
    tree: Tree, views: Sequence[VesselImage], targets: Sequence[Target], told: Told
) -> Ways | None:
    """Make a tree of ways; None where it does not differ, or the pictures say too little.

    Parameters
    ----------
    tree : Tree that was found
    views, targets : one each; only two are paired, and only where paths or widths are true mm:
        what raw pictures leave unexplained tells too little
    told : Told
    """
    pairs = line_pairs(views) if true_mm(targets) and len(views) == 2 else None
    if pairs is None:
        return None
    said = told.at(pairs.points_mm)
    first = tree_of_ways(pairs, said, TRUSTS[0])
    if not first.branches:
        return None
    differ = differences(Net.of(tree), Net.of(first), [view.carm for view in views])
    return Ways(pairs, said, first) if differ else None


def relinked(now: Trial, ways: Ways, targets: list[Target], run: Run) -> Trial:
    """Try trees of ways, and what is best of each.

    Parameters
    ----------
    now : Trial, the tree that was found, fitted to these targets
    ways : Ways beside it
    targets : two
    run : Run

    Returns
    -------
    Trial of a better tree, or ``now``
    """
    if not _asked(now, Net.of(now.tree), Net.of(ways.first), targets, run):
        return now
    exact = exact_paths(targets)
    far = (FAR_EXACT if exact else FAR) * now.loss
    tried = [run.tried(ways.first, targets, far)]
    if tried[0].loss > far:
        return now
    trees = [tree_of_ways(ways.pairs, ways.told, trust) for trust in TRUSTS[1:]]
    tried += [run.tried(tree, targets) for tree in trees if tree.branches]
    if run.progress.stopped:
        return now
    tried.sort(key=lambda one: one.loss)
    if exact and now.loss <= tried[0].loss:
        best, others = now, tried
    else:
        best, *others = tried
        others = [now, *others]
    found = _with_the_best_of([one.tree for one in others], best, targets, run)
    return found if _better(found, now) else now


def _with_the_best_of(trees: Sequence[Tree], now: Trial, targets: list[Target], run: Run) -> Trial:
    """Take other trees' word, one difference after the other, where that explains more."""
    left = MOST_TRIALS
    for tree in trees:
        net = Net.of(tree)
        before: Trial | None = None
        while before is not now and left and not run.progress.stopped:
            before, own = now, Net.of(now.tree)
            for where in _asked(now, own, net, targets, run)[:left]:
                left -= 1
                trial = run.tried(combined(own, net, where), targets, HOPELESS * now.loss)
                if _better(trial, now) and not run.progress.stopped:
                    now = trial
                    break
    return now


def _better(one: Trial, other: Trial) -> bool:
    if not one.tree.branches:
        return False
    price = PER_MM * (one.tree.length_mm - other.tree.length_mm)
    return one.loss + price < (1 - BETTER) * other.loss


def _asked(now: Trial, own: Net, other: Net, targets: list[Target], run: Run) -> list[Difference]:
    """Return the differences beside which the pictures are explained badly, the worst first."""
    pictures = [left for left, _ in costs(targets, now.state.prints, run.options)]
    found = []
    for where in differences(own, other, [target.carm for target in targets]):
        lines = np.concatenate([own.points_mm[where.old], other.points_mm[where.new]])
        left = sum(_beside(*seen, lines) for seen in zip(targets, pictures, strict=True))
        if left > DOUBTED * now.loss:
            found.append((left, where))
    return [where for _, where in sorted(found, key=lambda pair: -pair[0])]


def _beside(target: Target, picture: Array, points: Points) -> float:
    """Sum a picture up to ``BESIDE_MM`` from (n, 3) points."""
    near = np.zeros(picture.shape, np.uint8)
    col, row = np.rint(target.carm.project(points)[0]).T
    inside = (col >= 0) & (col < picture.shape[1]) & (row >= 0) & (row < picture.shape[0])
    near[row[inside].astype(np.int64), col[inside].astype(np.int64)] = 1
    wide = 2 * max(round(BESIDE_MM / target.pixel_mm), 1) + 1
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (wide, wide))
    return float(picture[cv2.dilate(near, around) > 0].sum())

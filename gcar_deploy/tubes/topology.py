"""Which vessels hang where: lines that no tube explains, and parts that hang on nothing.

Two views leave open which line of one is which of the other: a wrong choice explains both pictures
nearly as well, but its vessel then seldom meets the tree that it leaves in both. So parts of the
tree that hang on nothing are given up on trial, and their lines proposed anew, each from the tree.
Where the paths or the widths are true mm, trees of the pictures' lines are tried beside the one
found before that (``relink``), and vessels that cross in a picture change partners on trial.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.tree.edit import kept_branches
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.exchange import TrialExchange, cost_beside, costs, trial_exchanges
from gcar_deploy.tubes.gauss_newton import empty_objective, rescaled
from gcar_deploy.tubes.missed import Look, MissedLine, looked_at, missed_lines
from gcar_deploy.tubes.model import Shown
from gcar_deploy.tubes.proposal import Told, proposal
from gcar_deploy.tubes.relink import relinked, ways_beside
from gcar_deploy.tubes.run import Run, State, Trial, coarsest_pixel_mm
from gcar_deploy.tubes.targets import Target, exact_paths, make_targets, trial_views, true_mm
from gcar_deploy.types import Points

#: a vessel that was missed is kept where it lowers the objective by this share ...
EARNED = 0.005
#: ... and, where paths are estimates and a line may be background, by so much per mm of it
EARNED_PER_MM = 0.3
#: parts that hang on nothing are asked for from so many mm on; where paths are estimates, each mm
#: of them costs as much of the objective. On generated pairs 0.1 to 0.2 choose alike
LEAST_LOOSE_MM, LOOSE_PER_MM = 8.0, 0.2
#: what explains a larger share of what the whole tree does is not proposed anew, which takes long:
#: on generated pairs of two seeds nothing won by it that explained more than a third
MOST_GIVEN_UP = 0.5
#: vessels change partners that make up this share of the objective, and of whose path so much is
#: unexplained: in true paths, and in masks, whose edges leave more; kept is what lowers the
#: objective by so much
DOUBTED: Mapping[Shown, float] = {"path": 0.09, "width": 0.16}
UNEXPLAINED: Mapping[Shown, float] = {"path": 0.035, "width": 0.05}
BETTER = 0.03
#: a trial whose objective is so many times as large at once is given up, and what it tore off is
#: not proposed anew where it is still so many times as large with the lines that no tube explained;
#: so many others in vain are the last. Nearly all that won on generated pairs are within all three
HOPELESS, TORN, MOST_IN_VAIN = 1.5, 1.2, 3
#: ... and after the first of its steps, which gains the most, so many times as much
FIRST_STEP = 1.2
#: wider pixels say too little of a thin vessel's mass: of ten real trees seen at 1.4 mm none gained
MOST_PIXEL_MM = 0.8
#: a tree whose vessels were exchanged must not hang on less: price of a mm of the objective
TORN_PER_MM = 1e3
#: a part of one tree is that of another whose points lie so near, mm
SAME_MM = 1.0


def settled_topology(
    now: State, views: Sequence[VesselImage], targets: list[Target], run: Run
) -> State:
    """Add what was missed, then hang on the tree what hangs on nothing, where the pictures allow.

    Parameters
    ----------
    now : State at the last level
    views, targets : one each per view
    run : Run; its progress follows what is taken. Without evidence nothing is done
    """
    if run.evidence is None or len(views) < 2:
        return now
    told, own, coarse = Told.by(run.evidence), targets, trial_views(views)
    ways = ways_beside(now.tree, coarse, targets, told)
    whole = loose_mm(now.tree) < LEAST_LOOSE_MM and not _lines(now, views, targets)[1]
    if ways is None and whole and not _doubted(now, run.progress.losses[-1], targets, run):
        return now
    if coarse is not views:
        views, targets = coarse, make_targets(coarse, 0.0, run.options)
    # What has to be beaten has had as many steps, from as near a start.
    best = given = run.tried(now.tree, targets)
    if ways is not None:
        best = relinked(given, ways, targets, run)
    if best is not given or not whole:
        best = _hung(_with_missed(best, views, targets, run, told), views, targets, run, told)
    best = _with_partners(best, views, targets, run, told)
    if best is given:
        return now
    if targets is not own:
        best = run.tried(best.tree, own)
    run.progress.follow(best.progress)
    return best.state


def _with_partners(
    now: Trial, views: Sequence[VesselImage], targets: list[Target], run: Run, told: Told
) -> Trial:
    """Let vessels that cross in a picture change partners where that explains all much better."""
    before: Trial | None = None
    while before is not now and not run.progress.stopped:
        before, left = now, MOST_IN_VAIN
        most, likely = HOPELESS * now.loss, TORN * now.loss
        enough, whole = (1 - BETTER) * now.loss, loose_mm(now.tree) + LEAST_LOOSE_MM
        for one in _doubted(now.state, now.loss, targets, run):
            if not left:
                break
            other = run.tried(one.applied(now.tree), targets, FIRST_STEP * most)
            if other.loss <= most:
                left -= 1
                other = _with_missed(other, views, targets, run, told)
            if other.loss < likely and (other.loss > enough or loose_mm(other.tree) > whole):
                other = _hung(other, views, targets, run, told, now.tree)
            if run.progress.stopped:
                break
            if other.loss < enough and loose_mm(other.tree) <= whole:
                now = other
                break
    return now


def _doubted(now: State, loss: float, targets: list[Target], run: Run) -> list[TrialExchange]:
    """Return the exchanges that stand to gain, those of the worst explained stretches first."""
    if len(targets) != 2 or not true_mm(targets) or coarsest_pixel_mm(targets) > MOST_PIXEL_MM:
        return []
    by: Shown = "path" if exact_paths(targets) else "width"
    found = trial_exchanges(now.tree, [target.carm for target in targets])
    if not found:
        return []
    pictures, asked = costs(targets, now.prints, run.options), []
    for one in found:
        left, empty = cost_beside([k.line(now.tree) for k in one.stretches], targets, pictures)
        if left > max(DOUBTED[by] * loss, UNEXPLAINED[by] * empty):
            asked.append((left, one))
    return [one for _, one in sorted(asked, key=lambda pair: -pair[0])]


def _with_missed(
    now: Trial, views: Sequence[VesselImage], targets: list[Target], run: Run, told: Told
) -> Trial:
    """Add the lines that no tube explains, the likeliest first, each where it earns its place."""
    before: Trial | None = None
    refused: list[Points] = []
    while before is not now and not run.progress.stopped:
        before = now
        now = _with_some(now, views, targets, run, told, refused)
    return now


def _with_some(
    now: Trial,
    views: Sequence[VesselImage],
    targets: list[Target],
    run: Run,
    told: Told,
    refused: list[Points],
) -> Trial:
    """Ask each line that no tube explains once, the likeliest first.

    ``refused`` holds the courses of what the tree as it is gained nothing by.
    """
    looks, lines = _lines(now.state, views, targets)
    found = ((number, proposal(line, looks, now.tree, told)) for number, line in enumerate(lines))
    # Equal costs in the order of the lines.
    asked = [(one.cost, number, one, now) for number, one in found if one is not None]
    heapq.heapify(asked)
    while asked:
        _, number, one, of = heapq.heappop(asked)
        if of is not now:
            # The tree has grown: this may be explained by now, or no more the likeliest.
            again = proposal(lines[number], looks, now.tree, told)
            if again is None:
                continue
            if asked and asked[0][0] < again.cost:
                heapq.heappush(asked, (again.cost, number, again, now))
                continue
            one = again
        if any(np.array_equal(one.points_mm, course) for course in refused):
            continue
        trial = run.tried(one.added(now.tree), targets)
        if run.progress.stopped:
            break
        price = EARNED * now.loss
        if not exact_paths(targets):
            price = max(price, EARNED_PER_MM * (trial.tree.length_mm - now.tree.length_mm))
        if trial.loss < now.loss - price:
            now = trial
            looks = _looks(now.state, views, targets)
            refused.clear()
        else:
            refused.append(one.points_mm)
    return now


def _lines(
    now: State, views: Sequence[VesselImage], targets: list[Target]
) -> tuple[list[Look], list[MissedLine]]:
    """Compare pictures with tubes, and return the lines that none explains."""
    looks = _looks(now, views, targets)
    return looks, missed_lines(looks)


def _looks(now: State, views: Sequence[VesselImage], targets: list[Target]) -> list[Look]:
    return looked_at(views, rescaled(targets, now.prints), now.prints)


def _hung(
    given: Trial,
    views: Sequence[VesselImage],
    targets: list[Target],
    run: Run,
    told: Told,
    known: Tree | None = None,
) -> Trial:
    """Propose anew what hangs on nothing; ``given`` where that explains the pictures less well.

    What hangs on nothing in ``known`` stays.
    """
    if run.progress.stopped or loose_mm(given.tree) < LEAST_LOOSE_MM:
        return given
    left = _hanging(given.tree, known)
    if len(left.branches) == len(given.tree.branches):
        return given
    hanging = run.tried(left, targets)
    explained = empty_objective(targets, run.options) - given.loss
    if hanging.loss - given.loss > MOST_GIVEN_UP * explained:
        return given
    other = _with_missed(hanging, views, targets, run, told)
    if run.progress.stopped:
        return given
    price = 0.0 if exact_paths(targets) else LOOSE_PER_MM
    if known is not None:
        price = TORN_PER_MM
    values = [one.loss + price * loose_mm(one.tree) for one in (given, other)]
    return other if values[1] < values[0] else given


def loose_mm(tree: Tree) -> float:
    """Length of all parts of a tree but the longest, mm."""
    lengths = tree.part_lengths_mm()
    return float(lengths.sum() - lengths.max(initial=0.0))


def _hanging(tree: Tree, known: Tree | None = None) -> Tree:
    """Return the tree without its parts of some length that do not hang on the longest one.

    Where ``known`` has such a part at the same place, it stays.
    """
    part, lengths = tree.parts(), tree.part_lengths_mm()
    kept = (lengths < LEAST_LOOSE_MM) | (np.arange(len(lengths)) == lengths.argmax())
    if known is not None and loose_mm(known) > 0:
        loose = known.parts() != known.part_lengths_mm().argmax()
        gap, _ = cKDTree(known.points()[loose[known.branch_index()]]).query(tree.points())
        of = part[tree.branch_index()]
        kept |= np.array([np.median(gap[of == k]) < SAME_MM for k in range(len(lengths))])
    return kept_branches(tree, kept[part])

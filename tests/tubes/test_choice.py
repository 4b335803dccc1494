"""Which pieces stay: the pictures' wish against a tree in parts."""

import dataclasses
import itertools

import numpy as np
import pytest

from gcar_deploy.config import TubeOptions
from gcar_deploy.tubes import choice
from gcar_deploy.tubes.choice import _cut, wanted_parts
from gcar_deploy.tubes.model import tubes_of
from gcar_deploy.tubes.targets import make_targets
from tests.tree.shapes import fork
from tests.tubes.scenes import seen, two_views


def chain(count):
    return np.array(list(itertools.pairwise(range(count + 1))))


@pytest.mark.parametrize(
    ("gain", "price", "kept"),
    [
        ((10, -5, 10), 8, (1, 1, 1)),  # leaving out the middle saves 5 and costs a part
        ((10, -9, 10), 8, (1, 0, 1)),
        ((10, -5, 10), 0, (1, 0, 1)),
        ((10, -5, 4), 8, (1, 0, 0)),  # too little beyond to be reached, or to stand alone
        ((10, -3, 4), 8, (1, 1, 1)),
        ((-1, 10, -1), 8, (0, 1, 0)),  # ends that nobody wants tear nothing apart
        ((7, -20, 9), 8, (0, 0, 1)),
        ((-1, -2, -3), 8, (0, 0, 0)),
    ],
)
def test_pieces_in_a_row(gain, price, kept):
    np.testing.assert_array_equal(wanted_parts(np.array(gain, float), chain(3), price), kept)


@pytest.mark.parametrize("seed", range(20))
def test_no_other_choice_is_better(seed):
    """Every choice of nine pieces of a random tree, its parts counted by walking."""
    rng = np.random.default_rng(seed)
    joints = np.array([[int(rng.integers(0, k)), k] for k in range(1, 10)]) * 7 + 3
    gain, price = rng.normal(size=9) * 10, rng.uniform(0, 15)

    def worth(kept):
        label = {j: j for j in joints[kept].ravel().tolist()}
        for _ in range(10):
            for a, b in joints[kept].tolist():
                label[a] = label[b] = min(label[a], label[b])
        return gain[kept].sum() - price * len(set(label.values()))

    best = max(worth(np.array(kept, bool)) for kept in itertools.product((0, 1), repeat=9))
    assert worth(wanted_parts(gain, joints, price)) == pytest.approx(best, abs=1e-9)


def cut_in_three():
    """A fork whose trunk (its longest branch) is cut into three pieces; (tree, trunk, edge)."""
    tree = fork()
    trunk = int(np.argmax([branch.length_mm for branch in tree.branches]))
    return tree, trunk, tree.branches[trunk].length_mm / 2.9


def test_pieces_hang_on_the_nodes_of_the_tree():
    tree, _, edge = cut_in_three()
    _, joints = _cut(tree, tubes_of(tree), edge)
    first = 0
    for branch in tree.branches:
        own = joints[first : first + int(np.ceil(branch.length_mm / edge))]
        first += len(own)
        assert (own[0, 0], own[-1, 1]) == (branch.start, branch.end)
        np.testing.assert_array_equal(own[1:, 0], own[:-1, 1])
    # A tree of pieces: one joint more than pieces.
    assert len(np.unique(joints)) == len(joints) + 1 == first + 1


@pytest.mark.parametrize(
    ("calibrated", "place", "share", "lost"),
    [
        (True, 1, 0.45, 1),
        (False, 1, 0.45, 0),  # between sure ones
        (False, 1, 0.0, 1),  # too little for that
        (False, 0, 0.45, 1),  # a free end
    ],
)
def test_a_faint_piece_stays_where_paths_are_estimates_and_others_hang_on_it(
    monkeypatch, calibrated, place, share, lost
):
    tree, trunk, edge = cut_in_three()
    tubes = tubes_of(tree)
    first = sum(int(np.ceil(b.length_mm / edge)) for b in tree.branches[:trunk])
    order = (0, 1, 2) if tree.degrees[tree.branches[trunk].start] == 1 else (2, 1, 0)

    def solved(gram, pull, start):
        out = np.ones(len(pull))
        out[first + order[place]] = share
        return out

    monkeypatch.setattr(choice, "PIECE_MM", edge)
    monkeypatch.setattr(choice, "TRUSTED_SHARE", 9.0)
    monkeypatch.setattr(choice, "PART_MM", 0.2 * edge)
    monkeypatch.setattr(choice, "best_shares", solved)
    targets = make_targets(seen(tree, two_views(), calibrated), 0.0, TubeOptions())
    pieces = choice.weigh_pieces(tree, tubes, tree.radii(), targets)
    assert np.count_nonzero(pieces.share < choice.MIN_SHARE) == lost


def test_near_ties_are_told_whichever_way_they_fell(monkeypatch):
    tree = fork()
    tubes = tubes_of(tree)
    monkeypatch.setattr(choice, "PIECE_MM", 1e3)
    monkeypatch.setattr(choice, "TRUSTED_SHARE", 9.0)
    monkeypatch.setattr(choice, "best_shares", lambda *_: np.array([0.9, 0.52, 0.48]))
    targets = make_targets(seen(tree, two_views(), True), 0.0, TubeOptions())
    pieces = choice.weigh_pieces(tree, tubes, tree.radii(), targets)
    assert pieces.tie.tolist() == [False, True, True]
    calls = choice.close_calls(tree, pieces)
    assert [call.kept for call in calls] == [True, False]
    for call, branch in zip(calls, tree.branches[1:], strict=True):
        assert call.length_mm == pytest.approx(branch.length_mm)
        gap = np.linalg.norm(branch.points_mm - call.middle_mm, axis=1)
        assert abs(branch.arc_mm[gap.argmin()] - 0.5 * branch.length_mm) < 2.0
    monkeypatch.setattr(choice, "TRUSTED_SHARE", 0.0)  # what is trusted is no tie
    assert not choice.weigh_pieces(tree, tubes, tree.radii(), targets).tie.any()


def narrowed(tree, branch, to):
    """The same tree, one branch as narrow as ``to`` along its middle."""
    branches = list(tree.branches)
    own = branches[branch]
    middle = np.abs(own.arc_mm / own.length_mm - 0.5) < 0.4
    branches[branch] = dataclasses.replace(own, radius_mm=np.where(middle, to, own.radius_mm))
    return dataclasses.replace(tree, branches=tuple(branches))


def test_a_stenosed_branch_comes_back_that_the_points_hold_to_be_wide():
    tree = fork()
    shown = narrowed(tree, 2, 0.25)
    targets = make_targets(seen(shown, two_views()), 0.0, TubeOptions())
    tubes = tubes_of(tree)
    pieces = choice.weigh_pieces(tree, tubes, tree.radii(), targets)
    dropped = dataclasses.replace(pieces, share=np.array([1.0, 1.0, 0.0]))
    rest = dataclasses.replace(shown, branches=shown.branches[:2])
    left = [
        target.path_mm - other.path_mm
        for target, other in zip(
            targets, make_targets(seen(rest, two_views()), 0.0, TubeOptions()), strict=True
        )
    ]
    back = choice.reinstated(tree, dropped, tree.radii(), targets, left)
    assert back.share[2] == 1.0
    # An estimated path may be as low of a vessel that is wide.
    estimated = [dataclasses.replace(target, path_error=0.25) for target in targets]
    assert choice.reinstated(tree, dropped, tree.radii(), estimated, left).share[2] == 0.0
    # What no picture shows does not come back, however narrow it could be.
    nothing = [np.zeros_like(one) for one in left]
    assert choice.reinstated(tree, dropped, tree.radii(), targets, nothing).share[2] == 0.0

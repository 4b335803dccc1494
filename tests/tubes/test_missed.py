"""Vessels that the starting points miss and the pictures show."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree
from skimage.morphology import skeletonize

from gcar_deploy.config import TubeOptions
from gcar_deploy.tree.edit import with_branch
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.fit import fit_tubes
from gcar_deploy.tubes.gauss_newton import footprints
from gcar_deploy.tubes.missed import looked_at, missed_lines
from gcar_deploy.tubes.model import tubes_of
from gcar_deploy.tubes.proposal import Told, proposal
from gcar_deploy.tubes.targets import make_targets
from tests.tree.shapes import branch, fork, grid, points_of
from tests.tubes.scenes import carm, seen, two_views

OPTIONS = TubeOptions()


def _pictures(tree, carms, **kind):
    views = seen(tree, carms, **kind)
    return [dataclasses.replace(view, skeleton=skeletonize(view.mask)) for view in views]


def _with_twig(side=1.0):
    """A fork with a side branch of its trunk, and the same without."""
    base = fork()
    trunk = base.branches[0]
    at = len(trunk) // 2
    way = side * np.array([1.0, 0.35, 0.3]) / np.linalg.norm([1.0, 0.35, 0.3])
    line = trunk.points_mm[at] + np.arange(0.0, 23.0)[:, None] * way
    return with_branch(base, line, 0.8, 1.0, 0.5), base, line


def _believed(tree, where, share):
    points = points_of(tree, where)
    return dataclasses.replace(points, confidence=share * points.confidence)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("calibrated", [True, False])
def test_a_side_branch_without_a_starting_point_is_found(calibrated, side):
    truth, known, line = _with_twig(side)
    where = grid(64)
    views = _pictures(truth, two_views(), calibrated=calibrated)
    start, evidence = points_of(known, where), _believed(truth, where, 0.3)
    blind = fit_tubes(start, views, OPTIONS)
    assert cKDTree(blind.tree.points()).query(line[-1])[0] > 5.0
    found = fit_tubes(start, views, OPTIONS, evidence=evidence)
    assert cKDTree(found.tree.points()).query(line)[0].max() < 1.5
    # One tree still, and nothing else has come.
    assert len(np.unique(found.tree.components())) == 1
    assert cKDTree(truth.points()).query(found.tree.points())[0].max() < 1.5
    assert found.progress.losses[-1] < 0.8 * blind.progress.losses[-1]


def test_a_third_view_that_lacks_it_does_not_hide_it():
    truth, known, line = _with_twig()
    views = _pictures(truth, [*two_views(), carm(0, 0), carm(90, 0)])
    views[2] = _pictures(known, [views[2].carm])[0]
    where = grid(64)
    found = fit_tubes(
        points_of(known, where), views, OPTIONS, evidence=_believed(truth, where, 0.3)
    )
    assert cKDTree(found.tree.points()).query(line)[0].max() < 2.0


def test_a_line_of_one_picture_alone_is_no_vessel():
    truth, known, line = _with_twig()
    one, two = two_views()
    views = [*_pictures(truth, [one]), *_pictures(known, [two])]
    where = grid(64)
    start = points_of(known, where)
    found = fit_tubes(start, views, OPTIONS, evidence=_believed(known, where, 0.9))
    assert cKDTree(found.tree.points()).query(line[-1])[0] > 5.0
    blind = fit_tubes(start, views, OPTIONS)
    np.testing.assert_array_equal(found.tree.points(), blind.tree.points())


@pytest.mark.parametrize("told", [0, 1])
def test_of_two_places_the_predictor_says_which(told, monkeypatch):
    # Asked of missed lines alone: both vessels together explain the second picture best.
    monkeypatch.setattr("gcar_deploy.tubes.topology.ways_beside", lambda *_: None)
    truth, known, line = _with_twig()
    one, two = two_views()
    # What runs before it on the same rays of the first view is shown by the second alone.
    nearer = np.linspace(0.0, 0.015, len(line))[:, None]
    before = line + nearer * (one.source_mm - line)
    both = with_branch(truth, before, 0.8, 1.0, 0.5)
    views = [*_pictures(truth, [one]), *_pictures(both, [two])]
    where = grid(64)
    right = (truth, with_branch(known, before, 0.8, 1.0, 0.5))[told]
    found = fit_tubes(
        points_of(known, where), views, OPTIONS, evidence=_believed(right, where, 0.9)
    )
    ends = np.array([line[-1], before[-1]])
    near = cKDTree(found.tree.points()).query(ends)[0] < 2.0
    assert near[told]
    assert not near[1 - told]


def test_what_lowers_the_objective_too_little_is_left_out(monkeypatch):
    truth, known, line = _with_twig()
    where = grid(64)
    views = _pictures(truth, two_views())
    monkeypatch.setattr("gcar_deploy.tubes.topology.EARNED", 0.95)
    monkeypatch.setattr("gcar_deploy.tubes.relink.BETTER", 0.95)
    found = fit_tubes(
        points_of(known, where), views, OPTIONS, evidence=_believed(truth, where, 0.3)
    )
    assert cKDTree(found.tree.points()).query(line[-1])[0] > 5.0


@pytest.mark.parametrize(("probability", "is_vessel"), [(0.1, True), (0.4, False)])
def test_a_likely_catheter_is_no_vessel(probability, is_vessel):
    truth, known, line = _with_twig()
    where = grid(64)
    views = [
        dataclasses.replace(view, device=np.full(view.mask.shape, probability, np.float32))
        for view in _pictures(truth, two_views())
    ]
    found = fit_tubes(
        points_of(known, where), views, OPTIONS, evidence=_believed(truth, where, 0.3)
    )
    assert (cKDTree(found.tree.points()).query(line[-1])[0] < 2.0) == is_vessel


@pytest.mark.parametrize("calibrated", [True, False])
def test_where_paths_are_estimates_each_mm_has_a_price(calibrated, monkeypatch):
    truth, known, line = _with_twig()
    where = grid(64)
    views = _pictures(truth, two_views(), calibrated=calibrated)
    monkeypatch.setattr("gcar_deploy.tubes.topology.EARNED_PER_MM", 100.0)
    found = fit_tubes(
        points_of(known, where), views, OPTIONS, evidence=_believed(truth, where, 0.3)
    )
    assert (cKDTree(found.tree.points()).query(line[-1])[0] < 2.0) == calibrated


def test_an_end_without_time_keeps_what_there_is():
    truth, known, line = _with_twig()
    views = _pictures(truth, two_views())
    where = grid(64)
    start, evidence = points_of(known, where), _believed(truth, where, 0.3)
    whole = fit_tubes(start, views, OPTIONS)
    left = [whole.progress.steps + whole.progress.rejected + 2]

    def late():
        left[0] -= 1
        return left[0] < 0

    fit = fit_tubes(start, views, OPTIONS, late, evidence)
    assert fit.progress.stopped
    assert cKDTree(fit.tree.points()).query(line[-1])[0] > 5.0
    assert np.isfinite(np.concatenate([b.sigma_mm for b in fit.tree.branches])).all()


def _looks(views, *trees):
    """What the pictures show beside tubes that are where the vessels of a tree are, one a view."""
    targets = make_targets(views, 0.0, OPTIONS)
    prints = [
        footprints(tubes_of(tree), [target])[0] for tree, target in zip(trees, targets, strict=True)
    ]
    return looked_at(views, targets, prints)


def test_a_line_is_followed_beyond_what_is_missed():
    truth, known, line = _with_twig()
    views = _pictures(truth, two_views())
    found = missed_lines(_looks(views, known, known))
    assert [one.view for one in found] == [0, 1]
    for one, view in zip(found, views, strict=True):
        length = np.linalg.norm(np.diff(view.carm.project(line[[0, -1]])[0], axis=0))
        core = one.pixels[one.core]
        assert 0.5 * length < len(core) < len(one.pixels)
        trunk = view.carm.project(known.branches[0].points_mm)[0]
        gap, beyond = (cKDTree(trunk).query(part)[0].min() for part in (core, one.pixels))
        assert beyond < 2.0 < gap


def test_where_there_is_no_picture_nothing_is_missed():
    truth, known, _ = _with_twig()
    views = [
        dataclasses.replace(view, valid=np.zeros(view.mask.shape, bool))
        for view in _pictures(truth, two_views())
    ]
    assert missed_lines(_looks(views, known, known)) == []


def test_what_tubes_explain_now_is_no_proposal_and_in_other_views_costs_more(monkeypatch):
    truth, known, _ = _with_twig()
    views = _pictures(truth, two_views())
    missed = _looks(views, known, known)
    line = missed_lines(missed)[0]
    told = Told.by(_believed(truth, grid(64), 1.0))
    free = proposal(line, missed, known, told)
    assert free is not None
    assert proposal(line, _looks(views, truth, known), known, told) is None
    # The vessel that would be there is explained by something else: nothing of it is new.
    taken = _looks(views, known, truth)
    assert proposal(line, taken, known, told) is None
    monkeypatch.setattr("gcar_deploy.tubes.proposal.LEAST_NEW", 0.0)
    monkeypatch.setattr("gcar_deploy.tubes.proposal.MOST_COST", 9.0)
    assert proposal(line, taken, known, told).cost > free.cost + 0.5


def test_a_new_branch_cuts_the_one_it_leaves():
    tree = fork()
    trunk = tree.branches[0]
    at = trunk.points_mm[4]
    line = at + np.array([[1.0, 0, 0], [5.0, 0, 0], [9.0, 0, 0]])
    grown = with_branch(tree, line, 0.7, 0.4, 2.0)
    assert len(grown.branches) == len(tree.branches) + 2
    assert grown.length_mm == pytest.approx(tree.length_mm + 9.0)
    assert sorted(grown.degrees) == [1, 1, 1, 1, 3, 3]
    np.testing.assert_allclose(grown.branches[-1].points_mm[0], at)
    # Too far from anything it stands alone; at a free end it lengthens the branch.
    assert len(np.unique(with_branch(tree, line + 40.0, 0.7, 0.4, 2.0).components())) == 2
    tip = tree.branches[1].points_mm[-1]
    onward = tip + np.array([[0, 0, 1.0], [0, 0, 6.0]])
    longer = with_branch(tree, onward, 0.7, 0.4, 2.0)
    assert len(longer.branches) == len(tree.branches)
    assert longer.length_mm == pytest.approx(tree.length_mm + 6.0)
    # The first tree of all.
    bare = with_branch(Tree(nodes_mm=np.zeros((0, 3)), branches=()), line, 0.7, 0.4, 2.0)
    assert bare.length_mm == pytest.approx(8.0)
    assert branch(line, 1.0).length_mm == pytest.approx(8.0)

"""Parts of a tree that hang on nothing."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree
from skimage.morphology import skeletonize

from gcar_deploy.config import TubeOptions
from gcar_deploy.engine import Engine
from gcar_deploy.geometry.epipolar import plane_normal
from gcar_deploy.tree.edit import with_branch
from gcar_deploy.tree.tree import empty_tree
from gcar_deploy.tubes.fit import fit_tubes
from gcar_deploy.tubes.run import Run
from gcar_deploy.tubes.topology import MOST_GIVEN_UP, _hanging, loose_mm
from tests.conftest import ready_case
from tests.tree.shapes import fork, grid, points_of
from tests.tubes.scenes import seen, two_views


def _with_part(length_mm):
    base = fork()
    away = base.points().max(axis=0) + 40.0
    line = away + np.linspace(0.0, length_mm, 12)[:, None] * np.array([0.0, 0.0, 1.0])
    return base, with_branch(base, line, 0.8, 1.0, 0.5)


def test_what_hangs_on_nothing_is_measured_and_given_up():
    base, tree = _with_part(20.0)
    assert loose_mm(base) == 0.0
    assert loose_mm(tree) == pytest.approx(20.0)
    left = _hanging(tree)
    assert left.length_mm == pytest.approx(base.length_mm)
    assert len(left.branches) == len(base.branches)


def test_what_hung_on_nothing_before_stays():
    _, tree = _with_part(20.0)
    far = tree.points().max(axis=0) + 40.0
    line = far + np.linspace(0.0, 15.0, 12)[:, None] * np.array([0.0, 0.0, 1.0])
    more = with_branch(tree, line, 0.8, 1.0, 0.5)
    assert loose_mm(_hanging(more, tree)) == pytest.approx(20.0)
    assert loose_mm(_hanging(tree, tree)) == pytest.approx(20.0)
    assert loose_mm(_hanging(more)) == 0.0


def test_a_short_part_stays():
    _, tree = _with_part(5.0)
    assert _hanging(tree).length_mm == pytest.approx(tree.length_mm)


def test_no_tree_has_no_part():
    assert loose_mm(empty_tree()) == 0.0


def _exchanged(size=256, spacing=0.5):
    """Two like vessels side by side that cross the same planes, and with exchanged partners."""
    carms = two_views(size, spacing)
    across = plane_normal(*carms)
    rays = [-one.source_mm / np.linalg.norm(one.source_mm) for one in carms]
    apart = 12.0 * (rays[0] + rays[1])
    away = np.arange(0.0, 26.0)[:, None] * across
    link = np.linspace(0.0, 1.0, 30)[:, None] * apart - 15.0 * across
    low = away[:16] - 15.0 * across
    known = empty_tree()
    for line in (link, low, low + apart):
        known = with_branch(known, line, 1.0, 1.0, 0.5)
    truth, ghosts = known, known
    # One vessel's ray in the first view met with the other's in the second, and the other way.
    for place in (0.0 * apart, apart):
        truth = with_branch(truth, away + place, 1.0, 1.0, 0.5)
    for ray in rays:
        ghosts = with_branch(ghosts, away[3:] + 12.0 * ray, 1.0, 1.0, 0.5)
    return truth, ghosts, carms


def test_vessels_with_exchanged_partners_hang_on_the_tree_again(monkeypatch):
    truth, ghosts, carms = _exchanged()
    views = [
        dataclasses.replace(view, skeleton=skeletonize(view.mask))
        for view in seen(truth, carms, calibrated=False)
    ]
    where, both = grid(100), truth
    for ghost in ghosts.branches[-2:]:
        both = with_branch(both, ghost.points_mm, 1.0, 1.0, 0.5)
    start, told = points_of(ghosts, where), points_of(both, where)
    told = dataclasses.replace(told, confidence=0.5 * told.confidence)
    found = fit_tubes(start, views, TubeOptions(), evidence=told).tree
    assert loose_mm(found) == 0.0
    assert cKDTree(truth.points()).query(found.points())[0].max() < 1.5
    assert cKDTree(found.points()).query(truth.points())[0].max() < 1.5
    monkeypatch.setattr("gcar_deploy.tubes.topology.LEAST_LOOSE_MM", np.inf)
    left = fit_tubes(start, views, TubeOptions(), evidence=told).tree
    assert loose_mm(left) > 40.0
    assert cKDTree(truth.points()).query(left.points())[0].max() > 10.0
    monkeypatch.undo()
    monkeypatch.setattr("gcar_deploy.tubes.topology.MOST_GIVEN_UP", 0.0)
    same = fit_tubes(start, views, TubeOptions(), evidence=told).tree
    assert same.points().tobytes() == left.points().tobytes()


def test_trees_are_tried_on_coarser_pixels_and_fitted_to_the_finest(monkeypatch):
    """Pixels of 0.11 mm are tried in pairs; what comes of it is as good."""
    truth, ghosts, carms = _exchanged(1024, 0.16)
    views = [
        dataclasses.replace(view, skeleton=skeletonize(view.mask))
        for view in seen(truth, carms, calibrated=False)
    ]
    where, both, shapes = grid(100), truth, []
    for ghost in ghosts.branches[-2:]:
        both = with_branch(both, ghost.points_mm, 1.0, 1.0, 0.5)
    told = points_of(both, where)
    told = dataclasses.replace(told, confidence=0.5 * told.confidence)
    fit = Run.tried

    def counted(run, tree, targets, *more):
        shapes.append({target.path_mm.shape for target in targets})
        return fit(run, tree, targets, *more)

    monkeypatch.setattr(Run, "tried", counted)
    found = fit_tubes(points_of(ghosts, where), views, TubeOptions(), evidence=told)
    assert len(shapes) > 3
    assert shapes[:-1] == [{(512, 512)}] * (len(shapes) - 1) and shapes[-1] == {(1024, 1024)}
    assert {picture.shape for picture in found.model_mm} == {(1024, 1024)}
    assert loose_mm(found.tree) == 0.0
    assert cKDTree(truth.points()).query(found.tree.points())[0].max() < 1.5
    assert cKDTree(found.tree.points()).query(truth.points())[0].max() < 1.5


def _trials(monkeypatch, most_given_up):
    """Trees that P_0001 was fitted with on trial, and what came out."""
    folder, tried = ready_case("P_0001"), []
    fit = Run.tried

    def counted(run, tree, targets, *more):
        tried.append((tree.points().tobytes(), tree.radii().tobytes()))
        return fit(run, tree, targets, *more)

    with monkeypatch.context() as patched:
        patched.setattr(Run, "tried", counted)
        patched.setattr("gcar_deploy.tubes.topology.MOST_GIVEN_UP", most_given_up)
        views = [folder / "view1.png", folder / "view2.png"]
        found = Engine(threads=1).reconstruct(views, folder / "geom.json")
    return tried, found.tree.points()


def test_what_explains_much_is_not_proposed_anew(monkeypatch):
    """A line that is refused is not fitted again by the next pass."""
    every, slow = _trials(monkeypatch, np.inf)
    assert len(set(every)) == len(every) > 3
    some, quick = _trials(monkeypatch, MOST_GIVEN_UP)
    assert len(some) < len(every)
    assert quick.tobytes() == slow.tobytes()

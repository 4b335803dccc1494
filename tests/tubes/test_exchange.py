"""Vessels that cross in a picture, and what goes on as which beyond."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from skimage.morphology import skeletonize

from gcar_deploy.config import TubeOptions
from gcar_deploy.geometry.epipolar import plane_normal
from gcar_deploy.tree.edit import reversed_branch, with_branch
from gcar_deploy.tree.tree import empty_tree
from gcar_deploy.tubes import topology
from gcar_deploy.tubes.exchange import LEAST_MM, PLANE_MM, followed, trial_exchanges
from gcar_deploy.tubes.fit import fit_tubes
from gcar_deploy.tubes.gauss_newton import Progress
from gcar_deploy.tubes.run import Run
from gcar_deploy.tubes.targets import make_targets
from gcar_deploy.tubes.topology import loose_mm
from tests.tree.shapes import grid, points_of
from tests.tubes.scenes import seen, seen_as_masks, two_views


def _crossing(start_mm=-20.0, end_mm=20.0):
    """Two vessels, wide and narrow, that cross in the second view, and with the wrong ends."""
    carms = two_views()
    along = np.arange(start_mm, end_mm + 1.0)
    across = plane_normal(*carms)
    first, second = (-one.source_mm / np.linalg.norm(one.source_mm) for one in carms)

    def line(place, slope):
        # Moved along the ray of a view, a point stays where it is in that view.
        return along[:, None] * across + place * second + (slope * along)[:, None] * first

    wide, narrow = line(8.0, 0.25), line(-8.0, -0.25)
    # At the same plane each: the line of one in the first view, of the other in the second.
    half = along > 0
    wrong = np.where(half[:, None], line(8.0, -0.25), wide)
    other = np.where(half[:, None], line(-8.0, 0.25), narrow)
    link = np.linspace(wide[0], narrow[0], 31)
    stem = link[15] - np.arange(0.0, 12.0)[:, None] * across
    trees = []
    for lines in ((wide, narrow), (wrong, other)):
        tree = with_branch(with_branch(empty_tree(), link, 1.0, 1.0, 0.5), stem, 1.0, 1.0, 1.0)
        for one, radius in zip(lines, (1.3, 0.7), strict=True):
            tree = with_branch(tree, one, radius, 1.0, 0.5)
        trees.append(tree)
    return *trees, carms


@pytest.mark.parametrize("turned", [False, True])
def test_the_stretches_beyond_a_crossing_are_those_of_the_true_vessels(turned):
    truth, wrong, carms = _crossing(-10.0, 24.0)
    if turned:
        # Which way a branch is numbered says nothing.
        branches = tuple(reversed_branch(branch) for branch in wrong.branches)
        wrong = dataclasses.replace(wrong, branches=branches)
    # No ray goes through both vessels elsewhere.
    found = trial_exchanges(wrong, carms)
    away = cKDTree(truth.points())
    gaps = [max(away.query(course)[0].max() for course in one.courses_mm) for one in found]
    best = found[int(np.argmin(gaps))]
    assert min(gaps) < 0.7
    made = best.applied(wrong)
    assert away.query(made.points())[0].max() < 0.7
    assert cKDTree(made.points()).query(truth.points())[0].max() < 1.5
    # Both keep their own beginnings and widths.
    assert sorted(np.round(branch.radius_mm.min(), 1) for branch in made.branches) == [
        0.7,
        1.0,
        1.0,
    ]
    ends = [stretch.line(wrong)[-1] for stretch in best.stretches]
    assert away.query(ends)[0].min() > 4.0


def test_vessels_without_a_crossing_have_nothing_to_exchange():
    truth, _, carms = _crossing()
    one = dataclasses.replace(truth, branches=truth.branches[:1])
    assert trial_exchanges(one, carms) == []
    apart = truth.branches[0]
    moved = dataclasses.replace(apart, points_mm=apart.points_mm + np.array([0.0, 0.0, 60.0]))
    assert trial_exchanges(dataclasses.replace(truth, branches=(apart, moved)), carms) == []


def _found(start, truth, carms, calibrated):
    if calibrated == "mask":
        return fit_tubes(start, seen_as_masks(truth, carms), TubeOptions(), evidence=start).tree
    views = [
        dataclasses.replace(view, skeleton=skeletonize(view.mask))
        for view in seen(truth, carms, calibrated=calibrated)
    ]
    return fit_tubes(start, views, TubeOptions(), evidence=start).tree


@pytest.mark.parametrize("calibrated", [True, "mask"])
def test_wrong_partners_are_exchanged_where_paths_or_widths_are_true(monkeypatch, calibrated):
    truth, wrong, carms = _crossing()
    start = points_of(wrong, grid(100))
    found = _found(start, truth, carms, calibrated)
    assert cKDTree(truth.points()).query(found.points())[0].max() < 1.0
    assert cKDTree(found.points()).query(truth.points())[0].max() < 1.5
    monkeypatch.setattr(topology, "MOST_IN_VAIN", 0)
    left = _found(start, truth, carms, calibrated)
    assert cKDTree(truth.points()).query(left.points())[0].max() > 4.0


def test_what_is_right_stays_to_the_last_bit(monkeypatch):
    truth, _, carms = _crossing()
    start = points_of(truth, grid(100))
    found = _found(start, truth, carms, True)
    monkeypatch.setattr(topology, "trial_exchanges", lambda *_: [])
    assert _found(start, truth, carms, True).points().tobytes() == found.points().tobytes()
    monkeypatch.undo()
    # Though every exchange is tried, none is better.
    for name in ("DOUBTED", "UNEXPLAINED"):
        monkeypatch.setattr(topology, name, {"path": 0.0, "width": 0.0})
    monkeypatch.setattr(topology, "HOPELESS", np.inf)
    assert _found(start, truth, carms, True).points().tobytes() == found.points().tobytes()


def test_an_exchange_that_tears_the_tree_apart_is_none(monkeypatch):
    """Two twigs hang on the end of a stretch that would go elsewhere."""
    truth, wrong, carms = _crossing()
    ends = np.stack([branch.points_mm[-1] for branch in wrong.branches])
    end = ends[cKDTree(truth.points()).query(ends)[0].argmax()]
    for way in ([0.0, 0.6, -0.8], [0.0, 0.6, 0.8]):
        twig = end + np.linspace(0.0, 12.0, 13)[:, None] * np.array(way)
        truth, wrong = (with_branch(tree, twig, 0.9, 1.0, 0.5) for tree in (truth, wrong))
    monkeypatch.setattr(topology, "_hung", lambda given, *_: given)
    start = points_of(wrong, grid(100))
    assert loose_mm(_found(start, truth, carms, True)) < 1.0
    monkeypatch.setattr(topology, "LEAST_LOOSE_MM", np.inf)
    assert loose_mm(_found(start, truth, carms, True)) > 10.0


@pytest.mark.parametrize(("calibrated", "size"), [(False, 256), (True, 64)])
def test_what_says_little_of_mass_has_nothing_exchanged(monkeypatch, calibrated, size):
    """Estimated paths, and pixels of 1.4 mm at the isocentre."""
    truth, wrong, _ = _crossing()
    monkeypatch.setattr(topology, "trial_exchanges", lambda *_: pytest.fail("asked for"))
    start, carms = points_of(wrong, grid(100)), two_views(size, 128 / size)
    assert len(_found(start, truth, carms, calibrated).branches) > 0


def test_lines_are_followed_through_common_planes():
    up = np.arange(0.0, 30.0, 0.75)
    pairs = followed(up, 2.0 * up[:20])
    assert np.array_equal(pairs[0], [0, 0])
    # The second is steeper: it takes two steps of the first to each of its own.
    assert pairs[-1].tolist() == [39, 19] or pairs[-1, 1] == 19
    assert np.abs(up[pairs[:, 0]] - 2.0 * up[pairs[:, 1]]).max() <= PLANE_MM
    # What turns back at 9 mm is followed round the bend by what turns there too.
    turned = 9.0 - np.abs(up - 9.0)
    assert followed(turned, turned).tolist() == [[k, k] for k in range(len(up))]
    # What goes on is not.
    assert up[followed(up, turned)[-1, 0]] <= 9.0 + PLANE_MM
    assert followed(up, -up)[-1].max() * 0.75 < LEAST_MM
    # Along the planes all places are alike.
    assert followed(0.02 * up, 0.02 * up).tolist() == [[k, k] for k in range(len(up))]
    long = np.linspace(0.0, 0.9, 100)
    assert followed(long, long).tolist() == [[0, 0]]


@given(
    st.lists(st.floats(-1.5, 1.5), min_size=2, max_size=25),
    st.lists(st.floats(-1.5, 1.5), min_size=2, max_size=25),
)
def test_pairs_step_on_and_share_planes(one, other):
    first, second = (np.cumsum([0.0, *steps]) for steps in (one, other))
    pairs = followed(first, second)
    steps = np.diff(pairs, axis=0)
    assert (steps >= 0).all() and (steps <= 1).all() and (steps.sum(axis=1) > 0).all()
    assert np.abs(first[pairs[:, 0]] - second[pairs[:, 1]]).max() <= PLANE_MM
    mirrored = followed(second, first)
    assert mirrored[-1].sum() == pytest.approx(pairs[-1].sum())


def test_a_trial_that_is_hopeless_ends_early_and_stops_nothing():
    truth, wrong, carms = _crossing()
    options = TubeOptions()
    targets = make_targets(seen(truth, carms), 0.0, options)
    run = Run(options, Progress(), None, None)
    losses = run.tried(wrong, targets).progress.losses
    assert len(losses) > 3 and losses[0] > losses[1]
    # Twice the limit before the first step, the limit after it, none from then on.
    steps = {0.49: 1, 0.51: 2 if losses[1] > 0.51 * losses[0] else len(losses)}
    for share, taken in steps.items():
        assert len(run.tried(wrong, targets, share * losses[0]).progress.losses) == taken
    assert len(run.tried(wrong, targets, 1.001 * losses[1]).progress.losses) == len(losses)
    assert not run.progress.stopped
    stopped = Run(options, Progress(), lambda: True, None)
    stopped.tried(wrong, targets)
    assert stopped.progress.stopped

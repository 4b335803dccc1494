"""A second lattice between the points of the first sees what falls between them."""

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import CandidateOptions, PredictOptions, RunOptions
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.predict.hull import Candidates, visual_hull
from gcar_deploy.predict.lattices import (
    SHIFTS,
    mean_evidence,
    near_evidence,
    shifted_lattice,
)
from tests.predict.test_hull import carm

GRID = Grid(center_mm=(1.0, -2.0, 3.0), size_mm=(24.0, 30.0, 36.0), shape=(12, 15, 18))


def candidates(lattice, keep=None):
    index = np.argwhere(np.ones(lattice.shape, bool) if keep is None else keep)
    return Candidates(index, lattice.index2world(index), lattice)


def points(of, confidence):
    return CenterPoints(
        points_mm=of.points_mm,
        confidence=confidence,
        radius_mm=np.ones(len(of)),
        spacing_mm=of.spacing_mm,
        source="multi",
        offset_mm=np.zeros((len(of), 3)),
    )


def ramp(of):
    """A linear field: trilinear sampling gives it back exactly."""
    return 0.5 + (of.points_mm - np.asarray(GRID.center_mm)) @ np.array([0.01, -0.02, 0.005])


@pytest.mark.parametrize("look", [1, 2, 3])
def test_a_linear_field_is_the_same_on_every_lattice(look):
    first, other = candidates(GRID), candidates(shifted_lattice(GRID, look))
    mean = mean_evidence(points(first, ramp(first)), [(other, points(other, ramp(other)))])
    inner = ((first.index >= 1) & (first.index < np.asarray(GRID.shape) - 1)).all(axis=1)
    np.testing.assert_allclose(mean.confidence[inner], ramp(first)[inner], atol=1e-6)


def test_lattices_are_shifted_by_their_share_of_a_cell():
    for look, shift in enumerate(SHIFTS[1:], 1):
        moved = shifted_lattice(GRID, look).index2world(np.zeros((1, 3)))
        np.testing.assert_allclose(
            moved[0] - GRID.index2world(np.zeros((1, 3)))[0], 2.0 * np.array(shift)
        )


@pytest.mark.parametrize("look", [1, 2, 3])
def test_only_what_lies_near_evidence_is_asked_again(look):
    first = candidates(GRID)
    confidence = np.zeros(len(first))
    confidence[first.index.tolist().index([5, 6, 7])] = 0.9
    near = near_evidence(first, confidence, look)
    gap = near + np.array(SHIFTS[look]) - [5, 6, 7]
    assert len(near) >= 27 and np.abs(gap).max() <= 1.5
    assert len(np.unique(near, axis=0)) == len(near)
    assert len(near_evidence(first, 0 * confidence, look)) == 0


def test_nothing_believed_halves_what_one_look_said():
    first = candidates(GRID)
    empty = candidates(shifted_lattice(GRID, 1), np.zeros(GRID.shape, bool))
    told = points(first, np.full(len(first), 0.6))
    mean = mean_evidence(told, [(empty, points(empty, np.zeros(0)))])
    np.testing.assert_allclose(mean.confidence, 0.3)
    assert mean_evidence(told, []).confidence == pytest.approx(told.confidence)


def test_the_hull_among_given_points_is_the_hull_there():
    views = []
    for view in (carm(-30, -20), carm(45, 25)):
        path = np.zeros((128, 128), np.float32)
        path[40:90, 50:80] = 3.0
        views.append((view, path))
    whole = visual_hull(views, GRID, CandidateOptions())
    some = np.argwhere(np.random.default_rng(0).random(GRID.shape) < 0.3)
    part = visual_hull(views, GRID, CandidateOptions(), some)
    wanted = {tuple(i) for i in whole.index.tolist()} & {tuple(i) for i in some.tolist()}
    assert {tuple(i) for i in part.index.tolist()} == wanted and 0 < len(part) < len(whole)
    assert part.index.tolist() == sorted(part.index.tolist())


@pytest.mark.slow
@pytest.mark.parametrize("lattices", [1, 2])
def test_the_option_reaches_the_reconstruction(lattices, monkeypatch):
    """The demo, judged on one lattice or two: one inference a lattice."""
    from gcar_deploy import Engine
    from gcar_deploy.data.demo_case import demo_case
    from gcar_deploy.predict.center_predictor import CenterPredictor

    asked = []
    told = CenterPredictor.predict

    def predict(self, found, *rest):
        asked.append(len(found))
        return told(self, found, *rest)

    monkeypatch.setattr(CenterPredictor, "predict", predict)
    options = RunOptions()
    chosen = dataclasses.replace(options.predict, lattices=lattices)
    assert PredictOptions().lattices == 2
    case = demo_case()
    engine = Engine(options=dataclasses.replace(options, predict=chosen))
    result = engine.reconstruct(list(case.pictures), case.geometry)
    assert len(asked) == lattices and result.status == "ok"
    assert all(n < asked[0] for n in asked[1:])

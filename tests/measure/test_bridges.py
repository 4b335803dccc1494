"""Gaps at severe lesions are joined where the pictures show a vessel, and nowhere else."""

import dataclasses

import numpy as np
import pytest

from gcar_deploy.measure.bridges import joined_over_lesions
from tests.measure.test_sections import ARC, LINE, narrowed, signals_of, tree_of

SEVERE = narrowed(0.85)
BEFORE, AFTER = LINE[:56], LINE[65:]


def broken(before=BEFORE, after=AFTER):
    tree = tree_of(np.full(len(before), 1.4), np.full(len(after), 1.4), lines=(before, after))
    known = tuple(
        dataclasses.replace(b, sigma_mm=np.full(len(b), 0.1),
                            covariance_mm2=np.tile(0.005 * np.eye(3), (len(b), 2, 1, 1)))
        for b in tree.branches
    )  # fmt: skip
    return dataclasses.replace(tree, branches=known)


@pytest.mark.parametrize("kind", ["raw", "path_length"])
def test_a_thin_vessel_in_the_gap_joins_its_ends(kind):
    tree = joined_over_lesions(broken(), signals_of(tree_of(SEVERE), kind, noise_mm=0.05))
    (whole,) = tree.branches
    assert whole.length_mm == pytest.approx(ARC[-1], rel=0.01)
    way = (LINE[-1] - LINE[0]) / ARC[-1]
    off = whole.points_mm - LINE[0]
    assert np.linalg.norm(off - (off @ way)[:, None] * way, axis=1).max() < 0.1
    core = np.abs(off @ way - ARC[60]) < 1.0
    assert whole.radius_mm[core].max() < 0.9
    assert len(tree.nodes_mm) == 2 and set(tree.degrees) == {1}
    # A bridge is less certain than what was fitted.
    assert whole.sigma_mm[core].min() > 0.5 > 0.2 > whole.sigma_mm[[0, -1]].max()
    spread = np.sqrt(np.trace(whole.covariance_mm2[core].sum(axis=1), axis1=1, axis2=2) / 3)
    np.testing.assert_allclose(spread, whole.sigma_mm[core], rtol=0.01)


@pytest.mark.parametrize("kind", ["raw", "path_length"])
@pytest.mark.parametrize("after", [70, 80])
def test_an_empty_gap_stays_one(kind, after):
    apart = broken(after=LINE[after:])
    signals = signals_of(apart, kind, noise_mm=0.05)
    assert joined_over_lesions(apart, signals) is apart


def test_one_view_without_the_vessel_is_enough_to_leave_it():
    apart = broken(after=LINE[70:])
    shown, empty = signals_of(tree_of(SEVERE), "raw"), signals_of(apart, "raw", noise_mm=0.05)
    assert joined_over_lesions(apart, [shown[0], empty[1]]) is apart


def test_ends_that_do_not_face_each_other_stay_ends():
    way = (LINE[-1] - LINE[0]) / ARC[-1]
    side = np.cross(way, [0.0, 0.0, 1.0])
    beside = broken(after=AFTER + 6.0 * side)
    signals = signals_of(tree_of(SEVERE), "raw", noise_mm=0.05)
    assert joined_over_lesions(beside, signals) is beside
    far = broken(after=LINE[100:])
    assert joined_over_lesions(far, signals) is far
    thin = tree_of(np.full(56, 1.4), np.full(55, 0.5), lines=(BEFORE, AFTER))
    assert joined_over_lesions(thin, signals) is thin


def test_a_mask_shows_nothing_in_a_gap():
    apart = broken()
    assert joined_over_lesions(apart, signals_of(tree_of(SEVERE), "mask")) is apart

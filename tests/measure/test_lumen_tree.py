"""The lumen with a point at each section: narrow cores between the tubes' points are kept."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.flow.hydraulics import piece_resistance
from gcar_deploy.measure import lumen_tree
from gcar_deploy.measure.sections import sections_of_radii
from tests.flow.trees import stenosed


def test_a_core_between_the_points_of_the_tubes_is_kept():
    coarse, fine = stenosed(60.0, count=41), stenosed(60.0, count=151)
    (own,) = sections_of_radii(fine)
    sigma = np.linspace(0.01, 0.1, 151)
    (branch,), (moved,) = (
        lumen_tree(coarse, [dataclasses.replace(own, sigma_mm=sigma)])[0].branches,
        lumen_tree(coarse, [dataclasses.replace(own, sigma_mm=sigma)])[1],
    )
    np.testing.assert_allclose(branch.radius_mm, fine.branches[0].radius_mm)
    np.testing.assert_allclose(branch.points_mm, fine.branches[0].points_mm, atol=1e-9)
    np.testing.assert_array_equal(moved.sigma_mm, sigma)
    np.testing.assert_allclose(moved.arc_mm, branch.arc_mm)
    assert (branch.start, branch.end) == (0, 1)

    def loss(one):
        return piece_resistance(one.radius_mm, np.diff(one.arc_mm), 0.0035).sum()

    assert loss(branch) == pytest.approx(loss(fine.branches[0]), rel=1e-9)
    # The same course with radii at its own points alone loses another amount.
    assert loss(coarse.branches[0]) != pytest.approx(loss(branch), rel=0.01)


def test_without_sections_the_tree_is_its_own_lumen():
    tree = stenosed(60.0)
    same, (own,) = lumen_tree(tree, None)
    assert same is tree
    np.testing.assert_array_equal(own.diameter_mm, 2 * tree.radii())

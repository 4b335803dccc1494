"""The proposed view against what geometry says of simple vessels."""

from __future__ import annotations

import numpy as np
import pytest

from gcar_deploy.geometry.carm import CArm, separation_deg
from gcar_deploy.measure.further_view import best_further_view
from gcar_deploy.tree.tree import empty_tree
from tests.geometry.test_observability import curve_sigmas
from tests.tree.shapes import fork, tube


def carm(primary, secondary=0.0):
    return CArm(
        primary_angle_deg=primary, secondary_angle_deg=secondary, sod_mm=750, sdd_mm=1050,
        rows=512, columns=512, pixel_spacing_mm=(0.3, 0.3),
    )  # fmt: skip


def test_two_near_views_are_complemented_by_one_across():
    carms = [carm(0), carm(12)]
    found = best_further_view(tube(axis=(0, 0, 1)), carms)
    new = carm(found.primary_angle_deg, found.secondary_angle_deg)
    assert min(separation_deg(new, c) for c in carms) > 40
    assert found.sigma_after_mm < 0.5 * found.sigma_before_mm


def test_it_is_the_best_of_the_directions_it_may_take():
    carms, tree = [carm(-30, -20), carm(45, 25)], fork()
    found = best_further_view(tree, carms)
    points = tree.points()
    tangents = np.concatenate([b.tangents for b in tree.branches])

    def mean(views):
        return float(np.minimum(curve_sigmas(views, points, tangents), 5.0).mean())

    assert found.sigma_before_mm == pytest.approx(mean(carms), rel=0.02)
    for primary, secondary in ((0, 0), (-60, 0), (60, 0), (0, 40), (0, -40), (30, -30)):
        assert found.sigma_after_mm <= mean([*carms, carm(primary, secondary)]) * 1.02
    assert 0 <= found.foreshortening < 0.5


def test_no_tree_no_view():
    assert best_further_view(empty_tree(), [carm(0), carm(90)]) is None

"""The further view: it must hold what the present ones do not."""

import numpy as np
import pytest

from gcar_deploy.advice import LEAST_APART_DEG, advise
from gcar_deploy.geometry.carm import separation_deg
from gcar_deploy.geometry.epipolar import plane_normal
from gcar_deploy.geometry.observability import curve_sigmas
from gcar_deploy.tree.tree import empty_tree
from tests.geometry.test_epipolar import view
from tests.tree.shapes import fork, tube

PAIR = [view(-30), view(40)]


def folded(a, b):
    angle = separation_deg(a, b)
    return min(angle, 180 - angle)


def test_a_vessel_in_the_epipolar_plane_needs_a_view_from_out_of_it():
    """Both views of a pure RAO/LAO pair see a transverse vessel edge-on to their plane."""
    normal = plane_normal(*PAIR)
    lying = tube(axis=np.cross(normal, PAIR[0].axes[2]) + 0.3 * PAIR[0].axes[2])
    found = advise(lying, PAIR)
    further = view(found.primary_angle_deg, found.secondary_angle_deg)
    assert abs(further.axes[2] @ normal) > 0.4  # cranial or caudal of the plane
    assert found.sigma_then_mm < 0.25 * found.sigma_now_mm
    assert found.name in found.sentence


def test_the_bound_it_promises_is_the_bound_of_that_view():
    tree = fork()
    found = advise(tree, PAIR)
    further = view(found.primary_angle_deg, found.secondary_angle_deg)
    points = np.concatenate([b.points_mm for b in tree.branches])
    tangents = np.concatenate([b.tangents for b in tree.branches])
    sigma = curve_sigmas([*PAIR, further], points, tangents)
    assert found.sigma_then_mm == pytest.approx(np.percentile(sigma, 90), rel=1e-6)
    assert min(folded(further, c) for c in PAIR) >= LEAST_APART_DEG


def test_no_tree_and_nothing_to_gain():
    assert advise(empty_tree(), PAIR) is None
    everywhere = [view(a, b) for a in range(-90, 91, 20) for b in (-30, 0, 30)]
    assert advise(tube(), everywhere) is None

import dataclasses

import numpy as np
import pytest

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.measure.lumen import (
    bifurcation_angles,
    foreshortening,
    tree_lumens,
)
from gcar_deploy.tree.tree import Tree, empty_tree
from tests.tree.shapes import branch, fork, tube


def lumen_of(points, radius):
    return tree_lumens(Tree(nodes_mm=points[[0, -1]], branches=(branch(points, radius, 0, 1),)))[0]


@pytest.mark.parametrize("severity", [0.3, 0.5, 0.7])
def test_percent_stenosis_of_a_made_narrowing(severity):
    z = np.linspace(0, 60, 121)
    healthy = 1.6 - 0.008 * z
    radius = healthy * (1 - severity * np.exp(-0.5 * ((z - 30) / 3) ** 2))
    points = np.stack([0 * z, 0 * z, z], 1)
    out = lumen_of(points, radius)
    assert out.stenosis_percent == pytest.approx(100 * severity, abs=4)
    assert out.minimal_at_mm == pytest.approx(30, abs=1)
    assert out.minimal_diameter_mm == pytest.approx(2 * radius.min(), abs=0.02)
    assert 1 < out.lesion_length_mm < 15


def test_healthy_taper_is_no_stenosis():
    z = np.linspace(0, 60, 121)
    out = lumen_of(np.stack([0 * z, 0 * z, z], 1), 2.0 - 0.02 * z)
    assert out.stenosis_percent < 3
    assert out.lesion_length_mm == 0


def test_a_short_branch_states_no_stenosis():
    out = tree_lumens(tube(length=4, radius=1.5, count=5))[0]

    assert out.stenosis_percent is None


def test_right_angle():
    s = np.linspace(0, 10, 11)
    zero = 0 * s
    tree = Tree(
        nodes_mm=np.array([[0, 0, -10], [0, 0, 0], [0, 0, 10], [10, 0, 0.0]]),
        branches=(
            branch(np.stack([zero, zero, s - 10], 1), 1, 0, 1),
            branch(np.stack([zero, zero, s], 1), 1, 1, 2),
            branch(np.stack([s, zero, zero], 1), 1, 1, 3),
        ),
    )
    angles = {(a.first, a.second): a.angle_deg for a in bifurcation_angles(tree)}
    assert angles[0, 1] == pytest.approx(180, abs=1e-6)
    assert angles[1, 2] == pytest.approx(90, abs=1e-6)
    assert len(bifurcation_angles(fork())) == 3


def test_foreshortening_is_one_along_the_beam_and_none_across_it():
    carm = CArm(
        primary_angle_deg=0, secondary_angle_deg=0, sod_mm=5000, sdd_mm=7000, rows=64, columns=64,
        pixel_spacing_mm=(1.0, 1.0),
    )  # fmt: skip
    along, across = tube(axis=carm.axes[2]), tube(axis=carm.axes[0])
    both = dataclasses.replace(along, branches=(*along.branches, *across.branches))
    first, second = foreshortening(both, carm)
    assert first > 0.99
    assert second < 1e-4
    assert len(foreshortening(empty_tree(), carm)) == 0

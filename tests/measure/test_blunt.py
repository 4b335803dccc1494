"""Arteries that a side branch seems to go on from are begun where they begin."""

import numpy as np
import pytest

from gcar_deploy.measure.blunt import blunt_begins
from gcar_deploy.measure.inlet import from_inlets
from gcar_deploy.tree.tree import Tree
from tests.tree.shapes import branch


def artery(profile, stump=1.4):
    """An artery from a fork out to z = 45, a stump below the fork, and a branch beside it."""
    z = np.arange(0.0, 45.5, 0.5)
    places, radii = zip(*profile, strict=True)
    up = branch(np.stack([0 * z, 0 * z, z], 1), np.interp(z, places, radii), 0, 1)
    s = np.arange(0.0, 15.5, 0.5)
    down = branch(np.stack([0 * s, 0 * s, -s], 1), np.full(len(s), stump), 0, 2)
    side = branch(np.stack([2 * s, 0 * s, -s], 1), np.linspace(1.0, 0.45, len(s)), 0, 3)
    ends = [part.points_mm[-1] for part in (up, down, side)]
    return Tree(nodes_mm=np.array([[0, 0, 0.0], *ends]), branches=(up, down, side))


CONUS = ((0, 1.6), (30, 1.9), (32, 0.6), (45, 0.4))


def test_an_occluded_artery_begins_where_its_conus_branch_leaves_it():
    out = from_inlets(artery(CONUS))
    first, conus = out.branches[0], next(b for b in out.branches if b.points_mm[-1, 2] == 45)
    assert first.points_mm[0, 2] == pytest.approx(30.5, abs=1.0)
    assert first.points_mm[-1] == pytest.approx([0, 0, 0])
    np.testing.assert_array_equal(conus.points_mm[0], first.points_mm[0])
    assert sum(b.length_mm for b in out.branches) == pytest.approx(artery(CONUS).length_mm)
    stump = next(b for b in out.branches if b.points_mm[-1, 2] == -15 and b.points_mm[-1, 0] == 0)
    assert stump.points_mm[0] == pytest.approx([0, 0, 0])
    again = from_inlets(out)
    for one, other in zip(out.branches, again.branches, strict=True):
        np.testing.assert_array_equal(one.points_mm, other.points_mm)


def test_an_ostium_may_be_marked_there():
    marked = from_inlets(artery(CONUS), np.array([[1.0, 0, 30.0]]))
    assert marked.branches[0].points_mm[0, 2] == pytest.approx(30.5, abs=1.0)


@pytest.mark.parametrize(
    ("profile", "stump"),
    [
        (((0, 1.6), (45, 0.6)), 1.4),  # a taper
        (((0, 1.6), (18, 1.6), (22, 2.6), (26, 1.5), (45, 1.2)), 1.4),  # an aneurysm
        (((0, 1.6), (20, 1.5), (24, 0.5), (28, 1.4), (45, 1.0)), 1.4),  # a stenosis
        (((0, 1.7), (28, 1.4), (30, 0.6), (45, 0.4)), 1.4),  # a taper that ends in a step
        (CONUS, 1.9),  # a thicker free end
    ],
)
def test_what_else_narrows_begins_no_artery(profile, stump):
    tree = artery(profile, stump)
    assert from_inlets(tree).branches[0].points_mm[0, 2] == -15
    assert stump > 1.5 or not blunt_begins(tree)

"""Where two trees differ, and the tree that takes one's word there."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gcar_deploy.tree.combine import Difference, Net, combined, differences
from gcar_deploy.tree.edit import with_branch
from gcar_deploy.tree.tree import Tree, empty_tree
from tests.tree.shapes import branch, fork
from tests.tubes.scenes import two_views


def _vessels(*lines):
    tree = empty_tree()
    for line in lines:
        tree = with_branch(tree, np.array(line, float), 1.0, 1.0, 0.5)
    return tree


def _line(start, end, count=40):
    return np.linspace(start, end, count)


STEM = _line((0, 0, 30), (0, 0, 0))
#: two ways on from the stem, and one that leaves it higher up
LEFT, RIGHT = _line((0, 0, 0), (-20, 5, -20)), _line((0, 0, 0), (20, -5, -20))
SIDE = _line((0, 0, 15), (10, 18, 5))


def _whole(tree):
    net = Net.of(tree)
    none = np.zeros(len(net.points_mm), bool)
    return combined(net, net, Difference(none, none, none))


def _same(one, other, mm=0.6):
    gaps = (cKDTree(a.points()).query(b.points())[0].max() for a, b in ((one, other), (other, one)))
    return max(gaps) < mm


def test_a_tree_as_points_and_steps_is_the_tree_again():
    tree = fork()
    again = _whole(tree)
    assert again.length_mm == pytest.approx(tree.length_mm, rel=0.02)
    assert sorted(again.degrees) == sorted(tree.degrees)
    assert _same(tree, again)


def test_radii_lie_between_those_of_neighbours():
    """Points half-way between two are not given either one's, which rounding would choose."""
    line = _line((0, 0, 30), (0, 0, 0), 16)
    steep = Tree(nodes_mm=line[[0, -1]], branches=(branch(line, np.linspace(3.0, 1.0, 16)),))
    (again,) = _whole(steep).branches
    top = np.linalg.norm(again.points_mm - (0, 0, 30), axis=1)
    np.testing.assert_allclose(again.radius_mm, 3.0 - top / 15.0, atol=1e-9)


def test_like_trees_do_not_differ():
    net = Net.of(_vessels(STEM, LEFT, RIGHT))
    assert differences(net, net, two_views()) == []


def test_what_one_lacks_comes_and_hangs_on_the_tree():
    one, other = _vessels(STEM, LEFT, RIGHT), _vessels(STEM, LEFT, RIGHT, SIDE)
    nets = Net.of(one), Net.of(other)
    (found,) = differences(*nets, two_views())
    assert not found.old.any()
    after = combined(*nets, found)
    assert _same(after, other, 1.2)
    assert after.parts().max() == 0


def test_what_the_other_lacks_goes():
    one, other = _vessels(STEM, LEFT, RIGHT, SIDE), _vessels(STEM, LEFT, RIGHT)
    nets = Net.of(one), Net.of(other)
    (found,) = differences(*nets, two_views())
    assert not found.new.any()
    assert _same(combined(*nets, found), other, 1.2)


def _exchanged():
    """Two vessels, and the ghosts of either's line in one view with the other's in the second."""
    carms = two_views()
    rays = [-one.source_mm / np.linalg.norm(one.source_mm) for one in carms]
    down = np.array([0.0, 0.0, -1.0])
    lines = [_line(place, place + 20 * down) for place in (0 * rays[0], 12 * (rays[0] + rays[1]))]
    ghosts = [_line(12 * ray, 12 * ray + 20 * down) for ray in rays]
    return _vessels(*lines), _vessels(*ghosts), carms


def test_parts_that_share_lines_are_exchanged_together():
    truth, ghosts, carms = _exchanged()
    nets = Net.of(ghosts), Net.of(truth)
    (found,) = differences(*nets, carms)
    assert found.old.all()
    assert found.new.all()
    assert _same(combined(*nets, found), truth, 1.0)


def test_parts_that_share_none_are_asked_one_by_one():
    one = _vessels(STEM, LEFT)
    nets = Net.of(one), Net.of(_vessels(STEM, LEFT, SIDE, _line((0, 0, 0), (-5, -30, -25))))
    assert len(differences(*nets, two_views())) == 2


def test_a_loop_is_cut_where_the_old_way_ran():
    """The new way between two places of the tree takes the place of the old one."""
    lower = _line((0, 0, -20), (0, 0, -40))
    # Along the rays of one view, so that both ways are one line in it.
    ray = -two_views()[0].source_mm / np.linalg.norm(two_views()[0].source_mm)
    bow = [(0, 0, -20 * t / np.pi) + 6 * np.sin(t) * ray for t in np.linspace(0, np.pi, 40)]
    straight = _line((0, 0, 0), (0, 0, -20))
    nets = (
        Net.of(_vessels(np.concatenate([STEM, straight[1:], lower[1:]]))),
        Net.of(_vessels(np.concatenate([STEM, bow[1:], lower[1:]]))),
    )
    found = differences(*nets, two_views())
    assert len(found) == 1
    after = combined(*nets, found[0])
    assert len(after.branches) == 1
    assert cKDTree(after.points()).query(np.array(bow))[0].max() < 1.2


def test_of_a_loop_the_new_way_stays():
    """Two ways that share no line do not change sides together; no tree has both."""
    lower = _line((0, 0, -20), (0, 0, -40))
    bow = [(0, 6 * np.sin(t), -20 * t / np.pi) for t in np.linspace(0, np.pi, 40)]
    straight = _line((0, 0, 0), (0, 0, -20))
    nets = (
        Net.of(_vessels(np.concatenate([STEM, straight[1:], lower[1:]]))),
        Net.of(_vessels(np.concatenate([STEM, bow[1:], lower[1:]]))),
    )
    (came,) = (one for one in differences(*nets, two_views()) if not one.old.any())
    after = combined(*nets, came)
    assert len(after.branches) == 1
    assert cKDTree(after.points()).query(np.array(bow))[0].max() < 1.2


def test_what_both_have_stays_where_its_end_goes():
    """The end of the one's way is taken out, the other's, elsewhere in all views, not put in."""
    middle = (-10, 2.5, -10)
    begun = _line((0, 0, 0), middle)
    wrong, right = _line(middle, (-12, 3, -45)), _line(middle, (-45, 25, 0))
    one = _vessels(STEM, RIGHT, np.concatenate([begun, wrong[1:]]))
    other = _vessels(STEM, RIGHT, np.concatenate([begun, right[1:]]))
    nets = Net.of(one), Net.of(other)
    (taken,) = (way for way in differences(*nets, two_views()) if way.old.any())
    assert not taken.new.any()
    after = combined(*nets, taken)
    assert cKDTree(after.points()).query(begun)[0].max() < 1.5
    assert cKDTree(after.points()).query(wrong[20:])[0].min() > 5


def test_a_loop_is_opened_where_the_other_tree_has_nothing():
    """The upper half of a vessel comes; what its lower half hung on by mistake goes."""
    upper, lower = RIGHT[:20], RIGHT[20:]
    link = _line(LEFT[-1], lower[-1])
    other = _vessels(STEM, LEFT, RIGHT)
    one = _vessels(STEM, np.concatenate([LEFT, link[1:], lower[-2::-1]]))
    nets = Net.of(one), Net.of(other)
    (came,) = (way for way in differences(*nets, two_views()) if way.new.any())
    assert not came.old.any()
    after = combined(*nets, came)
    assert cKDTree(after.points()).query(np.concatenate([LEFT, upper, lower]))[0].max() < 1.5
    assert len(after.branches) == 3
    assert after.length_mm < other.length_mm + 4


@pytest.mark.parametrize("side", [0, 1])
def test_nothing_beside_a_tree_is_taken_whole(side):
    pair = [_vessels(STEM, LEFT), empty_tree()]
    nets = Net.of(pair[side]), Net.of(pair[1 - side])
    found = differences(*nets, two_views())
    assert len(found) == 1
    assert bool(combined(*nets, found[0]).branches) == (side == 1)

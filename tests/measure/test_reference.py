"""References of trees whose healthy calibre is known; borders and bifurcations."""

import numpy as np
import pytest

from gcar_deploy.config import LesionBorders
from gcar_deploy.measure.bifurcation import bifurcations
from gcar_deploy.measure.borders import marked_lesions
from gcar_deploy.measure.lesions import narrowest
from gcar_deploy.measure.lumen import tree_lumens
from gcar_deploy.measure.reference import FLOW_EXPONENT
from gcar_deploy.measure.sections import sections_of_radii
from gcar_deploy.tree.tree import Tree, along
from tests.tree.shapes import branch
from tests.tubes.scenes import two_views

Q = FLOW_EXPONENT


def bifurcated(parent_length=30.0, narrow=None):
    """A trunk of 3.6 mm with daughters of 3.0 mm and what the flow law leaves."""
    side = (3.6**Q - 3.0**Q) ** (1 / Q)
    z = np.arange(0, parent_length + 0.1, 0.5)
    s = np.arange(0, 35.1, 0.5)
    trunk = np.stack([0 * z, 0 * z, z - z[-1]], 1)
    lines = (trunk, np.stack([0.5 * s, 0 * s, s], 1), np.stack([0 * s, -0.7 * s, 0.7 * s], 1))
    radii = [np.full(len(line), d / 2) for line, d in zip(lines, (3.6, 3.0, side), strict=True)]
    if narrow is not None:
        k, middle, length, share = narrow
        arc = np.linalg.norm(lines[k] - lines[k][0], axis=1)
        off = np.clip(2 * np.abs(arc - middle) / length, 0, 1)
        radii[k] = radii[k] * (1 - share * 0.5 * (1 + np.cos(np.pi * off)))
    nodes = np.array([trunk[0], np.zeros(3), lines[1][-1], lines[2][-1]])
    ends = ((0, 1), (1, 2), (1, 3))
    made = tuple(branch(p, r, *e) for p, r, e in zip(lines, radii, ends, strict=True))
    return Tree(nodes_mm=nodes, branches=made)


def test_healthy_calibres_with_their_step():
    lumens = tree_lumens(bifurcated())
    found = [float(np.median(lumen.reference_mm)) for lumen in lumens]
    assert found == pytest.approx([3.6, 3.0, (3.6**Q - 3.0**Q) ** (1 / Q)], rel=0.01)
    assert all(lumen.stenosis_percent < 2 and lumen.lesion_mm is None for lumen in lumens)


def test_a_short_trunk_narrow_nearly_all_along_has_its_reference_from_its_neighbours():
    (trunk, *_) = tree_lumens(bifurcated(14.0, narrow=(0, 7.0, 10.0, 0.5)))
    assert trunk.reference_diameter_mm == pytest.approx(3.6, abs=0.35)
    assert trunk.stenosis_percent == pytest.approx(50, abs=7)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.8])
def test_lesion_borders_and_areas(share):
    _, main, _ = tree_lumens(bifurcated(narrow=(1, 20.0, 12.0, share)))
    assert main.stenosis_percent == pytest.approx(100 * share, abs=2)
    assert main.area_stenosis_percent == pytest.approx(100 * (1 - (1 - share) ** 2), abs=3)
    first, last = main.lesion_mm
    # Where the raised cosine has come back to nine tenths.
    half = 6.0 / np.pi * np.arccos(2 * 0.1 / share - 1)
    assert (first, last) == pytest.approx((20 - half, 20 + half), abs=1.2)
    assert main.lesion_length_mm == pytest.approx(last - first)
    assert main.proximal_reference_mm == pytest.approx(3.0, abs=0.06)
    assert main.distal_reference_mm == pytest.approx(3.0, abs=0.06)
    clear = main.sections.arc_mm[main.clear]
    expected = clear[-1] - clear[0] - (last - first)
    assert main.plaque_free_mm == pytest.approx(expected, abs=1.5)


def test_three_segments_meet_at_a_bifurcation():
    tree = bifurcated(narrow=(2, 7.0, 6.0, 0.6))
    (node,) = bifurcations(tree, tree_lumens(tree))
    assert [(s.branch, s.role) for s in node.segments] == [(0, "parent"), (1, "main"), (2, "side")]
    assert node.segments[2].stenosis_percent == pytest.approx(60, abs=4)
    assert max(s.stenosis_percent for s in node.segments[:2]) < 3
    side = (3.6**Q - 3.0**Q) ** (1 / Q)
    assert node.calibre_ratio == pytest.approx(3.6 / (3.0 + side), rel=0.02)


def place(tree, k, at_mm):
    """Pixel in view 2 of a branch so far from its inlet."""
    line = tree.branches[k]
    points = along(line.points_mm, line.arc_mm, np.array([at_mm]))
    return tuple(two_views()[1].project(points)[0][0].tolist())


def mark(tree, proximal, distal):
    """Lesion between two (branch, mm from its inlet)."""
    ends = place(tree, *proximal), place(tree, *distal)
    return LesionBorders(view=2, proximal=ends[0], distal=ends[1])


def with_marks(tree, k, *stretches):
    """Lumen of a branch with so many lesions marked."""
    sections, marks = sections_of_radii(tree), [mark(tree, (k, a), (k, b)) for a, b in stretches]
    marked, missed = marked_lesions(tree, sections, two_views(), marks)
    assert missed == () and list(marked) == [k]
    return tree_lumens(tree, sections, marked)[k]


def test_a_marked_lesion_has_the_users_borders_and_the_same_reference():
    tree = bifurcated(narrow=(1, 20.0, 8.0, 0.5))
    found, free = with_marks(tree, 1, (18.0, 22.0)), tree_lumens(tree)[1]
    (lesion,) = found.lesions
    assert lesion.marked and not free.lesions[0].marked
    assert found.lesion_mm == pytest.approx((18, 22), abs=0.6)
    # Borders within the lesion do not make a narrowed vessel the healthy one.
    assert found.reference_diameter_mm == free.reference_diameter_mm
    assert found.stenosis_percent == free.stenosis_percent
    assert found.replaced == free.lesions


def test_a_marked_lesion_stands_beside_those_found():
    tree = bifurcated(narrow=(1, 20.0, 8.0, 0.5))
    (free,) = tree_lumens(tree)[1].lesions
    marked = with_marks(tree, 1, (4.0, 8.0), (28.0, 31.0))
    assert [one.marked for one in marked.lesions] == [False, True, True]
    assert marked.lesions[0] == free and marked.replaced == ()
    assert marked.stenosis_percent == free.stenosis_percent
    ends = sorted(one.lesion_mm for one in marked.lesions[1:])
    assert ends[0] == pytest.approx((4, 8), abs=0.6)
    assert ends[1] == pytest.approx((28, 31), abs=0.6)


def test_a_mark_beside_the_narrowest_place_cuts_a_found_lesion():
    tree = bifurcated(narrow=(1, 20.0, 12.0, 0.6))
    grave, own = with_marks(tree, 1, (22.0, 27.0)).lesions
    assert own.marked and not grave.marked
    assert grave.stenosis_percent == pytest.approx(60, abs=2)
    assert grave.lesion_mm[1] == own.lesion_mm[0] == pytest.approx(22, abs=0.6)


def test_a_marked_lesion_that_crosses_a_fork_has_a_part_in_each_branch():
    tree = bifurcated(narrow=(1, 5.0, 6.0, 0.5))
    sections = sections_of_radii(tree)
    for ends in (((0, 24.0), (1, 9.0)), ((1, 9.0), (0, 24.0))):
        marked, said = marked_lesions(tree, sections, two_views(), [mark(tree, *ends)])
        assert said == (
            "lesion 1 crosses a fork: its parts in branches 1, 2 are measured each by itself",
        )
        (trunk,), (main,) = marked[0], marked[1]
        assert sorted(marked) == [0, 1] and trunk == pytest.approx((24, 30), abs=0.6)
        assert main == pytest.approx((0, 9), abs=0.6)
        first, second, _ = tree_lumens(tree, sections, marked)
        # Each part against the reference of its own side of the fork.
        assert first.stenosis_percent < 2
        assert second.stenosis_percent == pytest.approx(50, abs=3)


def test_borders_that_bound_no_vessel_are_said_for_what_they_are():
    tree = bifurcated()
    sections = sections_of_radii(tree)
    for ends, words in (
        (((1, 15.0), (2, 15.0)), "lie on branches 2 and 3, neither of which leads to the other"),
        (((1, 15.0), (1, 15.0)), "both its borders are one place of branch 2"),
    ):
        marked, (said,) = marked_lesions(tree, sections, two_views(), [mark(tree, *ends)])
        assert not marked and said.startswith("lesion 1: ") and words in said


def test_a_mark_beside_every_vessel_is_said():
    tree = bifurcated()
    beside = LesionBorders(view=1, proximal=(2.0, 2.0), distal=(4.0, 2.0))
    marked, missed = marked_lesions(tree, sections_of_radii(tree), two_views(), (beside,))
    assert not marked and "lesion 1: no branch passes" in missed[0]


def straight(knots, diameters, sides=(), rough=0.0):
    """A vessel with such diameters at such arcs, and those that follow at its end."""
    z = np.arange(0, knots[-1] + 0.1, 0.25)
    wall = 1 + rough * np.sin(9 * z)
    made = [branch(np.stack([0 * z, 0 * z, z], 1), 0.5 * np.interp(z, knots, diameters) * wall)]
    nodes, s = [[0, 0, 0.0], [0, 0, z[-1]]], np.arange(0, 25.1, 0.5)
    for k, diameter in enumerate(sides):
        line = np.stack([(k - 0.5) * s, 0 * s, z[-1] + s], 1)
        made.append(branch(line, np.full(len(s), diameter / 2), 1, k + 2))
        nodes.append(line[-1])
    return tree_lumens(Tree(nodes_mm=np.array(nodes), branches=tuple(made)))[0]


def test_two_lesions_in_series_are_both_told():
    lumen = straight(
        (0, 10, 13, 16, 22, 25, 28, 50), (3, 3, 1.3, 3, 3, 1.1, 3, 3), rough=0.01
    )  # fmt: skip
    grave, second = lumen.lesions
    assert grave.minimal_at_mm == pytest.approx(25, abs=0.5)
    assert second.minimal_at_mm == pytest.approx(13, abs=0.5)
    assert (grave.minimal_diameter_mm, second.minimal_diameter_mm) == pytest.approx(
        (1.1, 1.3), abs=0.05
    )
    assert grave.stenosis_percent == lumen.stenosis_percent
    assert grave.lesion_mm == lumen.lesion_mm
    assert second.lesion_mm == pytest.approx((10.5, 15.5), abs=1)


def test_between_two_lesions_the_vessel_comes_half_of_the_way_back():
    arcs = (0, 10, 13, 16, 19, 22, 50)
    (one,) = straight(arcs, (3, 3, 1.2, 1.9, 1.2, 3, 3)).lesions
    assert one.lesion_mm[0] < 12 and one.lesion_mm[1] > 20
    first, second = sorted(
        straight(arcs, (3, 3, 1.2, 2.4, 1.2, 3, 3)).lesions, key=lambda one: one.minimal_at_mm
    )
    # They touch where the vessel is widest.
    assert first.lesion_mm[1] == second.lesion_mm[0] == pytest.approx(16, abs=0.5)


@pytest.mark.parametrize("sides", [(), (1.3, 1.2)])
@pytest.mark.parametrize(
    ("knots", "diameters"),
    [((0, 22, 23, 40), (3.6, 3.6, 1.8, 1.5)), ((0, 24, 40), (3.6, 3.6, 1.5))],
    ids=["step", "taper"],
)
def test_what_narrows_for_good_is_no_lesion(knots, diameters, sides):
    lumen = straight(knots, diameters, sides, rough=0.02)
    assert lumen.lesions == () and lumen.lesion_mm is None and lumen.lesion_length_mm == 0
    assert lumen.stenosis_percent < 15
    assert lumen.narrows_to_mm == pytest.approx(1.6, abs=0.2)


def test_a_lesion_above_a_step_is_told_alone():
    lumen = straight((0, 8, 11, 14, 28, 29, 45), (3.6, 3.6, 1.7, 3.6, 3.6, 1.6, 1.4))
    (lesion,) = lumen.lesions
    assert lesion.minimal_at_mm == pytest.approx(11, abs=0.5)
    assert lumen.minimal_at_mm == lesion.minimal_at_mm
    assert lumen.stenosis_percent == pytest.approx(53, abs=5)
    assert lumen.narrows_to_mm == pytest.approx(1.4, abs=0.1)


def test_a_lesion_ends_where_the_vessel_is_wider_for_the_last_time():
    share = np.array([1, 1, 0.8, 0.5, 0.7, 0.85, 0.6, 0.5, 0.4, 0.3])
    clear = np.ones(len(share), bool)
    again = np.arange(len(share)) < 5  # behind section 5 the vessel narrows for good
    assert narrowest(share, clear, again) == [(3, 1, 5)]
    assert [found[0] for found in narrowest(share, clear, clear)] == [9, 3]
    assert narrowest(share, clear, ~clear) == []


def test_a_lesion_at_the_end_recovers_in_the_branches_that_follow():
    lumen = straight((0, 24, 28, 30), (3, 3, 1.2, 1.2), sides=(2.4, 2.1))
    (lesion,) = lumen.lesions
    assert lesion.stenosis_percent == pytest.approx(60, abs=5)
    assert lumen.narrows_to_mm is None
    assert straight((0, 24, 28, 30), (3, 3, 1.2, 1.2)).lesions == ()


def test_a_lesion_before_a_vessel_that_is_small_all_along_is_told():
    lumen = straight((0, 30, 32, 34, 50), (3.4, 3.4, 1.0, 1.7, 1.5))
    (lesion,) = lumen.lesions
    assert lesion.minimal_at_mm == pytest.approx(32, abs=0.5)
    assert lumen.stenosis_percent > 35 and lumen.minimal_diameter_mm == pytest.approx(1, abs=0.1)

"""Vessel names: right where anatomy says so, none where it does not, and never sure and wrong."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.data.demo_case import demo_case
from gcar_deploy.measure.naming import (
    LEFT_FIGURES,
    RIGHT_FIGURES,
    probabilities,
    read_anatomy,
    readings,
    templates,
)
from gcar_deploy.measure.routes import end_radii, routes_from
from gcar_deploy.tree.tree import Tree, empty_tree
from tests.tree.shapes import branch, fork, tube


def curve(*knots, count=60):
    t, at = np.linspace(0, 1, len(knots)), np.linspace(0, 1, count)
    knots = np.asarray(knots, dtype=float)
    return np.stack([np.interp(at, t, knots[:, k]) for k in range(3)], axis=1)


def left_tree(radii=(2.2, 1.8, 1.6, 1.0), backwards=False):
    """LM, LAD round the front to the apex, LCx round the back, a diagonal; mm LPS."""
    ostium, fork_, first = (-30, 5, 38), (-15, 3, 39), (2, -18, 30)
    lines = [
        curve(ostium, fork_, count=20),
        curve(fork_, (-6, -8, 36), first, count=30),
        curve(fork_, (-10, 22, 35), (0, 40, 20), (8, 45, -5), count=70),
        curve(first, (6, -40, 5), (12, -45, -20), (22, -38, -38), count=70),
        curve(first, (20, -15, 18), (30, -12, 2), count=40),
    ]
    ends = [(0, 1), (1, 2), (1, 3), (2, 4), (2, 5)]
    of_branch = (radii[0], radii[1], radii[2], 0.9 * radii[1], radii[3])
    nodes = np.array([ostium, fork_, first, lines[2][-1], lines[3][-1], lines[4][-1]], float)
    branches = [
        branch(line[::-1], r, b, a) if backwards else branch(line, r, a, b)
        for line, r, (a, b) in zip(lines, of_branch, ends, strict=True)
    ]
    return Tree(nodes_mm=nodes, branches=tuple(branches))


def mapped(tree, matrix):
    matrix = np.asarray(matrix, dtype=float)
    return Tree(
        nodes_mm=tree.nodes_mm @ matrix.T,
        branches=tuple(
            dataclasses.replace(b, points_mm=b.points_mm @ matrix.T) for b in tree.branches
        ),
    )


def names(tree):
    return [None if name is None else name.name for name in read_anatomy(tree).names]


@pytest.mark.parametrize("backwards", [False, True])
def test_a_left_tree_as_anatomy_has_it(backwards):
    tree = left_tree(backwards=backwards)
    assert names(tree) == ["LM", "LAD", "LCx", "LAD", None]
    assert all(0.8 <= name.confidence <= 1 for name in read_anatomy(tree).names if name is not None)


def test_place_does_not_matter_and_a_reading_takes_all_branches_once():
    tree = left_tree()
    shift = np.array([40.0, -25.0, 60.0])
    moved = Tree(
        nodes_mm=tree.nodes_mm + shift,
        branches=tuple(
            dataclasses.replace(b, points_mm=b.points_mm + shift) for b in tree.branches
        ),
    )
    assert names(moved) == names(tree)


@pytest.mark.parametrize(
    "matrix",
    [
        np.diag([-1, 1, 1]),
        np.diag([1, -1, 1]),
        np.diag([1, 1, -1]),
        np.diag([-1, -1, 1]),
        [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
        np.diag([1, -1, -1]),
    ],
    ids=["left is right", "front is back", "up is down", "half turn", "axes in turn", "head first"],
)
def test_mirrored_and_turned_trees_have_no_name(matrix):
    assert not any(read_anatomy(mapped(left_tree(), matrix)).names)


def test_what_lacks_its_parts_has_no_name():
    tree = left_tree()
    lone = Tree(nodes_mm=tree.nodes_mm[[1, 2]], branches=(
        dataclasses.replace(tree.branches[1], start=0, end=1),))  # fmt: skip
    assert names(lone) == [None]
    # Without the trunk the fork of LAD and LCx is a bend in one line.
    without_trunk = Tree(nodes_mm=tree.nodes_mm[[1, 2, 3]], branches=(
        dataclasses.replace(tree.branches[1], start=0, end=1),
        dataclasses.replace(tree.branches[2], start=0, end=2)))  # fmt: skip
    assert names(without_trunk) == [None, None]
    assert not any(read_anatomy(fork()).names) and not any(read_anatomy(tube()).names)
    assert read_anatomy(empty_tree()).names == ()


def test_a_thick_border_fragment_is_not_the_ostium():
    """A side branch whose cut end is as thick as the ostium does not turn the names round."""
    tree = left_tree(radii=(2.2, 1.8, 1.6, 2.2))
    assert "LM" not in names(tree)[1:] and names(tree)[4] is None


def test_left_tree_right_of_a_right_tree_is_a_contradiction():
    left = left_tree()
    rca = curve((0, 0, 0), (-25, -12, -10), (-38, -5, -35), (-30, 25, -55), (-8, 45, -58))
    side = curve(rca[25], rca[25] + [-5, -20, -25], count=30)
    last = curve(rca[-1], rca[-1] + [10, -15, -14], count=20)

    def both(shift):
        line, twig, end = rca + shift, side + shift, last + shift
        n = len(left.nodes_mm)
        nodes = [line[0], line[25], line[-1], twig[-1], end[-1]]
        right = (
            branch(line[:26], 2.0, n, n + 1), branch(line[25:], 1.8, n + 1, n + 2),
            branch(twig, 1.0, n + 1, n + 3), branch(end, 1.1, n + 2, n + 4),
        )  # fmt: skip
        return Tree(nodes_mm=np.concatenate([left.nodes_mm, nodes]), branches=left.branches + right)

    beside = names(both(np.array([-45.0, -5.0, 30.0])))
    assert beside[:4] == ["LM", "LAD", "LCx", "LAD"] and set(beside[5:7]) <= {"RCA", None}
    if "RCA" in beside:
        assert not any(read_anatomy(both(np.array([95.0, -5.0, 30.0]))).names)


@pytest.mark.slow
def test_the_demo_patient():
    """A real left tree that nothing was fitted to: named rightly or not at all."""
    tree = demo_tree()
    found = dict(zip(range(len(tree.branches)), read_anatomy(tree).names, strict=True))
    assert all(name is None or name.name != "RCA" for name in found.values())
    lad = [tree.branches[k].points_mm for k, n in found.items() if n and n.name == "LAD"]
    lcx = [tree.branches[k].points_mm for k, n in found.items() if n and n.name == "LCx"]
    if lad and lcx:
        # The LAD lies in front of the LCx.
        assert np.concatenate(lad)[:, 1].mean() < np.concatenate(lcx)[:, 1].mean()


def demo_tree():
    from gcar_deploy.engine import Engine

    case = demo_case()
    return Engine(threads=1).reconstruct(case.pictures, case.geometry).tree


def test_probabilities_are_those_of_the_scores():
    tree = left_tree()
    found = readings(tree, np.arange(5))
    share = probabilities(found, templates())
    assert (share >= 0).all() and share.sum() <= 1
    scores = np.array(
        [templates()[r.side].scores(r.figures[None])[0] for r in found], dtype=np.float64
    )
    expected = np.exp(scores) / (np.exp(scores).sum() + 1)
    np.testing.assert_allclose(share, expected, rtol=1e-9)


def test_templates_have_a_row_for_every_figure():
    known = templates()
    for side, figures in (("left", LEFT_FIGURES), ("right", RIGHT_FIGURES)):
        template = known[side]
        assert len(template.mean) == len(template.sd) == len(template.weight) == len(figures)
        assert (template.sd > 0).all() and (template.weight >= 0).all()


def test_routes_run_from_the_ostium_to_every_end():
    tree = left_tree(backwards=True)
    ways = routes_from(tree, 0)
    assert [way.branches for way in ways] == [(0, 1, 3), (0, 2), (0, 1, 4)]
    for way in ways:
        np.testing.assert_allclose(way.points_mm[0], tree.nodes_mm[0])
        np.testing.assert_allclose(way.points_mm[-1], tree.nodes_mm[way.nodes[-1]])
        assert way.length_mm == pytest.approx(sum(tree.branches[k].length_mm for k in way.branches))
    assert max(end_radii(tree), key=end_radii(tree).get) == 0
    assert ways[0].until(2).branches == (0, 1)

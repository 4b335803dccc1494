"""Inlets of trees whose root is known: generated ones, a patient's, and shapes."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from gcar_deploy.measure.inlet import from_inlets, inlets, thin_ostia
from gcar_deploy.measure.naming import read_anatomy
from gcar_deploy.tree.tree import Tree, empty_tree
from tests.measure.test_naming import left_tree, mapped
from tests.tree.shapes import branch, fork, tube
from tests.tree.test_rooted import shuffled

NARCO = Path(os.environ.get("GCAR_DATA", "")) / "narco"


def begin_mm(tree):
    """Where the first branch begins."""
    return tree.branches[0].points_mm[0]


def runs_downstream(tree):
    """Every branch begins at an inlet or where one before it ends."""
    reached, roots = set(), 0
    for b in tree.branches:
        if b.start not in reached:
            roots += 1
        reached |= {b.start, b.end}
    return roots == len(np.unique(tree.components()))


@pytest.mark.parametrize("seed", range(4))
def test_the_thickest_free_end_is_the_inlet(seed):
    tree, _ = shuffled(fork(radius=(1.8, 1.3, 1.2)), seed)
    out = from_inlets(tree)
    np.testing.assert_array_equal(begin_mm(out), [0, 0, -20])
    assert [(b.start, b.end) for b in out.branches] == [(0, 1), (1, 2), (1, 3)]


def test_a_thick_fork_is_no_inlet_and_a_single_branch_begins_at_its_thick_end():
    middle = fork(radius=(1.0, 1.5, 1.2))
    np.testing.assert_array_equal(begin_mm(from_inlets(middle)), middle.branches[1].points_mm[-1])
    line = tube(length=30.0)
    narrow = dataclasses.replace(line.branches[0], radius_mm=np.linspace(1.0, 1.6, 31))
    out = from_inlets(dataclasses.replace(line, branches=(narrow,)))
    np.testing.assert_array_equal(begin_mm(out), [0, 0, 15])
    assert (np.diff(out.branches[0].radius_mm) < 0).all()


def test_an_ostium_marked_at_a_thin_end_is_worth_a_word():
    tree = fork(radius=(1.8, 1.3, 0.9))
    thick, tip = tree.branches[0].points_mm[0], tree.branches[2].points_mm[-1]
    assert thin_ostia(tree, np.array([thick, [500.0, 0, 0]])) == []
    (said,) = thin_ostia(tree, np.array([thick, tip]))
    assert said.startswith("ostium 2: the vessel is 1.8 mm wide there, and 3.6 mm at another")
    # A thick artery of its own says nothing of this one.
    apart = tree.moved(np.array([300.0, 0, 0]))
    assert thin_ostia(fork(radius=(1.8, 1.3, 1.3)), np.array([tip])) == []
    both = Tree(
        nodes_mm=np.concatenate([tree.nodes_mm, apart.nodes_mm]),
        branches=(
            *(dataclasses.replace(b, radius_mm=0 * b.radius_mm + 0.9) for b in tree.branches),
            *(dataclasses.replace(b, start=b.start + 4, end=b.end + 4) for b in apart.branches),
        ),
    )
    assert thin_ostia(both, np.array([tip])) == []


@pytest.mark.parametrize("seed", range(4))
def test_an_ostium_that_anatomy_names_wins_over_a_thicker_end(seed):
    """The diagonal's cut end is as thick as a border fragment's; the left main stays the inlet."""
    tree, place = shuffled(left_tree(radii=(2.0, 1.8, 1.6, 2.1)), seed)
    anatomy = read_anatomy(tree)
    assert anatomy.inlets == (place[0],)
    assert inlets(tree) == (place[0],)
    names = [n and n.name for n in read_anatomy(from_inlets(tree)).names]
    assert names[:3] == ["LM", "LAD", "LAD"]


@pytest.mark.parametrize(
    "matrix",
    [np.diag([-1, 1, 1]), np.diag([1, 1, -1]), [[0, 1, 0], [0, 0, 1], [1, 0, 0]]],
    ids=["left is right", "up is down", "axes in turn"],
)
def test_mirrored_and_turned_trees_keep_inlet_order_and_direction(matrix):
    tree = left_tree()
    there = from_inlets(mapped(tree, matrix))
    here = mapped(from_inlets(tree), matrix)
    for a, b in zip(there.branches, here.branches, strict=True):
        np.testing.assert_array_equal(a.points_mm, b.points_mm)
        assert (a.start, a.end) == (b.start, b.end)


def test_two_components_have_an_inlet_each_and_a_ring_has_one():
    a = fork()
    shift = np.array([60.0, 0, 0])
    b = [dataclasses.replace(x, points_mm=x.points_mm + shift, start=x.start + 4, end=x.end + 4)
         for x in a.branches]  # fmt: skip
    both = Tree(
        nodes_mm=np.concatenate([a.nodes_mm, a.nodes_mm + shift]), branches=(*b, *a.branches)
    )
    assert set(inlets(both)) == {0, 4} and runs_downstream(from_inlets(both))
    ring = Tree(
        nodes_mm=np.array([[0, 0, 0.0], [10, 0, 0]]),
        branches=(branch([[0, 0, 0], [5, 5, 0], [10, 0, 0]], [1.0, 1.2, 1.6], 0, 1),
                  branch([[10, 0, 0], [5, -5, 0], [0, 0, 0]], [1.5, 1.2, 1.0], 1, 0)),
    )  # fmt: skip
    assert inlets(ring) == (1,)
    assert [(b.start, b.end) for b in from_inlets(ring).branches] == [(0, 1), (0, 1)]
    assert from_inlets(empty_tree()).branches == ()


def test_rounding_does_not_turn_a_line_of_one_calibre():
    line = tube()
    for noise in (0.0, 1e-9, -1e-9):
        b = dataclasses.replace(line.branches[0], radius_mm=np.linspace(1.5, 1.5 + noise, 31))
        assert inlets(dataclasses.replace(line, branches=(b,))) == (0,)


@pytest.mark.slow
def test_generated_trees_begin_at_their_ostium():
    """23 of 28 whole and cut trees at least: what is left is cut, or as thick at its far end."""
    from gcar_export.scenes.trees import random_tree
    from gcar_export.studies.naming_cases import thinned

    right = total = 0
    for seed in range(60_000, 60_014):
        made = random_tree(np.random.default_rng(seed))
        for side, first in (("left", "LM"), ("right", "RCA")):
            vessels = made.sides(side).vessels
            (ostium,) = (v.points_mm[0] for v in vessels if v.name == first)
            tree = from_inlets(thinned(vessels))
            assert runs_downstream(tree)
            total += 1
            right += bool(np.linalg.norm(begin_mm(tree) - ostium) < 5.0)
    assert total == 28 and right >= 23


@pytest.mark.skipif(not NARCO.is_dir(), reason="the patient's centrelines are not here")
@pytest.mark.parametrize("file", ["lca_cl.vtp", "rca_cl.vtp"])
def test_a_patients_trees_begin_at_the_aorta(file):
    from gcar_export.scenes.make_demo import read_capsules
    from gcar_export.scenes.trees import Vessel
    from gcar_export.studies.naming_cases import thinned

    starts, _, radii, lines = read_capsules(NARCO / file)
    vessels = (Vessel("all", "left", starts, radii),)
    tree = from_inlets(thinned(vessels))
    # The lines set out in the aorta; all share their first point.
    gap = np.linalg.norm(tree.nodes_mm - lines[0][0], axis=1)
    assert tree.branches[0].start == np.argmin(gap) == 0 and gap[0] < 5.0
    assert runs_downstream(tree)

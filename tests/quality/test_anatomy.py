"""How a tree lies in its frame: figures that turn with the axes, and what is doubted."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.quality.anatomy import (
    MISTAKES,
    check_anatomy,
    mistake_odds,
    odd_figures,
    odd_signs,
)
from gcar_deploy.tree.tree import Branch, Tree

CARM = CArm(
    primary_angle_deg=-30, secondary_angle_deg=20, sod_mm=765, sdd_mm=1100, rows=512, columns=512,
    pixel_spacing_mm=(0.39, 0.39),
)  # fmt: skip
TILTED = (CARM, dataclasses.replace(CARM, primary_angle_deg=45, secondary_angle_deg=-25))
LEVEL = tuple(dataclasses.replace(carm, secondary_angle_deg=0) for carm in TILTED)


def curved(seed=1, count=4, scale=1.0):
    """Branches on bent ways."""
    rng = np.random.default_rng(seed)
    branches = []
    for k in range(count):
        t = np.linspace(0, 1, 40)[:, None]
        points = scale * (rng.normal(size=3) * 30 * t + rng.normal(size=3) * 30 * t**2)
        radius = np.linspace(2.0 - 0.3 * k, 0.8, len(t))
        branches.append(Branch(points_mm=points, radius_mm=radius, sigma_mm=0 * radius,
                               confidence=0 * radius + 1, start=0, end=k + 1))  # fmt: skip
    nodes = np.stack([np.zeros(3), *(b.points_mm[-1] for b in branches)])
    return Tree(nodes_mm=nodes, branches=tuple(branches))


def turned(tree, axes):
    branches = tuple(
        dataclasses.replace(b, points_mm=b.points_mm * np.array(axes)) for b in tree.branches
    )
    return Tree(nodes_mm=tree.nodes_mm * np.array(axes), branches=branches)


@pytest.mark.parametrize("axes", list(itertools.product((1, -1), repeat=3)))
def test_figures_change_their_signs_with_the_axes_and_nothing_else(axes):
    tree = curved()
    figures = odd_figures(tree)
    assert np.abs(figures).min() > 1e-4
    np.testing.assert_allclose(odd_figures(turned(tree, axes)), odd_signs(axes) * figures)


def test_place_size_and_direction_of_branches_do_not_matter():
    tree = curved()
    figures = odd_figures(tree)
    moved = tree.moved(np.array([5.0, -40.0, 3.0]))
    np.testing.assert_allclose(odd_figures(moved), figures, atol=1e-9)
    back = tuple(
        dataclasses.replace(b, points_mm=b.points_mm[::-1], radius_mm=b.radius_mm[::-1])
        for b in tree.branches
    )
    other = dataclasses.replace(tree, branches=back)
    np.testing.assert_allclose(odd_figures(other), figures, atol=1e-9)


def test_the_bend_points_to_the_inside_of_an_arc():
    t = np.linspace(0, np.pi, 80)
    points = 40 * np.column_stack([np.cos(t), np.sin(t), 0 * t])
    full = np.ones(len(t))
    arc = Branch(points_mm=points, radius_mm=full, sigma_mm=full, confidence=full, start=0, end=1)
    bend = odd_figures(Tree(nodes_mm=points[[0, -1]], branches=(arc,)))[16:19]
    assert bend[1] < -0.1 and np.abs(bend[[0, 2]]).max() < 1e-6


def test_what_two_mistakes_make_of_a_tree_is_told_apart():
    tree = curved()
    odds = mistake_odds(tree, TILTED)
    assert set(odds) == {"turned", "signs"} and set(mistake_odds(tree, LEVEL)) == set(MISTAKES)
    again = mistake_odds(turned(tree, MISTAKES["turned"][0]), TILTED)
    assert again["turned"] == pytest.approx(-odds["turned"])


def test_a_part_is_not_judged():
    assert mistake_odds(curved(scale=0.2), TILTED) == {}
    assert check_anatomy(curved(scale=0.2), TILTED) == []


def test_generated_trees_pass_and_their_mirror_images_do_not():
    fitting = pytest.importorskip("gcar_export.studies.anatomy_fit", reason="needs export")
    from gcar_export.scenes.trees import random_tree

    rng = np.random.default_rng(71_009)
    trees = [fitting.spoilt(random_tree(rng), rng) for _ in range(12)]
    said = [check_anatomy(tree, TILTED) for tree in trees]
    assert sum(map(bool, said)) <= 1
    wrong = [check_anatomy(turned(tree, (-1, -1, -1)), TILTED) for tree in trees]
    assert sum("turned by 180 degrees?" in found[0] for found in wrong if found) >= 10

"""A tree that ends in the middle of lines of every picture is doubted; a true one is not."""

import dataclasses

import numpy as np
import pytest
from skimage.morphology import skeletonize

from gcar_deploy.quality.hidden_ends import check_hidden_ends
from gcar_deploy.tree.tree import Tree
from tests.hard.phantoms import PAIR, path_of, seven, straight
from tests.tubes.scenes import vessel_image

WHOLE = straight(length=60.0)


def views(tree):
    pictures = [vessel_image(view, path_of(tree, view)) for view in PAIR]
    return [dataclasses.replace(p, skeleton=skeletonize(p.path_mm > 1.0)) for p in pictures]


def short(branch, first, last):
    own = slice(first, last)
    kept = {name: getattr(branch, name)[own] for name in
            ("points_mm", "radius_mm", "sigma_mm", "confidence")}  # fmt: skip
    return dataclasses.replace(branch, covariance_mm2=None, **kept)


def torn(gap):
    """The vessel in two halves, each ``gap`` points (about mm) shorter at either end."""
    branch = WHOLE.branches[0]
    half = len(branch) // 2
    parts = short(branch, gap, half - gap), short(branch, half + gap, len(branch) - gap)
    nodes = np.concatenate([part.points_mm[[0, -1]] for part in parts])
    numbered = [
        dataclasses.replace(part, start=2 * k, end=2 * k + 1) for k, part in enumerate(parts)
    ]
    return Tree(nodes_mm=nodes, branches=tuple(numbered))


@pytest.mark.parametrize("tree", [WHOLE, seven()])
def test_a_true_tree_is_not_doubted(tree):
    assert check_hidden_ends(tree, views(tree)) == []


def test_ends_in_the_middle_of_a_line_are_told():
    pieces = torn(10)
    (said,) = check_hidden_ends(pieces, views(WHOLE))
    assert said.startswith("4 of the tree's 4 ends are seen as an end in no view")
    # A third picture that shows the pieces as they are speaks for them.
    assert check_hidden_ends(pieces, [*views(WHOLE), views(pieces)[0]]) == []


def test_one_end_that_is_hidden_is_no_reason():
    branch = WHOLE.branches[0]
    part = short(branch, 0, int(0.7 * len(branch)))
    tree = Tree(
        nodes_mm=part.points_mm[[0, -1]], branches=(dataclasses.replace(part, start=0, end=1),)
    )
    assert check_hidden_ends(tree, views(WHOLE)) == []

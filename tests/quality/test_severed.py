"""Pieces that end where a catheter was left out are asked about; a tree in one piece is not."""

import dataclasses

import cv2
import numpy as np

from gcar_deploy.quality.severed import check_severed
from gcar_deploy.tree.tree import Tree
from tests.hard.phantoms import PAIR, path_of, straight
from tests.tubes.scenes import vessel_image

UPPER, LOWER = straight(length=40.0, middle=(0, 0, 22)), straight(length=40.0, middle=(0, 0, -22))


def together():
    lower = [dataclasses.replace(b, start=b.start + 2, end=b.end + 2) for b in LOWER.branches]
    return Tree(
        nodes_mm=np.concatenate([UPPER.nodes_mm, LOWER.nodes_mm]),
        branches=(*UPPER.branches, *lower),
    )


def views(tree, *ends_mm):
    """Pictures of which a straight line between two points was left out."""
    out = []
    for view in PAIR:
        left = np.zeros((view.rows, view.columns), np.uint8)
        a, b = (tuple(int(v) for v in view.project(np.array([e]))[0][0]) for e in ends_mm)
        cv2.line(left, a, b, 1, 2)
        image = vessel_image(view, path_of(tree, view), calibrated=False)
        out.append(dataclasses.replace(image, kind="raw", catheter=left > 0))
    return out


def test_a_line_that_cuts_the_tree_is_told():
    tree = together()
    (said,) = check_severed(tree, views(tree, (-30.0, -30.0, 0.0), (30.0, 30.0, 0.0)))
    assert said.startswith("the tree falls into 2 pieces, and one ends where what ")


def test_a_line_elsewhere_or_at_the_inlet_of_one_piece_is_not():
    tree = together()
    assert check_severed(tree, views(tree, (20.0, 20.0, -20.0), (20.0, 20.0, 20.0))) == []
    assert check_severed(UPPER, views(UPPER, (0.0, 0.0, 2.0), (20.0, 20.0, 2.0))) == []
    bare = [dataclasses.replace(v, catheter=None) for v in views(tree, (0, 0, 0), (1, 1, 0))]
    assert check_severed(tree, bare) == []

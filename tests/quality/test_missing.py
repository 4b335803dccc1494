"""A vessel that one picture shows and the tree lacks is told; a short or explained one is not."""

import dataclasses
import functools
import re

import numpy as np
import pytest
from skimage.morphology import skeletonize

from gcar_deploy.quality.missing import check_missing
from tests.hard.phantoms import PAIR, both, path_of, straight
from tests.tubes.scenes import vessel_image

FIRST = straight(length=60.0)


def picture(tree, number=0):
    image = vessel_image(PAIR[number], path_of(tree, PAIR[number]))
    return dataclasses.replace(image, skeleton=skeletonize(image.path_mm > 0.8))


def with_second(length):
    return both(FIRST, straight((1.0, 0.2, 0.1), length, 1.2, (0, 0, 20)))


def test_a_vessel_that_the_tree_lacks_is_told():
    whole = with_second(60.0)
    (said,) = check_missing(FIRST, [picture(FIRST, 1), picture(whole)])
    assert said.startswith("view 1: a line of ") and "is explained by no branch" in said
    assert check_missing(whole, [picture(whole), picture(whole, 1)]) == []


@pytest.mark.parametrize("length", [0.0, 12.0])
def test_a_short_one_is_no_reason(length):
    shown = picture(with_second(length) if length else FIRST, 1)
    assert check_missing(FIRST, [shown]) == []


def _twigs(count):
    """Thin branches of 10 mm beside a vessel, which lie apart in both pictures."""
    places = [(0, 12, -24 + 16 * k) for k in range(count)]
    return functools.reduce(both, [straight((1, 0, 0), 10.0, 0.8, at) for at in places], FIRST)


def test_many_short_ones_are_told_together():
    (said,) = check_missing(FIRST, [picture(FIRST, 1), picture(_twigs(4))])
    found = re.fullmatch(r"view 1: (\d+) mm of its lines \((\d+)%\) are explained by no .*", said)
    assert found
    lost, share = map(int, found.groups())
    # 40 mm beside one of 60 mm, all foreshortened.
    assert 30 <= lost <= 42
    assert 36 <= share <= 50
    assert check_missing(FIRST, [picture(FIRST, 1), picture(_twigs(1))]) == []


def test_where_lines_may_be_background_they_are_not():
    grey = dataclasses.replace(picture(_twigs(4)), kind="raw", path_error=0.25)
    assert check_missing(FIRST, [picture(FIRST, 1), grey]) == []


def test_a_picture_without_lines_says_nothing():
    empty = picture(FIRST)
    bare = dataclasses.replace(empty, skeleton=np.zeros_like(empty.skeleton))
    assert check_missing(FIRST, [bare]) == []

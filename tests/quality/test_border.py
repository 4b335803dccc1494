"""A line that runs out of a grey picture is asked about; vessels inside it are not."""

import dataclasses

import pytest

from gcar_deploy.quality.border import check_border
from tests.hard.phantoms import PAIR, path_of, straight
from tests.tubes.scenes import vessel_image


def views(tree, **changes):
    seen = [vessel_image(view, path_of(tree, view), calibrated=False) for view in PAIR]
    return [dataclasses.replace(view, **changes) for view in seen]


@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 0, 0.2)])
def test_a_line_through_the_border_is_asked_about(axis):
    tree = straight(axis, length=400.0)
    (said,) = check_border(tree, views(tree, kind="raw"))
    assert said.startswith("branch 1 runs out of view")


def test_vessels_inside_and_short_ones_are_not():
    for tree in (straight(length=60.0), straight((1, 0, 0), length=15.0, middle=(0, 0, 70))):
        assert check_border(tree, views(tree, kind="raw")) == []


def test_masks_and_calibrated_pictures_hold_what_was_let_in():
    tree = straight((0, 0, 1), length=400.0)
    assert check_border(tree, views(tree, kind="mask")) == []
    assert check_border(tree, views(tree, kind="path_length", path_error=0.0)) == []

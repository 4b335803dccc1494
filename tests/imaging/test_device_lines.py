"""Which parts of a line the network's word makes a device, and which it does not."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.errors import ImageError
from gcar_deploy.imaging.device_lines import device_parts
from gcar_deploy.imaging.stray_lines import likely_devices, without_line
from tests.imaging.test_stray_lines import APART, CROSSING, MIDDLE, VESSEL, covers, view_of

LEVEL = 0.7


def parts(view, *strokes, said=0.9, valid=None):
    """Parts of the view's line where the network says ``said`` of the strokes."""
    device = np.zeros(view.mask.shape, np.float32)
    for stroke in strokes:
        device[stroke] = said
    return list(device_parts(view.skeleton, device, view.valid if valid is None else valid, LEVEL))


#: what the network calls a device in these: the left of the line across
LEFT = CROSSING[0], slice(0, MIDDLE - 8)


def test_a_device_from_the_border_goes_and_what_it_feeds_stays():
    view = view_of(CROSSING)
    (part,) = parts(view, LEFT)
    assert covers(part, LEFT) > 0.9 and not part[:, MIDDLE - 2 :].any()
    assert parts(view, LEFT, said=0.6) == []


def test_a_side_branch_that_leaves_the_field_is_for_the_views_to_decide():
    view = view_of(VESSEL, LEFT, (CROSSING[0], slice(LEFT[1].stop, MIDDLE)))
    assert parts(view, LEFT) == []
    device = np.zeros(view.mask.shape, np.float32)
    device[LEFT] = 0.9
    (part,) = device_parts(view.skeleton, device, None, LEVEL)
    assert covers(part, LEFT) > 0.9 and not part[:, MIDDLE - 2 :].any()


def test_a_stretch_within_the_tree_stays_whatever_is_said_of_it():
    view = view_of(CROSSING)
    inside = CROSSING[0], slice(60, 140)
    assert parts(view, inside) == []
    (part,) = parts(view_of(VESSEL, APART), APART)  # it hangs on nothing
    assert covers(part, APART) > 0.8


def test_the_border_is_that_of_the_field():
    view = view_of(CROSSING)
    inside = CROSSING[0], slice(40, 120)
    valid = view.valid.copy()
    valid[:, :40] = False
    view = dataclasses.replace(view, skeleton=view.skeleton & valid)
    assert parts(view, inside) == []
    (part,) = parts(view, inside, valid=valid)
    assert covers(part, inside) > 0.8


def test_a_speck_is_no_device_and_without_a_line_there_is_none():
    view = view_of(CROSSING)
    assert parts(view, (CROSSING[0], slice(0, 12))) == []
    nothing = np.zeros_like(view.skeleton)
    assert list(device_parts(nothing, np.ones(nothing.shape, np.float32), ~nothing, LEVEL)) == []


def test_the_word_goes_with_the_view():
    view = view_of(VESSEL, CROSSING)
    assert list(likely_devices(view, LEVEL)) == []  # no network was asked
    device = np.zeros(view.mask.shape, np.float32)
    device[CROSSING[0], : MIDDLE - 8] = 0.8
    (line,) = likely_devices(dataclasses.replace(view, device=device), LEVEL)
    left = without_line(view, line)
    assert left is not None and left.catheter is not None
    assert left.catheter[CROSSING][:, : MIDDLE - 12].mean() > 0.9
    assert left.mask[VESSEL].mean() > 0.95
    with pytest.raises(ImageError, match="has"):
        dataclasses.replace(view, device=device[1:])

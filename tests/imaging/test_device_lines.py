"""Which parts of a line are a device by the network's word, and how its word reaches them."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from gcar_deploy.errors import ImageError
from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.device_lines import device_map, device_parts, is_between
from gcar_deploy.imaging.learned import devices
from gcar_deploy.imaging.net import SIDE, Seen
from gcar_deploy.imaging.stray_lines import likely_devices, without_line
from tests.imaging.test_stray_lines import CROSSING, MIDDLE, VESSEL, covers, view_of

LEVEL = 0.7
#: what the network calls a device in these: the left of the line across
LEFT = CROSSING[0], slice(0, MIDDLE - 8)


def parts(view, *strokes, said=0.9):
    """Parts of the view's line where the network says ``said`` of the strokes."""
    device = np.zeros(view.mask.shape, np.float32)
    for stroke in strokes:
        device[stroke] = said
    return list(device_parts(view.skeleton, device, LEVEL))


def test_a_device_goes_and_what_it_feeds_stays():
    view = view_of(CROSSING)
    (part,) = parts(view, LEFT)
    assert covers(part, LEFT) > 0.9 and not part[:, MIDDLE - 2 :].any()
    assert parts(view, LEFT, said=0.6) == []


def test_what_is_less_sure_goes_with_what_is_sure():
    view = view_of(CROSSING)
    device = np.zeros(view.mask.shape, np.float32)
    device[LEFT], device[LEFT[0], :20] = 0.5, 0.9
    (part,) = device_parts(view.skeleton, device, LEVEL)
    assert covers(part, LEFT) > 0.9
    device[LEFT[0], 40:50] = 0.3  # the surest part ends here
    (part,) = device_parts(view.skeleton, device, LEVEL)
    assert part[:, :38].any() and not part[:, 41:].any()


def test_the_surest_part_comes_first_and_a_speck_is_none():
    view = view_of(VESSEL, CROSSING)
    first, second = parts(view, (CROSSING[0], slice(0, 30)), (LEFT[0], slice(60, MIDDLE - 8)))
    assert first.sum() > second.sum()
    assert parts(view, (CROSSING[0], slice(20, 24))) == []
    nothing = np.zeros_like(view.skeleton)
    assert list(device_parts(nothing, np.ones(nothing.shape, np.float32), LEVEL)) == []


class _LeftOf:
    """In place of the network: what lies left of a column is a device; it keeps what it is told."""

    def __init__(self, column: float) -> None:
        self.column = column

    def devices(self, lines):
        self.lines = lines
        return np.where(lines.pixels[:, 1] < self.column, 0.9, 0.1).astype(np.float32)


@pytest.mark.parametrize("side", [SIDE, 448])
def test_its_word_comes_back_to_where_the_line_is(side):
    """Lines are looked at at one size, whatever that of the picture; chords go with it."""
    mask = np.zeros((side, side), np.uint8)
    cv2.line(mask, (20, side // 3), (side - 20, side // 2), 1, 7)
    reach = mask > 0
    line = skel.skeletonize(reach)
    chord = np.where(reach, np.float32(7), np.float32(0))
    seen = Seen(reach.astype(np.float32), chord)
    net = _LeftOf(SIDE / 2)
    told = device_map(net, np.zeros((3, side, side), np.float32), seen, line, reach, ~reach & reach)
    left = np.indices(reach.shape)[1] < side / 2 - 3
    right = np.indices(reach.shape)[1] > side / 2 + 3
    assert (told[reach & left] > 0.8).all() and (told[reach & right] < 0.2).all()
    assert not told[~reach].any()
    scale = SIDE / side
    assert sum(net.lines.lengths) == pytest.approx(line.sum() * scale, rel=0.1)
    # log(1 + chord) in the middle of the line
    middle = net.lines.points[:, 4 * 17 + 8]
    assert np.median(middle) == pytest.approx(np.log1p(7 * scale), rel=0.05)


def test_what_was_erased_within_the_field_is_no_border():
    """Beside what was erased a line does not come from outside; at the collimator it does."""
    line = np.zeros((SIDE, SIDE), bool)
    line[170, 120:230] = True
    reach = cv2.dilate(line.astype(np.uint8), np.ones((5, 5))) > 0
    seen = Seen(reach.astype(np.float32), np.where(reach, np.float32(5), np.float32(0)))
    points = []
    for erased in (None, (slice(160, 182), slice(90, 115)), (slice(0, 352), slice(0, 115))):
        holes = np.zeros_like(line)
        if erased is not None:
            holes[erased] = True
        net = _LeftOf(0)
        device_map(net, np.zeros((3, SIDE, SIDE), np.float32), seen, line, reach, holes)
        points.append(net.lines.points)
    np.testing.assert_array_equal(points[0], points[1])
    assert np.abs(points[0] - points[2]).max() > 0.5


def test_where_lines_cross_the_vessel_goes_on():
    view = view_of(VESSEL, CROSSING)
    reach, line = view.mask, view.skeleton
    maps = np.zeros((3, *reach.shape), np.float32)

    class ByRow:
        def devices(self, lines):
            scale = SIDE / np.sqrt(reach.size)
            row = lines.pixels[:, 0] / scale
            across = (row >= CROSSING[0].start - 2) & (row < CROSSING[0].stop + 2)
            return np.where(across, 0.95, 0.05).astype(np.float32)

    seen = Seen(reach.astype(np.float32), reach.astype(np.float32))
    told = device_map(ByRow(), maps, seen, line, reach, ~reach & reach)
    assert covers(told > 0.9, LEFT) > 0.8


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


def test_a_blob_at_the_tip_of_a_catheter_is_a_vessel_seen_end_on():
    """The network calls all of the line a device, up to the middle of the blob."""
    reach = np.zeros((SIDE, SIDE), bool)
    reach[200:205, :200] = True
    row, col = np.indices(reach.shape)
    blob = np.hypot(row - 202, col - 200) <= 12
    reach |= blob
    reach[202:340, 198:203] = True  # and the vessel goes on
    line = skel.skeletonize(reach)
    told = np.zeros(reach.shape, np.float32)
    told[199:206, :200] = 0.99
    nothing = np.zeros_like(reach)
    found = devices(told, reach, line, reach.astype(np.float32), nothing)
    assert found[200:205, 5:170].all()
    assert not found[np.hypot(row - 202, col - 200) <= 8].any() and not found[230:].any()


def lines(*ways):
    """One line a way of (col, row) corners, a pixel wide, as (200, 200) bool each."""
    out = []
    for way in ways:
        canvas = np.zeros((200, 200), np.uint8)
        cv2.polylines(canvas, [np.array(way, np.int32)], isClosed=False, color=1)
        out.append(canvas > 0)
    return out


STRETCH = [(80, 100), (120, 100)]
BEFORE, AFTER = [(20, 96), (79, 100)], [(121, 100), (180, 104)]


@pytest.mark.parametrize(("rest", "one"), [
    # What goes on at both ends is one line with it; at one end it may be a wire in a vessel.
    ([BEFORE, AFTER], True), ([BEFORE], False), ([], False),
    # Vessels that a lead crosses do not go on from its ends, nor does what turns off.
    ([[(79, 20), (79, 180)], [(121, 20), (121, 180)]], False),
    ([BEFORE, [(121, 100), (150, 150)]], False),
    # Three lines meet in it.
    ([BEFORE, [(121, 100), (150, 150)], [(100, 95), (100, 20)]], True),
    ([[(79, 100), (60, 20)], [(121, 100), (150, 150)], [(100, 95), (180, 60)]], True),
])  # fmt: skip
def test_what_vessels_go_on_from_is_no_device(rest, one):
    (stretch,) = lines(STRETCH)
    if len(rest) == 3:
        stretch |= lines([(100, 100), (100, 97)])[0]
    others = np.any(lines(*rest), axis=0) if rest else np.zeros_like(stretch)
    half = np.full(stretch.shape, 3, np.float32)
    assert is_between(stretch, others & ~stretch, half, 0.5) is one


@pytest.mark.parametrize(("wider", "one"), [(1.3, True), (2.0, False), (0.5, False)])
def test_a_device_between_vessels_of_other_width_stays_one(wider, one):
    (stretch,), rest = lines(STRETCH), np.any(lines(BEFORE, AFTER), axis=0)
    half = np.where(stretch, 3, np.float32(3 * wider))
    assert is_between(stretch, rest & ~stretch, half, 0.5) is one


def test_a_stretch_of_vessel_that_the_network_takes_for_a_device_stays():
    picture = np.zeros((352, 352), np.float32)
    whole = np.zeros((352, 352), np.uint8)
    cv2.polylines(whole, [np.array([(60, 170), (290, 180)], np.int32)], False, 1)
    line, reach = whole > 0, cv2.dilate(whole, np.ones((7, 7), np.uint8)) > 0
    cv2.polylines(picture, [np.array([(60, 170), (290, 180)], np.int32)], False, 1.0, 7)
    told = np.zeros((352, 352), np.float32)
    holes = np.zeros_like(line)
    told[:, 150:200] = 0.99
    assert not devices(told, reach, line, picture, holes)[:, 155:195].any()
    told[:, 200:] = 0.99
    assert devices(told, reach, line, picture, holes)[:, 155:285].any()

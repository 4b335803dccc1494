from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gcar_deploy.imaging import skeleton as skel


def _strokes(points, width, size=80):
    mask = np.zeros((size, size), np.uint8)
    cv2.polylines(mask, [np.array(points, np.int32)], False, 1, width)
    return mask > 0


_points = st.lists(st.tuples(st.integers(0, 79), st.integers(0, 79)), min_size=2, max_size=6)


def _count(mask, connectivity):
    return cv2.connectedComponents(mask.astype(np.uint8), connectivity=connectivity)[0]


def _parts_and_holes(mask):
    return _count(mask, 8), _count(np.pad(~mask, 1, constant_values=True), 4)


def _needless_blocks(line):
    """2x2 blocks one of whose pixels, no line's end, could go and change no part or hole."""
    line = np.pad(line, 2)
    whole = _parts_and_holes(line)
    needless = 0
    for y, x in np.argwhere(line[1:, 1:] & line[:-1, 1:] & line[1:, :-1] & line[:-1, :-1]):
        for row, column in ((y, x), (y, x + 1), (y + 1, x), (y + 1, x + 1)):
            without = line.copy()
            without[row, column] = False
            end = line[row - 1 : row + 2, column - 1 : column + 2].sum() <= 2
            if not end and _parts_and_holes(without) == whole:
                needless += 1
                break
    return needless


@settings(max_examples=80, deadline=None)
@given(_points, st.integers(1, 9))
@example([(0, 53), (50, 67), (0, 55)], 1)  # a wedge that crosses itself three times
def test_thin_subset_and_as_many_parts(points, width):
    mask = _strokes(points, width)
    line = skel.skeletonize(mask)
    assert not (line & ~mask).any()
    assert _parts_and_holes(mask) == _parts_and_holes(line)
    # one pixel wide: lines that cross may need a block of four, hardly any other has one
    assert _needless_blocks(line) <= max(4, 0.02 * line.sum())


def test_one_pixel_vessel_and_stub_stay():
    mask = np.zeros((40, 40), bool)
    mask[20, 3:37] = True
    np.testing.assert_array_equal(skel.skeletonize(mask), mask)
    stub = np.zeros((40, 40), bool)
    stub[5, 5:7] = True
    assert skel.skeletonize(stub).sum() >= 1


def test_reaches_the_border():
    mask = np.zeros((40, 60), bool)
    mask[18:23, :] = True
    line = skel.skeletonize(mask)
    assert line[:, :3].any() and line[:, -3:].any()
    border = np.zeros((40, 60), bool)
    border[0, :] = True
    assert skel.skeletonize(border).sum() >= 58


def test_prune_cuts_spurs_and_weak_ends_only():
    line = np.zeros((60, 100), bool)
    line[30, 5:95] = True
    line[26:30, 50] = True  # a spur of 4 pixels
    line[10:30, 70] = True  # a branch of 20
    strength = np.ones(line.shape, np.float32)
    kept = skel.prune(line, strength, 8, 0.0)
    assert not kept[26:29, 50].any() and kept[12:28, 70].all() and kept[30, 10:90].sum() >= 78
    strength[:25, 70] = 0.0
    assert not skel.prune(line, strength, 8, 0.5)[12:28, 70].any()


def test_strong_parts_and_spread():
    line = np.zeros((50, 50), bool)
    line[10, 5:45] = True
    line[40, 5:8] = True
    ones = np.ones(line.shape, np.float32)
    kept = skel.strong_parts(line, ones, 0.2)
    assert kept[10].sum() == 40 and not kept[40].any()
    distance, (carried,) = skel.spread(kept, (3 * ones,), 2.0)
    np.testing.assert_allclose(carried, 3.0, rtol=1e-4)
    assert abs(distance[30, 20] - 20) < 0.2


@pytest.mark.parametrize("seed", range(40))
def test_thinning_is_that_of_opencv(seed):
    """The same rule, pixel by pixel of the whole picture."""
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.random(rng.integers(1, 70, 2)), (0, 0), rng.uniform(0.3, 4))
    mask = noise > np.quantile(noise, rng.uniform(0.1, 0.9))
    # The filter leaves the outermost pixels alone.
    padded = cv2.copyMakeBorder(mask.astype(np.uint8) * 255, 2, 2, 2, 2, cv2.BORDER_CONSTANT)
    thin = cv2.ximgproc.thinning(padded, thinningType=cv2.ximgproc.THINNING_GUOHALL)
    np.testing.assert_array_equal(skel.skeletonize(mask), thin[2:-2, 2:-2] > 0)


@pytest.mark.parametrize("end", [(60, 10), (10, 60), (60, 60), (60, 35)])
def test_a_line_is_as_long_whichever_way_it_runs(end):
    line = skel.skeletonize(_strokes([(10, 10), end], 1))
    length = np.hypot(*(np.array(end) - 10))
    # Steps of a line between the two diagonals are longer than the line by 8 % at most.
    assert 0.97 * length < skel.arc_length(line).sum() < 1.1 * length


def test_the_order_in_memory_changes_nothing():
    mask = np.zeros((40, 60), bool)
    mask[10:20, 15:45] = True
    line = skel.skeletonize(mask)
    assert line.sum() < 60
    np.testing.assert_array_equal(skel.skeletonize(np.asfortranarray(mask)), line)


def test_circles_on_a_line_hold_the_disc_at_its_end_and_no_branch():
    """A vessel seen end-on, and a twig beside it."""
    row, col = np.indices((80, 120))
    disc = np.hypot(row - 40, col - 30) <= 12
    vessel = (np.abs(row - 40) <= 5) & (col >= 30) & (col < 110)
    twig = (np.abs(col - 80) <= 1) & (row >= 40) & (row < 70)
    line = np.zeros(disc.shape, bool)
    line[40, 30:106] = True
    found = skel.inscribed(disc | vessel | twig, line)
    assert found[disc & (np.hypot(row - 40, col - 30) <= 11)].all()
    assert found[vessel & (col < 104)].mean() > 0.97
    assert not found[twig & (row > 48)].any()
    assert not skel.inscribed(disc, np.zeros_like(disc)).any()

"""Lines go on straight through forks and crossings, and nowhere else."""

from __future__ import annotations

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.line_chains import chains
from gcar_deploy.types import Mask


def _drawn(*lines: tuple[tuple[int, int], tuple[int, int]], wide: int = 1) -> Mask:
    canvas = np.zeros((120, 120), np.uint8)
    for start, end in lines:
        cv2.line(canvas, start, end, 1, wide)
    return skel.skeletonize(canvas > 0)


def _ends(line: Mask) -> set[frozenset[tuple[int, int]]]:
    found = chains(line, np.full(line.shape, 3.0))
    return {frozenset((chain[0], chain[-1])) for chain in found if len(chain) > 8}


def _near(found: set[frozenset[tuple[int, int]]], one: tuple[int, int], other: tuple[int, int]):
    """Whether some chain runs from about ``one`` to about ``other``, both (row, col)."""
    return any(
        all(min(np.hypot(*np.subtract(end, asked)) for end in pair) < 6 for asked in (one, other))
        for pair in found
    )


def test_two_lines_that_cross_are_two_lines() -> None:
    for wide in (1, 5):
        found = _ends(_drawn(((10, 60), (110, 60)), ((30, 10), (90, 110)), wide=wide))
        assert len(found) == 2
        assert _near(found, (60, 10), (60, 110)) and _near(found, (10, 30), (110, 90))


def test_a_line_goes_on_past_a_side_branch() -> None:
    found = _ends(_drawn(((10, 60), (110, 60)), ((60, 60), (80, 110))))
    assert len(found) == 2 and _near(found, (60, 10), (60, 110))


def test_a_fork_without_a_straight_way_ends_its_lines() -> None:
    found = _ends(_drawn(((60, 60), (60, 10)), ((60, 60), (17, 85)), ((60, 60), (103, 85))))
    assert len(found) == 3


def test_a_ring_is_one_line() -> None:
    canvas = np.zeros((120, 120), np.uint8)
    cv2.circle(canvas, (60, 60), 30, 1, 1)
    line = skel.skeletonize(canvas > 0)
    (ring,) = chains(line, np.full(line.shape, 3.0))
    assert len(ring) == line.sum() and len(set(ring)) == len(ring)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(st.tuples(*[st.integers(2, 117)] * 2), st.tuples(*[st.integers(2, 117)] * 2)),
        min_size=1, max_size=6,
    ),
    st.integers(1, 6),
)  # fmt: skip
def test_lines_are_made_of_the_skeleton_and_of_each_stretch_once(
    lines: list[tuple[tuple[int, int], tuple[int, int]]], wide: int
) -> None:
    line = _drawn(*lines, wide=wide)
    found = chains(line, np.full(line.shape, float(wide)))
    pixels = [pixel for chain in found for pixel in chain]
    assert all(line[pixel] for pixel in pixels)
    inner = [p for p in pixels if skel.neighbours(line)[p] == 2]
    assert len(inner) == len(set(inner))
    forks = cv2.dilate((line & (skel.neighbours(line) > 2)).astype(np.uint8), np.ones((5, 5)))
    far = line & (forks == 0) & (skel.neighbours(line) > 0)
    missed = {(int(r), int(c)) for r, c in np.argwhere(far)} - set(pixels)
    # Only a bridge between two forks is left out, and that is short.
    assert len(missed) <= (2 * wide + 8) * len(lines) ** 2

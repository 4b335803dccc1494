"""Widths of outlines beside a narrow place, against outlines of a surface of points."""

import numpy as np
import pytest

from gcar_deploy.measure.silhouette import covered

ARC = np.arange(0.0, 40.0, 0.4)
SD = 0.05


def radii(neck_mm, wide=1.6, narrow=0.4):
    return np.where(np.abs(ARC - 20.0) < neck_mm / 2, narrow, wide)


def outline(radius, sine):
    """Half-width at each place, of a straight vessel whose axis meets the rays at an angle."""
    angle = np.linspace(0, 2 * np.pi, 721)
    fine = np.arange(0.0, 40.0, 0.05)
    r = np.interp(fine, ARC, radius)[:, None]
    along = fine[:, None] * sine + r * np.sin(angle) * np.sqrt(1 - sine**2)
    across = r * np.cos(angle)
    return np.array([across[np.abs(along - s * sine) < 0.1].max() for s in ARC])


@pytest.mark.parametrize("sine", [0.3, 0.45, 0.6, 0.75])
@pytest.mark.parametrize("neck_mm", [3.0, 6.0])
def test_what_shoulders_cover_says_nothing_and_the_neck_seen_from_the_side_does(neck_mm, sine):
    radius = radii(neck_mm)
    seen = np.stack([outline(radius, 1.0), outline(radius, sine)])
    hidden = seen[1] > 1.2 * seen[0]
    assert hidden.any()
    found = covered(ARC, seen, np.full(seen.shape, SD), np.full(seen.shape, [[1.0], [sine]]))
    assert not found[0].any()
    assert found[1][hidden].all() and not found[1][seen[1] < 1.05 * seen[0]].any()


def test_a_vessel_that_is_wide_where_no_shoulder_reaches_contradicts():
    """A view whose axis lies beside the vessel shows less; nothing near covers the other's."""
    own, off = np.full(len(ARC), 1.6), np.full(len(ARC), 0.8)
    seen, sine = np.stack([off, own]), np.full((2, len(ARC)), [[1.0], [0.4]])
    assert not covered(ARC, seen, np.full(seen.shape, SD), sine).any()

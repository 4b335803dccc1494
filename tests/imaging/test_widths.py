"""Widths have a word about paths by contrast; they do not have the last one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.imaging.widths import WIDTH_SHARE, others_too, own_widths, tempered
from tests.imaging.phantoms import PIXEL_MM
from tests.imaging.test_stray_lines import view_of

SIDE = 160
#: (first row, rows) of two level vessels, the second of half the width
WIDE, THIN = (30, 16), (100, 8)


def _chords(shares=(1.0, 1.0)):
    """(SIDE, SIDE) mm: chords of both vessels, each times a share; and where they are."""
    path = np.zeros((SIDE, SIDE), np.float32)
    for (first, width), share in zip((WIDE, THIN), shares, strict=True):
        off = np.arange(width) - (width - 1) / 2
        chord = 2 * np.sqrt((width / 2) ** 2 - off**2) * PIXEL_MM
        path[first : first + width, 20:-20] = share * chord[:, None]
    return path, path > 0


def _middle(path, vessel):
    first, width = vessel
    return float(path[first + width // 2, 60:100].mean())


def test_paths_that_suit_the_widths_stay():
    path, mask = _chords()
    np.testing.assert_allclose(tempered(path, mask, PIXEL_MM), path, rtol=0.08)


@pytest.mark.parametrize("share", [0.5, 0.8, 1.6])
def test_what_is_off_by_a_factor_is_off_by_less(share):
    """Weighted geometric mean: of a factor between two vessels the widths take their share."""
    path, mask = _chords((1.0, share))
    found = tempered(path, mask, PIXEL_MM)
    right, _ = _chords()
    left = _middle(found, THIN) / _middle(found, WIDE) * _middle(right, WIDE) / _middle(right, THIN)
    assert left == pytest.approx(share ** (1 - WIDTH_SHARE), rel=0.05)
    np.testing.assert_array_equal(found > 0, path > 0)
    # Across a vessel the profile is that of the contrast.
    first, width = WIDE
    across = found[first : first + width, 80] / path[first : first + width, 80]
    assert np.ptp(across) < 0.05 * across.mean()


def test_a_scale_is_none_of_their_business():
    path, mask = _chords((1.0, 0.6))
    once, twice = (tempered(k * path, mask, PIXEL_MM) for k in (1.0, 2.0))
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-3)


def test_no_mask_and_no_contrast_change_nothing():
    path, mask = _chords()
    np.testing.assert_array_equal(tempered(path, np.zeros_like(mask), PIXEL_MM), path)
    np.testing.assert_array_equal(tempered(0 * path, mask, PIXEL_MM), 0 * path)


def test_only_what_the_network_drew_is_asked():
    view = view_of((slice(20, 30), slice(20, 200)), (slice(60, 63), slice(20, 200)))
    assert own_widths(view) is view
    drawn = dataclasses.replace(view, by_network=True, others=(view,), kept=lambda: view)
    changed = others_too(own_widths(drawn))
    assert changed.path_mm[25, 100] > 1.2 * changed.path_mm[61, 100]
    assert changed.others[0] is view  # the filter's view
    assert changed.kept is not None and changed.kept() is view

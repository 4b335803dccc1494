"""A band as faint as a rib is no vessel, however wide; a wide vessel is one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, gaussian_filter

from gcar_deploy.imaging.bands import without_bands
from gcar_deploy.imaging.net import Seen
from gcar_deploy.imaging.skeleton import skeletonize

SIDE, PIXEL_MM = 160, 0.5


def tube(start, end, radius_mm):
    """(rows, cols) chords through a round tube, mm."""
    line = np.ones((SIDE, SIDE), bool)
    steps = np.linspace(0, 1, 400)[:, None]
    at = np.rint(np.array(start) + steps * (np.array(end) - start)).astype(int)
    line[at[:, 0], at[:, 1]] = False
    away = distance_transform_edt(line) * PIXEL_MM
    return 2 * np.sqrt(np.maximum(radius_mm**2 - away**2, 0))


def seen_of(*paths):
    reach = np.logical_or.reduce([path > 0 for path in paths])
    probability = reach.astype(np.float32)
    return Seen(probability=probability, chord=np.zeros_like(probability)), reach


@pytest.mark.parametrize(("per_mm", "stays"), [(0.1, True), (0.01, False)])
def test_a_wide_line_is_a_vessel_where_it_is_deep(per_mm, stays):
    thin, wide = tube((20, 20), (140, 20), 1.2), tube((30, 90), (130, 90), 4.0)
    ground = gaussian_filter(np.random.default_rng(1).normal(size=(SIDE, SIDE)), 20) * 2
    picture = (ground + 0.1 * thin + per_mm * wide).astype(np.float32)
    seen, reach = seen_of(thin, wide)
    line, told = skeletonize(reach), np.zeros_like(picture)
    holes = np.zeros_like(reach)
    left = without_bands(seen, reach, line, told, picture, holes, PIXEL_MM)
    assert (left.probability[thin > 0] > 0).all()
    assert (left.probability[80, 84:97] > 0).all() == stays == (left.probability[80, 90] > 0)


def test_vessels_of_one_width_are_left_alone():
    """Nothing narrow tells how deep a wide one should be, and nothing wide is to be judged."""
    for radius in (1.0, 4.0):
        one, faint = tube((20, 30), (140, 30), radius), tube((20, 110), (140, 110), radius)
        seen, reach = seen_of(one, faint)
        picture = (0.1 * one + 0.005 * faint).astype(np.float32)
        line, told = skeletonize(reach), np.zeros_like(picture)
        holes = np.zeros_like(reach)
        assert without_bands(seen, reach, line, told, picture, holes, PIXEL_MM) is seen


def test_strong_wires_say_nothing_of_vessels():
    wide = tube((30, 120), (130, 120), 4.0)
    wires = [tube((20, col), (140, col), 1.0) for col in (20, 50, 80)]
    thin = tube((10, 20), (10, 140), 1.2)
    picture = (0.1 * (thin + wide) + 2.0 * sum(wires)).astype(np.float32)
    seen, reach = seen_of(thin, wide, *wires)
    line, holes = skeletonize(reach), np.zeros_like(reach)
    told = np.zeros_like(picture)
    rules = seen, reach, line
    assert (without_bands(*rules, told, picture, holes, PIXEL_MM).probability[80, 120]) == 0
    told[np.any([wire > 0 for wire in wires], axis=0)] = 1
    assert without_bands(*rules, told, picture, holes, PIXEL_MM) is seen


def test_what_is_shorter_than_wide_stays():
    """Between two vessels that nearly touch, a line is wide and says nothing of contrast."""
    thin, blob = tube((20, 20), (140, 20), 1.2), tube((80, 88), (80, 92), 4.0)
    picture = (0.1 * thin + 0.005 * blob).astype(np.float32)
    reach = (thin > 0) | (blob > 0)
    line, holes = (thin > 0) & skeletonize(thin > 0), np.zeros_like(reach)
    line[80, 86:95] = True
    seen = Seen(probability=reach.astype(np.float32), chord=np.zeros_like(picture))
    told = np.zeros_like(picture)
    assert without_bands(seen, reach, line, told, picture, holes, PIXEL_MM) is seen

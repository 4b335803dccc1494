"""The study of other shapes: what is drawn is what is named, and a plain one is found."""

import numpy as np
import pytest

from gcar_deploy.engine import Engine
from gcar_export.scenes.shapes import SHAPES, shape
from gcar_export.studies.other_shapes import CARMS, KINDS, judged, pictures, scene, table


def _lengths(name):
    _, lines = shape(name, np.random.default_rng(1))
    return [float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()) for line in lines]


def test_shapes_have_the_lines_of_their_names():
    assert _lengths("straight tube") == pytest.approx([70.0])
    # Two turns of radius 20 that rise by 70: sqrt((2 pi 20 * 2)^2 + 70^2).
    assert _lengths("helix") == pytest.approx([np.hypot(80 * np.pi, 70)], rel=1e-3)
    assert len(_lengths("star")) == 6 and len(_lengths("halving tree")) == 15
    for name in SHAPES:
        lumen, lines = shape(name, np.random.default_rng(2))
        every = np.concatenate(lines)
        assert np.abs(every.min(axis=0) + every.max(axis=0)).max() < 1e-6
        assert len(lumen.radii) == sum(len(line) - 1 for line in lines)
        assert np.abs(every).max() < 62


@pytest.mark.slow
def test_every_shape_meets_every_c_arm():
    met = {(scene(3, k).name, scene(3, k).carms[0].rows) for k in range(len(SHAPES) * len(CARMS))}
    assert len(met) == len(SHAPES) * len(CARMS)


def test_pictures_show_one_scene_in_four_ways():
    of = scene(3, 14)
    exact, mask, white, raw = (pictures(of, kind, 3, 14)[0].pixels for kind in KINDS)
    np.testing.assert_array_equal(exact, of.paths[0])
    assert set(np.unique(mask)) == {0, 255} and mask[exact > 1].min() == 255
    assert white[exact == 0].min() == 250
    seen = (exact > 0) & (white > 5)
    assert np.corrcoef(np.log(white[seen]), exact[seen])[0, 1] < -0.99
    assert raw.dtype == np.float32 and raw.std() > 5


@pytest.mark.slow
def test_a_straight_tube_is_found():
    rows = list(judged(3, [0], ["exact", "mask"], Engine()))
    assert [row[:2] for row in rows] == [("exact", "straight tube"), ("mask", "straight tube")]
    assert min(min(row[2:4]) for row in rows) > 0.95
    assert table(rows).count("straight tube") == 1

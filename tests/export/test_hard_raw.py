"""The study of hard raw pairs draws what it says and counts what it is told."""

import numpy as np
import pytest

from gcar_export.studies.hard_raw import raw_pair, table


@pytest.mark.slow
def test_a_pair_is_drawn_again_alike_and_shows_its_tree():
    one, again, other = raw_pair(5, 0), raw_pair(5, 0), raw_pair(5, 2)
    for a, b in zip(one.angiograms, again.angiograms, strict=True):
        np.testing.assert_array_equal(a.pixels, b.pixels)
    assert not np.array_equal(one.angiograms[0].pixels, other.angiograms[0].pixels)
    for angiogram in one.angiograms:
        at, _ = angiogram.carm.project(one.line_mm)
        column, row = np.rint(at).astype(int).T
        inside = (np.abs(at - 256) < 250).all(axis=1)
        on = angiogram.pixels[row[inside], column[inside]]
        beside = angiogram.pixels[row[inside], np.clip(column[inside] + 25, 0, 511)]
        assert np.median(on) < np.median(beside)


def test_refused_pairs_count_nothing_and_strangers_have_no_score():
    rows = [
        ("one patient", 0.5, 1.0, "ok"),
        ("two patients", 0.1, 0.1, "degraded"),
        ("one patient", 0.0, 0.0, "refused"),
        ("two patients", 0.0, 0.0, "refused"),
    ]
    first, second = table(rows).splitlines()[2:]
    cells = [cell.strip() for cell in first.split("|")[1:-1]]
    assert cells[4:] == ["33.3", "1 / 0 / 1", "66.7"]
    assert float(cells[2]) == pytest.approx(50.0)
    assert "0 / 1 / 1" in second and second.count("| -") == 4

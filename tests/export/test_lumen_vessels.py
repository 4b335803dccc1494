"""Poured lumens: their area is in the picture, whatever their shape; the table's arithmetic."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

pytest.importorskip("numba")
from gcar_export.scenes.lumen_vessels import (
    ANGLES,
    LumenVessel,
    carms_for,
    equal_diameter,
    ivus_shapes,
    lumen_case,
    narrowed,
    oval_outline,
    poured,
)
from gcar_export.studies.lumen_vessel_table import VesselRow, vessel_table
from tests.conftest import data_dir

ARC = np.arange(0, 20.05, 0.1)


def straight(outline):
    line = np.stack([ARC - 10, 0 * ARC, 0.3 * (ARC - 10)], axis=1)
    return LumenVessel("made", line, outline, np.full(len(ARC), 3.0), (5.0, 15.0))


@pytest.mark.parametrize("ratio", [1.0, 0.5])
def test_an_outline_has_the_area_that_it_is_made_of(ratio):
    diameter = 3.0 * narrowed(ARC, 10.0, 10.0, 60.0)
    outline = oval_outline(diameter, np.full(len(ARC), ratio), 0.4)
    assert outline.shape == (len(ARC), len(ANGLES))
    np.testing.assert_allclose(equal_diameter(outline), diameter, rtol=5e-3)
    assert diameter.min() == pytest.approx(1.2) and diameter[0] == pytest.approx(3.0)


def test_all_of_the_lumen_is_in_the_picture():
    vessel = straight(oval_outline(np.full(len(ARC), 3.0), np.full(len(ARC), 0.6), 0.0))
    step = np.linalg.norm(vessel.points_mm[1] - vessel.points_mm[0])
    volume = np.pi / 4 * 9.0 * step * len(ARC)
    for carm in carms_for(vessel, 0.4):
        fine = poured(vessel, carm)
        at_axis = carm.pixel_at_isocenter_mm / 3
        # A piece counts as it stands between source and isocentre; the vessel is centred there.
        assert fine.sum() * at_axis**2 == pytest.approx(volume * 0.1 / step, rel=0.02)
        assert 2.0 < np.quantile(fine[fine > 0], 0.95) < 6.5


def test_real_outlines_are_closed_and_of_coronary_size():
    found = sorted((data_dir() / "data" / "ivus").glob("*.csv.gz")) or sorted(
        data_dir().glob("**/ivus/*.csv.gz")
    )
    if not found:
        pytest.skip("no ivus/ in the data folder")
    shapes = ivus_shapes(found[0])
    diameter = equal_diameter(shapes)
    assert len(shapes) >= 20 and (shapes > 0.2).all()
    assert diameter.min() > 1.4 and diameter.max() < 5.5


def test_the_table_states_bias_and_limits():
    lines = [np.stack([np.arange(0, 60, 0.5), np.zeros(120), np.zeros(120)], 1)]
    case = lumen_case("path", "oval", 3, lines, [])
    lesion = (case.vessel.arc_mm >= case.vessel.lesion_mm[0]) & (
        case.vessel.arc_mm <= case.vessel.lesion_mm[1]
    )
    least = case.vessel.diameter_mm[lesion] / case.vessel.healthy_mm[lesion]
    assert 100 * (1 - least.min()) == pytest.approx(case.percent, abs=1.0)
    rows = [
        VesselRow(case=case, least_mm=e, reference_mm=0.0, percent=-e, curve_mm=np.array([e]),
                  z=np.array([1.0]))
        for e in (0.1, 0.3)
    ]  # fmt: skip
    rows.append(dataclasses.replace(VesselRow(case=case), refused=True))
    text = vessel_table(rows)
    assert "| path | all | 2 of 3 | +0.20 ± 0.20 | +0.00 ± 0.00 | -0.2 ± 0.2 |" in text
    assert "Refused: path 1, raw 0, mask 0" in text

"""The study of mask poses draws the scenes that it says, and its table counts them."""

import numpy as np
import pytest

mask_poses = pytest.importorskip("gcar_export.studies.mask_poses", reason="needs the export extra")


def test_rays_of_unmoved_masks_meet_and_a_seen_shift_is_taken_back():
    rows = list(mask_poses.judged(1))
    assert [row[0] for row in rows] == list(mask_poses.SHIFTS_MM)
    assert rows[0][1:] == (False, pytest.approx(0, abs=1e-9), pytest.approx(0, abs=1e-9))
    told, after = np.array([row[2:] for row in rows[1:]]).T
    assert (np.diff(told) > 0).all() and after[-1] < 0.5 * told[-1]


def test_table_counts_corrections():
    rows = [(0.0, False, 0.0, 0.0), (1.0, True, 2.0, 0.5), (2.0, True, 2.0, 0.5),
            (4.0, True, 2.0, 0.5), (4.0, False, 2.0, 1.5)]  # fmt: skip
    assert "| 4 | 2 | 1 | 2.00 | 1.00 (1.50) |" in mask_poses.table(rows)

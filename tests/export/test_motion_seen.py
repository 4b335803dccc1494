"""The study of what shows of motion leaves a heart at rest alone, and its table counts."""

import pytest

motion_seen = pytest.importorskip(
    "gcar_export.studies.motion_seen", reason="needs the export extra"
)


def test_motion_is_told_and_rest_is_not():
    rest, moved = (motion_seen.judged("mask", 3, level) for level in (0.0, 2.0))
    assert rest[:3] == (0.0, False, False) and rest[5] < 0.3
    assert moved[1] and moved[4] > 1.0


def test_table_counts_what_was_told_undone_and_placed():
    rows = [(2.0, True, True, False, 1.0, 0.5), (2.0, True, False, False, 0.5, 0.5),
            (2.0, False, False, True, 2.0, 0.1), (0.0, False, False, False, 0.0, 0.0)]  # fmt: skip
    text = motion_seen.table(rows)
    assert "| 2 | 3 | 2 | 2 | 1 | 1 | 1.00 | 0.50 | 1 | 2.00 | 0.10 |" in text
    assert "| 0 | 1 | 0 | 0 | 0 | 0 | - | - | 0 | - | - |" in text

"""Raw pairs with catheters and leads: frames that go together, and shares of lines."""

from __future__ import annotations

import numpy as np
import pytest

from gcar_export.scenes.cine import cine_pair
from gcar_export.studies.cath_lab_pairs import (
    FRAMES,
    SEED,
    frames_of,
    judged,
    pictures,
    shares,
    table,
    true_line,
)


def test_shares_are_of_lines_laid_over_each_other() -> None:
    line = np.stack([np.arange(0, 100, 0.5), np.zeros(200), np.zeros(200)], axis=1)
    found, ours = shares(line + np.array([0.0, 5.0, -3.0]), line)
    assert found == ours == 1.0
    # half of the line, and a fifth more that is nothing
    half = line[:100]
    stray = line[:20] + np.array([0.0, 0.0, 60.0])
    found, ours = shares(np.concatenate([half, stray]), line)
    assert found == pytest.approx(0.5, abs=0.04) and ours == pytest.approx(5 / 6, abs=0.02)


@pytest.mark.slow
def test_pairs_show_one_phase_and_come_out_better_without_devices() -> None:
    pair = cine_pair(SEED, 1, FRAMES)
    frames = frames_of(pair)
    apart = pair.shape_error_mm()
    assert apart[frames] < np.median(apart)
    one = pictures(pair, frames, erased=True)[0]
    seen = one.carm.project(true_line(pair, frames[0]))[0]
    at = np.rint(seen)
    inside = ((at >= 0) & (at < [one.carm.columns, one.carm.rows])).all(axis=1)
    column, row = at[inside].astype(int).T
    assert one.erased is not None and one.erased[row, column].mean() < 0.15
    rows = list(judged(SEED, 1))
    assert [row[0] for row in rows] == ["as shown", "devices erased"]
    assert table(rows).count("\n") == 3

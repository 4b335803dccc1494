"""Raw pairs with catheters and leads: frames that go together, and shares of lines."""

from __future__ import annotations

import numpy as np
import pytest

from gcar_export.scenes.cine import cine_pair
from gcar_export.studies.cath_lab_pairs import (
    ERASED,
    FRAMES,
    SEED,
    WITH_BARE,
    frames_of,
    judged,
    pictures,
    shares,
    table,
    true_line,
)


def test_a_tree_that_lies_far_off_is_laid_all_the_way_back() -> None:
    way = np.linspace(0, 40, 120)
    line = np.concatenate([
        np.stack([way, 10 * np.sin(way / 6), 0.3 * way], axis=1),
        np.stack([0.4 * way, way, 10 * np.cos(way / 7)], axis=1),
    ])  # fmt: skip
    assert shares(line + np.array([12.0, -9.0, 15.0]), line) == (1.0, 1.0)


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
    one = pictures(pair, frames, ERASED)[0]
    seen = one.carm.project(true_line(pair, frames[0]))[0]
    at = np.rint(seen)
    inside = ((at >= 0) & (at < [one.carm.columns, one.carm.rows])).all(axis=1)
    column, row = at[inside].astype(int).T
    assert one.erased is not None and one.erased[row, column].mean() < 0.15
    rows = list(judged(SEED, 1))
    assert [row[0] for row in rows] == ["as shown", "devices erased"]
    assert table(rows).count("\n") == 3


@pytest.mark.slow
def test_a_run_that_begins_before_contrast_tells_what_is_no_vessel() -> None:
    pair = cine_pair(SEED, 0, FRAMES + 6, 6.0)
    frames = frames_of(pair)
    for run, frame, one in zip(pair.runs, frames, pictures(pair, frames, WITH_BARE), strict=True):
        assert one.bare
        filled = run.path_mm.sum(axis=(1, 2))
        for before in one.bare:
            number = [np.array_equal(before, pixels) for pixels in run.pixels].index(True)
            assert number < frame and filled[number] < 0.01 * filled.max()

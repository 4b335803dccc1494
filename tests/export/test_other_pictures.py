"""Pictures in other looks show the path lengths that they are made of."""

from __future__ import annotations

import numpy as np
import pytest

from gcar_export.scenes.protocols import MM_PER_COUNT
from gcar_export.studies.other_pictures import LOOKS, SEED, judged, pictures, table
from gcar_export.studies.wrong_scenes import exam


@pytest.mark.slow
def test_looks_are_what_they_say_and_come_out() -> None:
    case = exam(SEED, 1, "path_length", 2)
    path = case.told.images[0] * MM_PER_COUNT
    dark, flat, bright = (
        pictures(case, LOOKS[name], 1)[0].pixels
        for name in ("dark on white", "flat areas", "bright on black")
    )
    # Beer-Lambert, to half a grey value
    assert np.abs(-np.log(dark / 250) / 0.3 - path)[path < 4].max() < 0.02 * np.exp(0.3 * 4)
    assert set(np.unique(flat)) == {25, 250} and ((flat == 25) == (path > MM_PER_COUNT)).all()
    assert np.abs(bright + dark * 240 / 250 - 250).max() <= 1
    rows = list(judged(1))
    assert [row[0] for row in rows] == list(LOOKS)
    assert all(found > 0.7 and ours > 0.7 for _, found, ours, _ in rows)
    assert table(rows).count("\n") == len(LOOKS) + 1

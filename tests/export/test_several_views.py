"""The study of several views draws what it says and counts what it is told."""

import numpy as np
import pytest

from gcar_export.studies.several_views import MOVED, STRANGER, TOLD, scene, table


@pytest.mark.slow
def test_scenes_of_a_number_differ_in_what_is_asked_alone():
    told, seen, tree, _ = scene(5, 1, "mask", TOLD)
    again, moved, _, _ = scene(5, 1, "mask", MOVED)
    other, same, _, _ = scene(5, 1, "mask", STRANGER)
    assert [a.carm for a in told] == [a.carm for a in again] == seen == same
    assert moved[0] == seen[0] and all(a != b for a, b in zip(moved[1:], seen[1:], strict=True))
    line = np.concatenate([vessel.points_mm for vessel in tree.vessels])
    for k, pictures in enumerate((told, again, other)):
        shown = []
        for picture, carm in zip(pictures, (seen, moved, same)[k], strict=True):
            at = np.rint(carm.project(line)[0]).astype(int)
            at = at[(at >= 0).all(axis=1) & (at < 512).all(axis=1)]
            shown.append(picture.pixels[at[:, 1], at[:, 0]].mean())
        assert min(shown[:-1]) > 0.6
        assert (shown[-1] > 0.6) == (k < 2)


def test_strangers_have_no_score_and_refused_views_no_distance():
    rows = [
        (f"mask, {TOLD}", (0.5, 1.0, "ok"), 0.0, 0.2),
        (f"mask, {TOLD}", (0.0, 0.0, "refused"), 0.0, np.nan),
        (f"mask, {STRANGER}", (0.1, 0.1, "degraded"), 0.0, 4.0),
    ]
    text = table(rows)
    assert f"| mask, {TOLD} | 2 | 50.0 | 100.0 | 33.3 | 1 / 0 / 1 | 66.7 |" in text
    assert f"| mask, {STRANGER} | 1 | - | - | - | 0 / 1 / 0 |" in text
    assert text.splitlines()[-1] == f"| mask, {TOLD} | 0.00 | 0.20 |"

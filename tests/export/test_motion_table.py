"""The study of motion deforms trees by what it says, and holds them against what can be seen."""

import numpy as np
import pytest

motion_table = pytest.importorskip(
    "gcar_export.studies.motion_table", reason="needs the export extra"
)
from gcar_deploy.engine import Engine  # noqa: E402
from gcar_deploy.geometry.epipolar import plane_normal  # noqa: E402
from gcar_export.scenes.motion import heart_motion  # noqa: E402


def test_motion_has_the_size_that_is_asked_for_no_mean_and_is_smooth():
    rng = np.random.default_rng(1)
    points = rng.uniform(-50, 50, (400, 3))
    motion = heart_motion(rng, points, 3.0)
    moved = motion.at(points)
    np.testing.assert_allclose(moved.mean(axis=0), 0, atol=1e-9)
    assert np.sqrt(np.mean(np.sum(moved**2, axis=1))) == pytest.approx(3.0)
    near = motion.at(points + np.array([1.0, 0.0, 0.0]))
    assert np.linalg.norm(near - moved, axis=1).max() < 0.5


def test_oracle_takes_out_what_two_views_see_alone():
    as_is, across = (motion_table.make_pair("clinical", 0, 2.0, arm) for arm in ("auto", "across"))
    normal = plane_normal(*as_is.carms)
    seen, undone = (np.subtract(*pair.lines[::-1]) for pair in (as_is, across))
    assert np.abs(undone @ normal).max() < 1e-9 < np.abs(seen @ normal).max()
    np.testing.assert_allclose(undone, seen - np.outer(seen @ normal, normal), atol=1e-9)


def test_table_tells_refused_from_wrong():
    row = {"protocol": "clinical", "arm": "auto", "tree": 0, "level_mm": 2.0}
    rows = [
        motion_table.Row(**row, status="ok", mean_mm=2.0, shape_mm=1.0, dsc=0.5),
        motion_table.Row(**row, status="refused"),
    ]
    assert "| clinical | 2 | auto | 2 | 50.0 | 1.00 |" in motion_table.table(rows)
    assert motion_table.table(rows).endswith("| 1 / 0 / 1 | 1 |")


@pytest.mark.slow
def test_deformed_pair_is_reconstructed_and_said_to_be():
    engine = Engine(threads=1)
    rigid, auto = (motion_table.one("clinical", 0, 2.0, arm, engine) for arm in ("rigid", "auto"))
    assert auto.status == "degraded" and auto.motion_mm[1] > 0.5 and rigid.motion_mm == (0.0, 0.0)
    assert "the contours of the views disagree by" in auto.findings[0]
    assert auto.shape_mm < 0.5 * rigid.shape_mm

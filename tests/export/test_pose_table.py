"""The pose table: alignment forgives motion alone, rows go on where they stopped."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("torch", reason="needs the export extra")

from gcar_export.studies.pose_table import Row, aligned, chamfer_mm, markdown, measure


def test_alignment_forgives_motion_and_nothing_else():
    rng = np.random.default_rng(0)
    truth = np.cumsum(rng.normal(size=(400, 3)), axis=0)
    R = Rotation.from_rotvec([0.02, -0.03, 0.01]).as_matrix()
    moved = truth @ R.T + [1.0, -0.5, 0.8]
    assert chamfer_mm(moved, truth) > 0.5
    assert chamfer_mm(aligned(moved, truth), truth) < 0.05
    stretched = truth * [1.2, 1.0, 1.0]
    assert chamfer_mm(aligned(stretched, truth), truth) > 0.3


def test_table_counts_refusals_apart():
    rows = [
        Row(tree=k, shift_mm=4.0, angle_deg=1.0, pose=pose, status=status, chamfer_mm=c,
            in_place_mm=c)
        for k, (pose, status, c) in enumerate(
            [("auto", "ok", 0.5), ("auto", "refused", None), ("off", "degraded", 2.0)]
        )
    ]  # fmt: skip
    line = markdown(rows).splitlines()[-1]
    assert "0.50 ± 0.00 (n=1)" in line and "| 0/1/0 | 1/0/1 |" in line


@pytest.mark.slow
def test_four_millimetres_and_a_degree(tmp_path):
    """Refinement brings the tree's shape below a millimetre; the rows are kept."""
    out = tmp_path / "rows.jsonl"
    rows = measure(out, 1, [(4.0, 1.0)])
    found = {row.pose: row for row in rows}
    assert found["auto"].chamfer_mm < 1.0
    before = out.read_text()
    assert measure(out, 1, [(4.0, 1.0)]) == rows and out.read_text() == before

"""Robustness curves: what each level changes, resuming, the files that they leave."""

import csv

import numpy as np
import pytest

from gcar_deploy.errors import UsageError
from gcar_deploy.geometry.carm import separation_deg
from gcar_export.scenes.labels import from_array
from gcar_export.studies import robustness
from gcar_export.studies.robustness import (
    CURVES,
    Point,
    examine,
    noisy_rim,
    points,
    run,
    table,
    with_gaps,
)
from tests.conftest import data_dir


@pytest.fixture(scope="module")
def tree():
    x, y, z = np.indices((60, 40, 40))
    mask = ((y - 20 - 6 * np.sin(x / 9)) ** 2 + (z - 20 - 5 * np.cos(x / 7)) ** 2) <= 5
    return from_array(mask, np.diag([-1.0, -1.0, 1.0, 1.0])).centred()


@pytest.mark.parametrize("level", CURVES["separation"])
def test_separation_is_the_angle_between_the_views(tree, level):
    first, second = examine(tree, Point("separation", level))
    assert separation_deg(first.carm, second.carm) == pytest.approx(level)


@pytest.mark.parametrize("curve", ["angle", "shift", "mask", "gaps"])
def test_level_nought_is_exact_and_more_changes_what_it_says(tree, curve):
    exact, changed = (examine(tree, Point(curve, level)) for level in (0, CURVES[curve][-1]))
    reference = examine(tree, Point("angle", 0))
    for a, b in zip(exact, reference, strict=True):
        np.testing.assert_array_equal(a.pixels, b.pixels)
    # The geometry never tells, and an error of the geometry is one of the second view alone.
    assert [a.carm for a in changed] == [a.carm for a in exact]
    same = [np.array_equal(a.pixels, b.pixels) for a, b in zip(exact, changed, strict=True)]
    assert same == ([False, False] if curve in ("mask", "gaps") else [True, False])


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_noise_touches_so_many_rim_pixels_and_nothing_else(tree, share):
    path = examine(tree, Point("mask", 0))[0].pixels
    noisy = noisy_rim(path, share, np.random.default_rng(0))
    import cv2

    mask, kernel = (path > 0).astype(np.uint8), np.ones((3, 3), np.uint8)
    rim = cv2.dilate(mask, kernel) != cv2.erode(mask, kernel)
    wrong = (noisy > 0) != (path > 0)
    assert not wrong[~rim].any()
    assert wrong.sum() / rim.sum() == pytest.approx(share, abs=0.02)
    np.testing.assert_array_equal(noisy[~rim], path[~rim])


def test_gaps_take_so_many_pixels_and_change_no_other(tree):
    path = examine(tree, Point("gaps", 0))[0].pixels
    holes = with_gaps(path, 0.1, 4, np.random.default_rng(0))
    gone = (path > 0) & (holes == 0)
    assert gone.sum() / (path > 0).sum() == pytest.approx(0.1, abs=0.03)
    np.testing.assert_array_equal(holes[~gone], path[~gone])


def test_unknown_curves_are_named():
    with pytest.raises(UsageError, match="'heat' is none of separation, angle, shift, mask, gaps"):
        list(points(["heat"]))


def test_table_tells_means_and_statuses():
    rows = [
        {"curve": "shift", "level": "2", "case": c, "status": s, "dsc": d, "chamfer_mm": "1.0"}
        for c, s, d in (("a", "ok", "0.8"), ("b", "degraded", "0.6"), ("c", "refused", ""))
    ]
    rows[-1]["chamfer_mm"] = ""
    assert "| 2 | 70.00 ± 14.14 (n=2) | 1.00 ± 0.00 (n=2) | 1 / 1 / 1 |" in table(rows)


def test_a_folder_that_holds_something_else_is_refused(tmp_path):
    (tmp_path / "robustness.png").write_text("mine")
    with pytest.raises(UsageError, match=r"holds no robustness\.csv; give another --out"):
        run(tmp_path, tmp_path)
    (tmp_path / "robustness.csv").write_text("mine\n1\n")
    with pytest.raises(UsageError, match=r"robustness\.csv is not that of this study"):
        robustness.read_rows(tmp_path / "robustness.csv")


@pytest.mark.slow
def test_real_tree_twice_makes_each_point_once(tmp_path, monkeypatch):
    data = data_dir() / "data"
    monkeypatch.setitem(robustness.CURVES, "shift", (0, 10))
    rows = run(data, tmp_path, cases=["0001"], curves=["shift"])
    assert [r["level"] for r in rows] == ["0", "10"] and all(r["status"] for r in rows)
    assert float(rows[0]["dsc"]) > float(rows[1]["dsc"] or 0)
    first = (tmp_path / "robustness.csv").read_bytes()
    monkeypatch.setattr(robustness, "_row", None)
    assert run(data, tmp_path, cases=["0001"], curves=["shift"]) == rows
    assert (tmp_path / "robustness.csv").read_bytes() == first
    names = {f.name for f in tmp_path.iterdir()}
    assert names == {"robustness.csv", "robustness.md", "robustness.png"}
    with (tmp_path / "robustness.csv").open("a", newline="") as f:
        csv.DictWriter(f, robustness.FIELDS).writerow({**rows[0], "settings": "other"})
    with pytest.raises(UsageError, match="another model or version"):
        run(data, tmp_path, cases=["0001"], curves=["shift"])

"""What a person tells: landmarks, pose, masks; and what comes back of it."""

import hashlib
import json

import cv2
import numpy as np
import pytest

from gcar_deploy.geometry.scene import load_scene, parse_scene
from gcar_deploy.selftest import tiny_case
from tests.cli.conftest import gcar


def run(folder, out, *arguments):
    return gcar(
        "run", folder / "view1.png", folder / "view2.png", "--geom", folder / "geom.json",
        "--out", out, "--predictor", "none", "--refiner", "none", *arguments,
    )  # fmt: skip


def test_a_landmark_and_what_the_result_says_of_it(good_case, tmp_path):
    fork = np.array([[5.0, -4.0, 6.0]])
    a, b = (angiogram.carm.project(fork)[0][0] for angiogram in tiny_case()[0])
    text = f"{a[0]:.2f},{a[1]:.2f}:{b[0]:.2f},{b[1]:.2f}"
    done = run(good_case, tmp_path / "r", "--landmark", text, "--json")
    assert done.code == 0, done.err
    found = json.loads(done.out)
    view = found["views"][1]
    assert view["landmark_gap_before_mm"] < 0.05 and view["landmark_gap_after_mm"] < 0.3
    assert view["disagreement_after"] <= view["disagreement_before"]
    assert found["silent_errors"] and "unseen" in found["silent_errors"][0]
    assert found["options"]["landmarks"] == [[[*map(float, t.split(","))] for t in text.split(":")]]


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("--landmark", "1,2"), 2, "1 points for 2 views"),
        (("--landmark", "1,2:900,3"), 2, "outside"),
        (("--landmark", "1,2:3,4", "--pose", "off"), 2, "pose off"),
        (("--mask", "3:view1.png"), 2, "views 1 .. 2"),
        (("--mask", "16:m.png"), 2, "views 1 .. 2"),
        (("--mask", "17:m.png"), 2, "N:FILE"),
        (("--mask", "1:missing.png"), 3, "missing.png"),
    ],
)
def test_refused(good_case, tmp_path, arguments, code, words):
    done = run(good_case, tmp_path / "r", *arguments)
    assert done.code == code and words in done.err.splitlines()[-1]
    assert not (tmp_path / "r").exists()


def test_pose_off_estimates_nothing(good_case, tmp_path):
    done = run(good_case, tmp_path / "r", "--pose", "off", "--json")
    view = json.loads(done.out)["views"][1]
    assert view["estimated_offset_mm"] == [0, 0, 0]
    assert view["disagreement_after"] == view["disagreement_before"]


@pytest.mark.slow
def test_a_result_says_which_geometry_and_masks_it_is_of(good_case, tmp_path):
    mask = tmp_path / "mine.png"
    grey = cv2.imread(str(good_case / "view1.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(mask), np.uint8(255 * (grey > 0)))
    done = run(good_case, tmp_path / "r", "--mask", f"1:{mask}", "--json")
    first, second = json.loads(done.out)["views"]
    assert first["picture"]["mask_sha256"] == hashlib.sha256(mask.read_bytes()).hexdigest()
    assert "mask_sha256" not in second["picture"]
    scene = {"schema": "gcar-geometry/1", "frame": "LPS",
             "views": [{"id": v["id"], **v["geometry"]} for v in (first, second)]}  # fmt: skip
    given = load_scene(good_case / "geom.json")
    assert parse_scene(json.dumps(scene)).views == given.views


@pytest.mark.slow
def test_a_mask_wins(good_case, tmp_path):
    """Half of view 1 masked away: what is left of the tree is what both then show."""
    pixels = cv2.imread(str(good_case / "view1.png"), cv2.IMREAD_UNCHANGED)
    mask = np.where(pixels > 0, 255, 0).astype(np.uint8)
    mask[: mask.shape[0] // 2] = 0
    cv2.imwrite(str(tmp_path / "m.png"), mask)
    whole = json.loads(run(good_case, tmp_path / "a", "--json").out)
    done = run(good_case, tmp_path / "b", "--mask", f"1:{tmp_path / 'm.png'}", "--json")
    assert done.code in (0, 6), done.err
    if done.code == 0:
        found = json.loads(done.out)
        assert found["tree"]["length_mm"] < 0.8 * whole["tree"]["length_mm"]
        assert any("mask is the user's" in note for note in found["notes"])
    small = tmp_path / "s.png"
    cv2.imwrite(str(small), mask[:20, :20])
    assert run(good_case, tmp_path / "c", "--mask", f"1:{small}").code == 3

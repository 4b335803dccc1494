"""gcar validate: what is said before any reconstruction, and the exit code that run would give."""

import contextlib
import dataclasses
import json
import logging
import re

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from gcar_deploy.cli.main import gcar
from gcar_deploy.config import (
    ImagingOptions,
    PredictOptions,
    QualityOptions,
    RefineOptions,
    RunOptions,
)
from gcar_deploy.engine import Engine
from gcar_deploy.errors import GcarError, RefusedError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Intensity, Scene, View, scene_to_json
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.inspection import inspect_files, volume_coverage
from gcar_deploy.quality import too_much
from gcar_deploy.selftest import tiny_case


@pytest.fixture
def case(tmp_path):
    """The generated tiny case as files: pictures and scene."""
    angiograms, grid, _ = tiny_case()
    views = []
    for k, a in enumerate(angiograms):
        counts = np.rint(a.pixels).astype(np.uint16)
        cv2.imwrite(str(tmp_path / f"view{k + 1}.png"), counts)
        views.append(View(id=str(k + 1), carm=a.carm, intensity=a.intensity))
    (tmp_path / "geom.json").write_text(scene_to_json(Scene(views=tuple(views), grid=grid)))
    return tmp_path


def files(case):
    return [case / "view1.png", case / "view2.png"], case / "geom.json"


def test_a_good_case(case):
    found = inspect_files(*files(case))
    assert found.error is None
    out = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert out["would"] == "reconstruct" and out["exit_code"] == 0
    assert [v["name"] for v in out["views"]] == ["RAO 30 CAU 20", "LAO 45 CRA 25"]
    assert all(0.5 < v["coverage"] <= 1 and v["vessel_share"] > 0 for v in out["views"])
    assert 80 < out["pairs"][0]["separation_deg"] < 90
    assert out["pairs"][0]["disagreement"] < 0.05
    assert any("unseen in the pictures" in text for text in out["silent_errors"])


def test_polarity_is_judged_of_all_pictures_together(case, caplog):
    """By run and validate alike: the views name one factor for all, which is none of their own."""
    scene = json.loads((case / "geom.json").read_text())
    rng = np.random.default_rng(3)
    for k, (view, noise) in enumerate(zip(scene["views"], (1.0, 25.0), strict=True), start=1):
        path = cv2.imread(str(case / f"view{k}.png"), -1) * view["intensity"]["mm_per_count"]
        grey = 180 * np.exp(-0.15 * path) + rng.normal(0, noise, path.shape)
        cv2.imwrite(str(case / f"view{k}.png"), np.clip(grey, 0, 255).astype(np.uint8))
        view["intensity"] = {"kind": "raw"}
    (case / "geom.json").write_text(json.dumps(scene))
    options = RunOptions(imaging=ImagingOptions(segmenter="classic"))
    for ask in (
        lambda: inspect_files(*files(case), options=options),
        lambda: Engine(threads=1, options=options).reconstruct(*files(case)),
    ):
        caplog.clear()
        with caplog.at_level(logging.INFO, logger="gcar_deploy"), contextlib.suppress(GcarError):
            ask()
        said = re.findall(r"factor ([\d.]+), ([\d.]+) together", caplog.text)
        assert len(said) == 2 and len({together for _, together in said}) == 1
        assert all(own != together for own, together in said)


def test_nothing_is_written(case):
    before = sorted(p.name for p in case.iterdir())
    inspect_files(*files(case))
    assert sorted(p.name for p in case.iterdir()) == before


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda c: (c / "view2.png").write_bytes(b"no picture"), 3),
        (lambda c: (c / "view2.png").unlink(), 3),
        (lambda c: cv2.imwrite(str(c / "view2.png"), np.zeros((96, 96), np.uint16)), 6),
        (lambda c: (c / "geom.json").write_text("{}"), 4),
        (lambda c: (c / "view2.png").write_bytes((c / "view1.png").read_bytes()), 6),
    ],
)
def test_says_what_run_would_refuse_with_its_code(case, change, code):
    change(case)
    found = inspect_files(*files(case))
    assert found.error is not None and found.error.exit_code == code
    runner = CliRunner()
    pictures, geom = files(case)
    args = ["validate", *map(str, pictures), "--geom", str(geom)]
    result = runner.invoke(gcar, [*args, "--json"])
    assert '"would": "refuse"' in result.output


def test_too_much_vessel_is_refused_before_the_views_are_placed(case, monkeypatch):
    """By run and validate in the same words; the pictures stand for some with ribs."""
    scene = json.loads((case / "geom.json").read_text())
    for k, view in enumerate(scene["views"], start=1):
        path = cv2.imread(str(case / f"view{k}.png"), -1) * view["intensity"]["mm_per_count"]
        cv2.imwrite(str(case / f"view{k}.png"), (180 * np.exp(-0.15 * path)).astype(np.uint8))
        view["intensity"] = {"kind": "raw"}
    (case / "geom.json").write_text(json.dumps(scene))
    monkeypatch.setattr(too_much, "MOST_ML", 0.1)
    monkeypatch.setattr(too_much, "MOST_LINE_MM", 50.0)
    options = RunOptions(imaging=ImagingOptions(segmenter="classic"))
    steps = []
    with pytest.raises(RefusedError, match="than any heart has") as refused:
        engine = Engine(threads=1, options=options)
        engine.reconstruct(*files(case), on_step=lambda step: steps.append(type(step).__name__))
    assert steps[-1] == "Vessels"
    assert str(inspect_files(*files(case), options=options).error) == str(refused.value)


def test_run_refuses_a_tree_longer_than_any(case):
    engine = Engine(threads=1, options=RunOptions(quality=QualityOptions(max_length_mm=60.0)))
    assert engine.reconstruct(*files(case)).tree.length_mm > 60.0  # true path lengths are believed
    told = json.loads((case / "geom.json").read_text())
    for view in told["views"]:
        view["intensity"] = {"kind": "attenuation"}
    (case / "geom.json").write_text(json.dumps(told))
    with pytest.raises(RefusedError, match="more than any coronary tree has"):
        engine.reconstruct(*files(case))


def test_a_volume_beside_the_tree_is_refused_in_the_words_of_run(case):
    pictures, geom = files(case)
    told = json.loads(geom.read_text())
    told["volume"]["center_mm"] = [60.0, 60.0, 60.0]
    geom.write_text(json.dumps(told))
    found = inspect_files(pictures, geom)
    with pytest.raises(RefusedError) as refused:
        Engine(threads=1).reconstruct(pictures, geom)
    assert "are seen as vessel by all" in str(refused.value)
    assert found.to_dict()["reason"] == str(refused.value)


def test_command_prints_clinical_words(case):
    pictures, geom = files(case)
    result = CliRunner().invoke(gcar, ["validate", *map(str, pictures), "--geom", str(geom)])
    assert result.exit_code == 0
    assert "RAO 30 CAU 20" in result.output and "deg apart" in result.output
    assert "would be reconstructed" in result.output


def test_command_takes_what_run_takes(case):
    """A shift that only a correction can mend is refused once the correction is off."""
    pictures, geom = files(case)
    second = cv2.imread(str(pictures[1]), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(pictures[1]), np.roll(second, 6, axis=0))
    args = ["validate", *map(str, pictures), "--geom", str(geom), "--json"]
    found = {
        name: json.loads(CliRunner().invoke(gcar, [*args, *more]).output.splitlines()[0])
        for name, more in (("auto", ()), ("off", ("--pose", "off")))
    }
    after = {name: one["pairs"][0]["after_shift"] for name, one in found.items()}
    assert after["auto"] < 0.5 * after["off"]
    assert found["off"]["would"] == "refuse" and found["off"]["exit_code"] == 6

    outside = CliRunner().invoke(gcar, [*args, "--landmark", "5,5:9999,5"])
    assert json.loads(outside.output.splitlines()[0])["exit_code"] == 2
    assert "outside" in json.loads(outside.output.splitlines()[0])["reason"]
    both = CliRunner().invoke(gcar, [*args, "--pose", "off", "--landmark", "5,5:5,5"])
    assert both.exit_code != 0 and "pose off" in str(both.exception)
    assert CliRunner().invoke(gcar, [*args, "--segmenter", "none"]).exit_code == 2


def test_coverage_of_the_volume():
    angiograms, grid, _ = tiny_case()
    carm = angiograms[0].carm
    whole = volume_coverage(carm, dataclasses.replace(grid, size_mm=(5.0, 5.0, 5.0)))
    none = volume_coverage(carm, dataclasses.replace(grid, center_mm=(300.0, 0.0, 0.0)))
    assert whole == 1.0 and none < 0.05


def three_raw_views_with_the_table_moved():
    """Pictures and masks of one tree; before the second the table went by 37 mm."""
    render = pytest.importorskip("gcar_export.scenes.render", reason="needs the export extra")
    from gcar_export.scenes.trees import random_tree

    vessels = random_tree(np.random.default_rng(5)).sides("left")
    angiograms = []
    for k, (primary, secondary) in enumerate(((-30, -20), (45, 25), (-10, 35))):
        carm = CArm(
            primary_angle_deg=primary, secondary_angle_deg=secondary, sod_mm=765, sdd_mm=1080,
            rows=128, columns=128, pixel_spacing_mm=(1.8, 1.8),
        )  # fmt: skip
        seen = carm.moved(np.array([0.0, 12.0, 35.0])) if k == 1 else carm
        path = render.path_lengths(seen, *vessels.segments())
        angiograms.append(
            Angiogram(
                view_id=str(k + 1), carm=carm, pixels=(230 * np.exp(-0.12 * path)).astype("f4"),
                bit_depth=8, intensity=Intensity(kind="raw"), sha256=str(k), mask=path > 0.3,
            )
        )  # fmt: skip
    return angiograms, Grid(center_mm=(0, 0, 0), size_mm=(130,) * 3, shape=(64,) * 3)


@pytest.mark.slow
def test_three_views_are_placed_as_run_places_them():
    """Also by the tree that they show, and what is said of the correction is the same."""
    angiograms, grid = three_raw_views_with_the_table_moved()
    options = RunOptions(
        predict=PredictOptions(predictor="none"), refine=RefineOptions(refiner="none"),
    )  # fmt: skip
    result = Engine(threads=1, options=options).reconstruct(angiograms, grid)
    found = inspect_files(angiograms, grid, options)
    assert found.error is None
    said = result.quality.findings[: len(found.warnings)]
    assert found.warnings == list(said)
    assert any("view 2 had to be moved" in text for text in said)
    first, second, third = result.poses
    assert second.shift_mm > 15 and first.shift_mm == 0
    pairs = {(pair["first"], pair["second"]): pair for pair in found.pairs}
    for view, pose in (("2", second), ("3", third)):
        pair = pairs[min(str(pose.partner + 1), view), max(str(pose.partner + 1), view)]
        assert pair["shift_mm"] == pose.shift_mm and pair["after_shift"] == pose.after

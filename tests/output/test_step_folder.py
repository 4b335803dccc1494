"""What every stage made, read back by programs that are not ours."""

from __future__ import annotations

import dataclasses
import os

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from gcar_deploy.cli.main import gcar
from gcar_deploy.config import PredictOptions, QualityOptions, RunOptions
from gcar_deploy.data.demo_case import demo_case
from gcar_deploy.engine import Engine
from gcar_deploy.errors import RefusedError, UsageError
from gcar_deploy.output.step_folder import PATH_COUNT_MM, StepFolder
from gcar_deploy.selftest import tiny_case
from tests.hard.phantoms import GRID, carm, paths, straight

OPTIONS = RunOptions(predict=PredictOptions(predictor="none"))
VIEWS = [f"1-vessels-view{k}-{what}.png" for k in "12" for what in ("mask", "path", "skeleton")]
PLACED = ["2-pose-view1-mask.png", "2-pose-view2-mask.png", "2-pose.vtp"]


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """Folder of the steps, the result with them, and without."""
    folder = tmp_path_factory.mktemp("steps") / "new" / "steps"
    angiograms, grid, _ = tiny_case()
    engine = Engine(options=OPTIONS)
    with_steps = engine.reconstruct(angiograms, grid, on_step=StepFolder(folder))
    return folder, with_steps, engine.reconstruct(angiograms, grid)


def read(file):
    vtk = pytest.importorskip("vtk", reason="needs the test extra")
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(file))
    reader.Update()
    assert reader.GetErrorCode() == 0
    return reader.GetOutput()


def numbers(data, name=None):
    from vtk.util.numpy_support import vtk_to_numpy

    return vtk_to_numpy(
        data.GetPoints().GetData() if name is None else data.GetPointData().GetArray(name)
    )


def test_every_stage_leaves_its_files_and_changes_nothing(kept):
    folder, with_steps, without = kept
    names = ["3-hull.vtp", "4-points.vtp", "5-tree-after.vtp", "5-tree-before.vtp"]
    assert sorted(p.name for p in folder.iterdir()) == sorted([*VIEWS, *PLACED, *names])
    np.testing.assert_array_equal(with_steps.volume, without.volume)


def test_pictures_are_what_was_found(kept):
    folder, result, _ = kept
    for view in result.views:
        head = f"1-vessels-view{view.view_id}"
        for name, seen in (("mask", view.mask), ("skeleton", view.skeleton)):
            picture = cv2.imread(str(folder / f"{head}-{name}.png"), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(picture, 255 * seen)
        counts = cv2.imread(str(folder / f"{head}-path.png"), cv2.IMREAD_UNCHANGED)
        assert counts.dtype == np.uint16
        np.testing.assert_allclose(counts * PATH_COUNT_MM, view.path_mm, atol=PATH_COUNT_MM)


@pytest.mark.slow
def test_pictures_have_the_pixels_that_were_given(tmp_path):
    """Found on square pixels, written on those of the picture."""
    long = {"rows": 256, "columns": 128, "pixel_spacing_mm": (0.49, 0.98), "sdd_mm": 1299.0}
    views = [carm(-30, -20, **long), carm(45, 25, **long)]
    pictures = paths(straight(radius=2.0), views)
    result = Engine(options=OPTIONS).reconstruct(pictures, GRID, on_step=StepFolder(tmp_path / "s"))
    for view in result.views:
        for name in ("1-vessels-view{}-mask", "1-vessels-view{}-path", "2-pose-view{}-mask"):
            file = tmp_path / "s" / f"{name.format(view.view_id)}.png"
            assert cv2.imread(str(file), cv2.IMREAD_UNCHANGED).shape == (256, 128)


def test_points_and_trees_are_those_of_the_stages(kept):
    folder, result, _ = kept
    hull, points = read(folder / "3-hull.vtp"), read(folder / "4-points.vtp")
    assert hull.GetNumberOfPoints() == result.counts["candidates"] == hull.GetNumberOfVerts()
    np.testing.assert_array_equal(numbers(points), numbers(hull))
    confidence = numbers(points, "Confidence")
    assert confidence.min() >= 0 and 0.5 < confidence.max() <= 1
    after, before = (read(folder / f"5-tree-{when}.vtp") for when in ("after", "before"))
    assert after.GetNumberOfLines() == len(result.tree.branches) == before.GetNumberOfLines()

    def ordered(points):
        return points[np.lexsort(points.T)]

    np.testing.assert_allclose(ordered(numbers(after)), ordered(result.tree.points()))
    assert np.median(np.abs(numbers(after).mean(0) - numbers(before).mean(0))) > 1e-6


def test_beams_run_from_the_sources_through_the_isocentre(kept):
    folder, result, _ = kept
    beams = read(folder / "2-pose.vtp")
    ends = numbers(beams).reshape(-1, 3, 3)
    for (source, middle, detector), view in zip(ends, result.views, strict=True):
        np.testing.assert_allclose(source, view.carm.source_mm)
        np.testing.assert_allclose(middle, 0, atol=1e-9)
        assert np.linalg.norm(detector - source) == pytest.approx(view.carm.sdd_mm)


def test_what_came_before_a_refusal_is_kept(tmp_path):
    angiograms, grid, _ = tiny_case()
    options = dataclasses.replace(OPTIONS, quality=QualityOptions(max_disagreement=-1.0))
    keep = StepFolder(tmp_path / "steps")
    with pytest.raises(RefusedError, match="contradict"):
        Engine(options=options).reconstruct(angiograms, grid, on_step=keep)
    assert sorted(p.name for p in (tmp_path / "steps").iterdir()) == sorted([*VIEWS, *PLACED])


def test_a_folder_that_exists_is_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(UsageError, match="exists"):
        StepFolder(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]


def test_gcar_run_keeps_them_beside_the_result(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    case = demo_case()
    run = ["run", *map(str, case.pictures), "--geom", str(case.geometry), "--predictor", "none",
           "--refiner", "none", "--quiet", "--out", "out", "--keep-steps"]  # fmt: skip
    inside = CliRunner().invoke(gcar, [*run, "out/steps"])
    assert isinstance(inside.exception, UsageError) and "lies in --out" in str(inside.exception)
    assert not list(tmp_path.iterdir())
    assert CliRunner().invoke(gcar, [*run, "steps"]).exit_code == 0
    assert {"5-tree-after.vtp", "1-vessels-view2-mask.png"} <= set(os.listdir("steps"))
    assert (tmp_path / "out" / "result.json").is_file()

"""Engine: inputs of every kind, the same bytes in every thread, progress, deadline, cancel."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import json
import shutil
import threading

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from gcar_deploy import CArm, Engine, Result, RunOptions
from gcar_deploy.config import PredictOptions
from gcar_deploy.errors import CancelledError, GeometryError, ImageError, ModelError, UsageError
from gcar_deploy.geometry.scene import Intensity, Scene, View, scene_to_json
from gcar_deploy.imaging.net import KIND
from gcar_deploy.models import golden_path
from gcar_deploy.selftest import tiny_case
from tests.conftest import ready_case

HULL = RunOptions(predict=PredictOptions(predictor="none"))


@pytest.fixture(scope="module")
def case():
    angiograms, grid, _ = tiny_case()
    views = tuple(View(id=a.view_id, carm=a.carm, intensity=a.intensity) for a in angiograms)
    return angiograms, grid, Scene(views=views, grid=grid)


@pytest.fixture(scope="module")
def engine():
    return Engine(options=HULL)


def content(result: Result) -> bytes:
    parts = [result.volume, result.tree.points(), result.tree.radii(), result.gaussians.means_mm]
    return b"".join(np.ascontiguousarray(part).tobytes() for part in parts)


@pytest.mark.slow
def test_arrays_with_a_scene_a_dict_or_a_file_give_one_result(case, engine, tmp_path):
    angiograms, grid, scene = case
    arrays = [a.pixels.astype(np.uint16) for a in angiograms]
    file = tmp_path / "geom.json"
    file.write_text(scene_to_json(scene))
    whole = content(engine.reconstruct(angiograms, grid))
    for geometry in (scene, json.loads(scene_to_json(scene)), file, str(file)):
        assert content(engine.reconstruct(arrays, geometry)) == whole


def test_masks_alone_give_the_tree(case):
    angiograms, _, scene = case
    _, _, tree = tiny_case()
    views = tuple(dataclasses.replace(v, intensity=Intensity(kind="mask")) for v in scene.views)
    masks = [(a.pixels > 300).astype(np.uint8) * 255 for a in angiograms]
    found = Engine(threads=1).reconstruct(masks, dataclasses.replace(scene, views=views))
    assert [v.kind for v in found.views] == ["mask"] * 2
    off = cKDTree(tree.points()).query(found.tree.points())[0]
    missed = cKDTree(found.tree.points()).query(tree.points())[0]
    assert off.mean() < 1.0 and missed.mean() < 1.0


def test_a_segmenter_of_ones_own_finds_the_vessels(case, tmp_path):
    angiograms, grid, _ = case
    mine = tmp_path / "mine.onnx"
    shutil.copy(KIND.path, mine)
    shutil.copy(golden_path(KIND.path), golden_path(mine))
    spec = json.loads(KIND.path.with_suffix(".json").read_text())
    mine.with_suffix(".json").write_text(json.dumps({**spec, "name": "mine"}))
    # On an even ground no network would be asked.
    ground = 1000 + 300 * np.sin(np.arange(angiograms[0].pixels.shape[1]) / 9)
    raw = [
        dataclasses.replace(
            a, pixels=(ground * np.exp(-0.0005 * a.pixels)).astype(np.float32),
            intensity=Intensity(kind="raw"),
        )
        for a in angiograms
    ]  # fmt: skip
    options = dataclasses.replace(HULL, imaging=dataclasses.replace(HULL.imaging, segmenter="net"))
    found = Engine(threads=1, options=options, segmenter_model=mine).reconstruct(raw, grid)
    assert found.segmenter["name"] == "mine"
    with pytest.raises(ModelError, match=r"gone\.onnx"):
        Engine(threads=1, options=HULL, segmenter_model=tmp_path / "gone.onnx")


@pytest.mark.slow
@pytest.mark.req("REQ-36")
def test_threads_share_one_engine_and_agree_to_the_byte(case, engine):
    angiograms, grid, _ = case
    alone = content(engine.reconstruct(angiograms, grid))
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        runs = [pool.submit(engine.reconstruct, angiograms, grid) for _ in range(8)]
        assert {content(run.result()) for run in runs} == {alone}


@pytest.mark.slow
def test_eight_threads_share_the_shipped_model_to_the_byte(case, request):
    """40 calls a thread with --run-benchmarks, 2 without."""
    angiograms, grid, _ = case
    calls = 40 if request.config.getoption("--run-benchmarks") else 2
    engine = Engine(threads=1)
    alone = content(engine.reconstruct(angiograms, grid))
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        runs = [pool.submit(engine.reconstruct, angiograms, grid) for _ in range(8 * calls)]
        assert {content(run.result()) for run in runs} == {alone}


@pytest.mark.slow
def test_a_busy_pool_of_opencv_changes_no_byte():
    """OpenCV's threads are the process's: while others use them, a call has one."""
    folder = ready_case("R_0001")
    views, before = (folder / "view1.png", folder / "view2.png"), cv2.getNumThreads()
    engine, found = Engine(threads=1), set()
    try:
        for threads in (1, 2, 5):
            cv2.setNumThreads(threads)
            found.add(content(engine.reconstruct(views, folder / "geom.json")))
    finally:
        cv2.setNumThreads(before)
    assert len(found) == 1


def test_an_existing_session_is_used_as_it_is(case):
    ort = pytest.importorskip("onnxruntime")
    from gcar_deploy.predict.kinds import MULTI

    angiograms, grid, _ = case
    ran = []

    class Session(ort.InferenceSession):
        def run(self, *arguments):
            ran.append(self)
            return super().run(*arguments)

    session = Session(str(MULTI.path), providers=["CPUExecutionProvider"])
    engine = Engine(session=session)
    assert content(engine.reconstruct(angiograms, grid)) == content(
        Engine().reconstruct(angiograms, grid)
    )
    assert ran and set(map(id, ran)) == {id(session)}


def test_a_running_inference_is_cut(case, monkeypatch):
    """Asked from another thread, since inference holds the calling one."""
    from gcar_deploy.models import session

    monkeypatch.setattr(session, "WATCH_S", 1e-4)
    angiograms, grid, _ = case
    stage, askers = [""], set()

    def cancel():
        if stage[0] == "centers":
            askers.add(threading.current_thread().name)
        return "gcar-watch" in askers

    with pytest.raises(CancelledError, match="by the caller"):
        Engine(threads=1).reconstruct(
            angiograms, grid, on_progress=lambda s, _: stage.__setitem__(0, s), cancel=cancel
        )
    assert "gcar-watch" in askers and stage[0] == "centers"
    assert not any(t.name == "gcar-watch" for t in threading.enumerate())


def test_the_process_is_left_as_it_was(case, engine):
    import os

    import cv2

    angiograms, grid, _ = case
    before = dict(os.environ), os.getcwd(), cv2.getNumThreads(), np.geterr()
    engine.reconstruct(angiograms, grid, deadline_s=60.0, cancel=lambda: False)
    after = dict(os.environ), os.getcwd(), cv2.getNumThreads(), np.geterr()
    assert before == after
    assert not any(t.name == "gcar-watch" for t in threading.enumerate())


def test_progress_rises_from_stage_to_stage(case, engine):
    angiograms, grid, _ = case
    seen = []
    engine.reconstruct(angiograms, grid, on_progress=lambda *step: seen.append(step))
    shares = [share for _, share in seen]
    assert shares == sorted(shares) and shares[0] == 0.0 and shares[-1] == pytest.approx(1.0)
    assert {"vessels", "candidates", "refine", "tree"} <= {stage for stage, _ in seen}


@pytest.mark.req("REQ-21")
def test_cancel_ends_within_a_stage(case, engine):
    angiograms, grid, _ = case
    flag = threading.Event()
    stages = []

    def stop_at_refine(stage, _):
        stages.append(stage)
        if stage == "refine":
            flag.set()

    with pytest.raises(CancelledError, match="cancelled"):
        engine.reconstruct(angiograms, grid, on_progress=stop_at_refine, cancel=flag.is_set)
    assert "quality" not in stages


@pytest.mark.req("REQ-21")
def test_a_deadline_before_any_result_is_an_error(case, engine):
    angiograms, grid, _ = case
    with pytest.raises(CancelledError, match="deadline"):
        engine.reconstruct(angiograms, grid, deadline_s=1e-9)


def test_result_as_json_and_folder(case, engine, tmp_path):
    angiograms, grid, _ = case
    result = engine.reconstruct(angiograms, grid)
    assert json.loads(result.to_json())["status"] == result.status
    assert result.save(tmp_path / "out") == tmp_path / "out"
    assert (tmp_path / "out" / "result.json").is_file()
    assert (
        result.seconds["total"] >= sum(v for k, v in result.seconds.items() if k != "total") - 0.01
    )


@pytest.mark.req("REQ-36")
def test_nothing_is_printed(case, engine, capfd):
    angiograms, grid, _ = case
    engine.warmup()
    engine.reconstruct(angiograms, grid)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.zeros((96, 96), np.int32), "int32"),
        (np.zeros((96, 96, 3), np.uint8), "3 dimensions"),
        (np.full((96, 96), np.nan, np.float32), "finite"),
        (np.full((96, 96), -1.0), "negative"),
        (np.zeros((1, 1), np.uint8), "1 x 1"),
        (np.zeros((96, 96), bool), "bool"),
        (np.ma.masked_less(np.ones((96, 96)), [[2.0, 0.0] * 48]), "4608 pixels .* masked"),
    ],
)
def test_unfit_arrays(case, engine, array, words):
    angiograms, _, scene = case
    with pytest.raises(ImageError, match=words):
        engine.reconstruct([angiograms[0].pixels, array], scene)


def test_masks_of_truth_values_and_arrays_without_a_masked_pixel_are_taken(case, engine):
    angiograms, _, scene = case
    views = tuple(dataclasses.replace(v, intensity=Intensity(kind="mask")) for v in scene.views)
    drawn = dataclasses.replace(scene, views=views)
    truth = [a.pixels > 300 for a in angiograms]
    found = engine.reconstruct(truth, drawn)
    grey = [one.astype(np.uint8) * 255 for one in truth]
    assert content(engine.reconstruct([np.ma.asarray(one) for one in grey], drawn)) == content(
        found
    )
    with pytest.raises(ImageError, match=r"mask 2: .* masked"):
        engine.reconstruct(grey, drawn, masks={2: np.ma.masked_equal(grey[1], 0)})


def test_path_lengths_with_noise_about_zero_are_taken(case, engine):
    angiograms, _, scene = case
    scale = scene.views[0].intensity.mm_per_count
    rng = np.random.default_rng(2)
    clean = [np.asarray(a.pixels, np.float32) for a in angiograms]
    noisy = [p + rng.normal(0, 0.02 / scale, p.shape).astype(np.float32) for p in clean]
    assert min(p.min() for p in noisy) < 0
    found = engine.reconstruct(noisy, scene)
    same = engine.reconstruct([np.maximum(p, 0) for p in noisy], scene)
    np.testing.assert_array_equal(found.volume, same.volume)
    assert found.volume.max() > 0.5


@pytest.mark.parametrize("edge", [12, 4, 1])
def test_voxels_wider_than_any_pixel_do_not_end_the_run(case, edge):
    """The pictures are not averaged to pixels of that size, which no geometry may have."""
    angiograms, grid, _ = case
    wanted = dataclasses.replace(grid, shape=(edge,) * 3)
    found = Engine().reconstruct(angiograms, wanted)
    fine = Engine().reconstruct(angiograms, grid)
    assert found.volume.shape == (edge,) * 3
    assert found.tree.length_mm == pytest.approx(fine.tree.length_mm, rel=0.05)
    blood_mm3 = found.volume.sum() * np.prod(wanted.spacing_mm)
    assert blood_mm3 == pytest.approx(fine.volume.sum() * np.prod(grid.spacing_mm), rel=0.1)


def test_wrong_calls(case, engine, tmp_path):
    angiograms, grid, scene = case
    with pytest.raises(UsageError, match="two or more"):
        engine.reconstruct(angiograms[:1], grid)
    with pytest.raises(GeometryError, match="3 pictures"):
        engine.reconstruct([*angiograms, angiograms[0]], scene)
    with pytest.raises(UsageError, match="Grid alone"):
        engine.reconstruct([a.pixels for a in angiograms], grid)
    with pytest.raises(UsageError, match="deadline_s"):
        engine.reconstruct(angiograms, grid, deadline_s=0)
    with pytest.raises(UsageError, match="threads"):
        Engine(options=HULL, threads=0)
    with pytest.raises(ModelError):
        Engine(tmp_path / "none.onnx")


def test_what_is_no_function_is_said_before_any_work(case, engine):
    angiograms, grid, _ = case
    for key in ("cancel", "on_progress", "on_step"):
        with pytest.raises(UsageError, match=f"{key} is a int; give a function"):
            engine.reconstruct(angiograms, grid, **{key: 3})


def test_no_path_and_the_empty_one_name_nothing(case, engine, tmp_path, monkeypatch):
    """``Path("")`` is the working folder, whose pictures would be taken for a run."""
    angiograms, grid, scene = case
    pixels = [a.pixels.astype(np.uint16) for a in angiograms]
    for k, one in enumerate(pixels):
        cv2.imwrite(str(tmp_path / f"{k}.png"), one)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ImageError, match="view 2 is empty text"):
        engine.reconstruct([pixels[0], ""], scene)
    with pytest.raises(ImageError, match="mask 1 is empty text"):
        engine.reconstruct(pixels, scene, masks={1: ""})
    with pytest.raises(GeometryError, match="geometry is empty text"):
        engine.reconstruct(pixels, "")
    with pytest.raises(ModelError, match="model is empty text"):
        Engine("")
    with pytest.raises(UsageError, match="segmenter_model is a int"):
        Engine(segmenter_model=3)
    found = engine.reconstruct(angiograms, grid)
    for wrong, words in (("", "is empty text"), (None, "is a NoneType"), ("a\0b", "NUL")):
        with pytest.raises(UsageError, match=f"out_dir .*{words}"):
            found.save(wrong)


@pytest.fixture(scope="module")
def learned():
    return Engine(threads=1)


def _changed(angiograms, grid, change):
    """The same scene told in another way; where its tree comes out, and its views' order."""
    if change == "order":
        return angiograms[::-1], grid, np.zeros(3)
    if change == "border":
        wide = []
        for a in angiograms:
            column, row = a.carm.principal_point
            carm = dataclasses.replace(
                a.carm, rows=a.carm.rows + 5, columns=a.carm.columns + 3,
                principal_point_px=(column + 3, row + 5),
            )  # fmt: skip
            wide.append(
                dataclasses.replace(a, carm=carm, pixels=np.pad(a.pixels, ((5, 0), (3, 0))))
            )
        return wide, grid, np.zeros(3)
    shift = np.array(change)
    moved = [dataclasses.replace(a, carm=a.carm.moved(shift)) for a in angiograms]
    center = tuple(float(c - s) for c, s in zip(grid.center_mm, shift, strict=True))
    return moved, dataclasses.replace(grid, center_mm=center), -shift


@pytest.mark.slow
@pytest.mark.req("REQ-36")
@pytest.mark.parametrize(
    "change", [(3e-7, -9e-7, 1e-6), (1.37, -2.21, 0.83), "order", "border"], ids=str
)
@pytest.mark.parametrize("kind", ["path_length", "mask"])
def test_the_same_scene_gives_the_same_tree(case, learned, kind, change):
    angiograms, grid, _ = case
    if kind == "mask":
        angiograms = [
            dataclasses.replace(
                a, pixels=(a.pixels > 300).astype(np.float32), intensity=Intensity(kind="mask")
            )
            for a in angiograms
        ]
    angiograms = [dataclasses.replace(a, sha256=str(k)) for k, a in enumerate(angiograms)]
    told, asked, back = _changed(angiograms, grid, change)
    base, found = learned.reconstruct(angiograms, grid), learned.reconstruct(told, asked)
    assert found.quality.status == base.quality.status
    apart = np.linalg.norm(found.tree.points() - base.tree.points() - back, axis=1)
    if kind == "mask":
        # Loose paths let the fit amplify the last digit: 0.1 mm on the mean is what is promised.
        assert apart.mean() < 0.1
        assert np.abs(found.volume - base.volume).mean() < 1e-3
    else:
        assert apart.max() < 1e-3
        np.testing.assert_allclose(found.volume, base.volume, atol=1e-3)
    # views and poses come back in the order in which they were told
    names = [a.view_id for a in told]
    assert [v.view_id for v in found.views] == names
    assert [v.view_id for v in found.quality.views] == names
    for view, angiogram in zip(found.views, told, strict=True):
        assert view.carm == angiogram.carm  # no pose was needed


def test_a_moved_patient_is_noticed(case, engine):
    angiograms, grid, _ = case
    second: CArm = angiograms[1].carm.moved((0.0, 0.0, 3.0))
    moved = [angiograms[0], dataclasses.replace(angiograms[1], carm=second)]
    result = engine.reconstruct(moved, grid)
    along = result.poses[1].offset_mm[2]
    assert along < -1.0
    said = json.loads(result.to_json())
    assert said["views"][1]["estimated_offset_mm"][2] == pytest.approx(along)


def test_a_pose_that_was_found_hides_no_silent_error(case, engine):
    angiograms, grid, _ = case
    result = engine.reconstruct(angiograms, grid)
    first, second = result.views
    far = dataclasses.replace(second, carm=second.carm.moved((0.0, 0.0, 12.0)))
    told, found = (
        json.loads(one.to_json())["silent_errors"]
        for one in (result, dataclasses.replace(result, views=(first, far)))
    )
    assert told == found and any("pixel spacing" in text for text in told)

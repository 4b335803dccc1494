"""Runs as folders of pictures and as TIFF of several pages, and what they come to as views."""

from __future__ import annotations

import dataclasses
import json
import struct

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image as Pillow

from gcar_deploy.config import DicomLimits, DicomOptions, RunOptions
from gcar_deploy.dicom.choose import choose_frame
from gcar_deploy.errors import ImageError, UsageError
from gcar_deploy.frames.cine import Cine, is_cine, open_cine
from gcar_deploy.geometry.scene import Intensity, Scene, View, scene_to_json
from gcar_deploy.imaging.chosen_frame import ChosenFrame, FramePair
from gcar_deploy.inputs.pictures import prepare
from gcar_deploy.inputs.runs import find_runs
from gcar_deploy.quality import check_views
from gcar_export.scenes.cine import cine_pair
from gcar_export.studies.frame_pairs import CHOSEN_ON
from tests.cli.conftest import gcar

OPTIONS = RunOptions()


@pytest.fixture(scope="module")
def made():
    return cine_pair(CHOSEN_ON, 3)


@pytest.fixture(scope="module")
def case(made, tmp_path_factory):
    """Folders run1, run2 and run1.tif, run2.tif of one patient, written by other programs."""
    folder = tmp_path_factory.mktemp("cine")
    views = []
    for k, run in enumerate(made.runs, start=1):
        (folder / f"run{k}").mkdir()
        for i, pixels in enumerate(run.pixels, start=1):
            Pillow.fromarray(pixels).save(folder / f"run{k}" / f"frame{i}.png")
        tifffile.imwrite(folder / f"run{k}.tif", run.pixels, photometric="minisblack")
        intensity = Intensity(kind="raw", polarity="auto")
        views.append(View(id=str(k), carm=run.carm, intensity=intensity))
    (folder / "geom.json").write_text(scene_to_json(Scene(views=tuple(views))))
    return folder


def test_frames_stand_in_the_order_of_their_numbers(made, case):
    for name in ("run1", "run1.tif"):
        cine = open_cine(case / name, OPTIONS)
        assert is_cine(case / name) and len(cine) == 15
        for k in (0, 1, 9, 14):  # frame 10 is not after frame 1
            np.testing.assert_array_equal(cine.decode(k), made.runs[0].pixels[k])


def test_one_page_and_one_picture_are_no_runs(case, tmp_path):
    tifffile.imwrite(tmp_path / "one.tif", np.zeros((32, 32), np.uint8))
    assert not is_cine(tmp_path / "one.tif")
    assert open_cine(case / "run1" / "frame1.png", OPTIONS) is None


def test_bad_runs_are_refused_in_one_line(tmp_path):
    folder = tmp_path / "empty"
    folder.mkdir()
    with pytest.raises(ImageError, match="empty: the folder holds no picture"):
        open_cine(folder, OPTIONS)
    for k, side in enumerate((32, 40)):
        Pillow.fromarray(np.zeros((side, 32), np.uint8)).save(folder / f"{k}.png")
    with pytest.raises(ImageError, match=r"1\.png has \(40, 32\)"):
        open_cine(folder, OPTIONS).decode(1)
    with tifffile.TiffWriter(tmp_path / "mixed.tif") as out:
        for side in (32, 40):
            out.write(np.zeros((side, 32), np.uint8), photometric="minisblack")
    with pytest.raises(ImageError, match="several sizes"):
        open_cine(tmp_path / "mixed.tif", OPTIONS)
    stack = np.zeros((5, 32, 32), np.uint8)
    tifffile.imwrite(tmp_path / "many.tif", stack, photometric="minisblack")
    few = RunOptions(dicom=DicomOptions(limits=DicomLimits(max_frames=3)))
    with pytest.raises(ImageError, match="more than 3 pages"):
        open_cine(tmp_path / "many.tif", few)


@pytest.mark.parametrize("name", ["run", "run.tif"])
@pytest.mark.parametrize("kind", ["attenuation", "raw"])
def test_noise_below_zero_of_subtracted_frames(made, tmp_path, kind, name):
    """What subtraction leaves lies about 0; counts of a detector do not."""
    frames = np.random.default_rng(3).normal(size=(3, 48, 48)).astype("f4")
    frames[1, 20:28] += 40
    (tmp_path / "run").mkdir()
    for k, frame in enumerate(frames):
        np.save(tmp_path / "run" / f"{k}.npy", frame)
    tifffile.imwrite(tmp_path / "run.tif", frames, photometric="minisblack")
    view = View(id="1", carm=made.runs[0].carm.resized(48, 48), intensity=Intensity(kind=kind))
    views, scene = [tmp_path / name] * 2, Scene(views=(view, dataclasses.replace(view, id="2")))
    if kind == "raw":
        with pytest.raises(ImageError, match="negative"):
            find_runs(views, OPTIONS, scene).cines[1].decode(1)
        return
    cine = find_runs(views, OPTIONS, scene).cines[1]
    np.testing.assert_array_equal(cine.decode(1), np.maximum(frames[1], 0))


def test_pages_that_run_in_a_circle_end(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((2, 32, 32), np.uint8), photometric="minisblack")
    data = bytearray((tmp_path / "a.tif").read_bytes())
    (first,) = struct.unpack_from("<I", data, 4)
    (entries,) = struct.unpack_from("<H", data, first)
    struct.pack_into("<I", data, first + 2 + 12 * entries, first)
    (tmp_path / "circle.tif").write_bytes(data)
    with pytest.raises(ImageError, match="runs in a circle"):
        open_cine(tmp_path / "circle.tif", OPTIONS)


@pytest.mark.parametrize("polarity", ["auto", "bright"])
def test_a_run_in_which_vessels_are_bright_chooses_the_frame_of_the_dark_one(made, polarity):
    def chosen(pixels, polarity):
        cine = Cine(name="run", count=len(pixels), read=lambda k: (np.float32(pixels[k]), 8, ""))
        return choose_frame(cine, None, intensity=Intensity(kind="raw", polarity=polarity)).index

    # Seen alone, the second run does not tell which it is, and is taken as is usual.
    for run in made.runs[:1] if polarity == "auto" else made.runs:
        assert chosen(255 - run.pixels, polarity) == chosen(run.pixels, "dark")


@pytest.mark.slow
def test_auto_takes_a_pair_of_one_phase_from_folders(made, case):
    views = [case / "run1", case / "run2"]
    angiograms, _, notes = prepare(views, case / "geom.json", OPTIONS)
    frames = [a.frame for a in angiograms]
    at = frames[0].number - 1, frames[1].number - 1
    assert (made.phase_error() * made.frames_per_beat())[at] <= 1
    assert frames[0].partner == 2 and frames[0].pair is frames[1].pair
    for k in range(2):
        np.testing.assert_array_equal(angiograms[k].pixels, made.runs[k].pixels[at[k]])
    assert any(f"goes with frame {at[1] + 1} of view 2" in note for note in notes)


@pytest.mark.parametrize(("margin", "doubted"), [(0.01, True), (0.2, False), (None, False)])
def test_a_small_margin_is_a_finding(case, margin, doubted):
    views = [case / "run1" / "frame8.png", case / "run2" / "frame8.png"]
    angiograms, _, _ = prepare(views, case / "geom.json", OPTIONS)
    ones = (np.ones(2), np.ones(2))
    pair = FramePair(
        scores=np.ones((2, 2)), remaining=np.ones((2, 2), bool), chosen=(0, 1), margin=margin,
        filling=ones, motion=ones,
    )  # fmt: skip
    frame = ChosenFrame(number=1, of=2, reason="", pair=pair, partner=2)
    told = [dataclasses.replace(a, frame=frame) for a in angiograms]
    findings = check_views(told, OPTIONS.quality)
    assert any("two phases of the heart" in text for text in findings) == doubted


def test_frames_that_are_asked_for_are_taken_as_they_are(made, case):
    views = [case / "run1", case / "run2.tif"]
    options = RunOptions(dicom=DicomOptions(frames=(7, 12)))
    angiograms, _, _ = prepare(views, case / "geom.json", options)
    assert [a.frame for a in angiograms] == [None, None]
    np.testing.assert_array_equal(angiograms[1].pixels, made.runs[1].pixels[11])
    with pytest.raises(UsageError, match=r"--frame 16 is outside 1 \.\. 15 of run1"):
        options = RunOptions(dicom=DicomOptions(frames=(16,)))
        prepare(views, case / "geom.json", options)


@pytest.mark.slow
def test_the_verb_tells_the_pair_with_a_picture(made, case, tmp_path):
    told = gcar("frames", case / "run1.tif", case / "run2", "--geom", case / "geom.json",
                "--out", tmp_path / "pairs", "--json")  # fmt: skip
    assert told.code == 0, told.err
    found = json.loads(told.out)
    i, j = (k - 1 for k in found["frames"])
    assert (made.phase_error() * made.frames_per_beat())[i, j] <= 1
    assert np.shape(found["scores"]) == (15, 15) and found["moves"] == [True, True]
    for k, frame in ((1, i), (2, j)):
        kept = cv2.imread(str(tmp_path / "pairs" / f"frame_view{k}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(kept, made.runs[k - 1].pixels[frame])
    picture = cv2.imread(str(tmp_path / "pairs" / "frames.png"))
    assert picture.shape[1] > picture.shape[0] > 500
    text = gcar("frames", case / "run1", case / "run2", "--geom", case / "geom.json")
    assert f"frames {i + 1} and {j + 1}: score" in text.out and "margin" in text.out
    one = gcar("frames", case / "run1" / "frame1.png", case / "run2", "--geom", case / "geom.json")
    assert one.code == 2 and "frame1.png is no run of several frames" in one.err


@pytest.mark.slow
def test_a_result_keeps_the_chosen_frames(made, case, tmp_path):
    done = gcar("run", case / "run1", case / "run2", "--geom", case / "geom.json",
                "--out", tmp_path / "result")  # fmt: skip
    assert done.code == 0, done.err
    told = json.loads((tmp_path / "result" / "result.json").read_text())
    for k, run in enumerate(made.runs):
        frame = told["views"][k]["picture"]["frame"]
        assert frame["of"] == 15 and frame["margin"] > 0.03 and frame["partner"] == 2 - k
        kept = cv2.imread(str(tmp_path / "result" / f"frame_view{k + 1}.png"), -1)
        np.testing.assert_array_equal(kept, run.pixels[frame["number"] - 1])

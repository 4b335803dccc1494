"""Frames before contrast: of runs that begin early, and none of those that begin filled."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from PIL import Image as Pillow

from gcar_deploy.config import DicomOptions, RunOptions
from gcar_deploy.frames.bare import MOST, bare_before, bare_frames
from gcar_deploy.frames.choose import SeenRun
from gcar_deploy.frames.cine import Cine
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.scene import Intensity, Scene, View, scene_to_json
from gcar_deploy.inputs.pictures import prepare
from gcar_export.scenes.cine import cine_pair
from gcar_export.studies.frame_pairs import CHOSEN_ON
from tests.cli.conftest import gcar
from tests.dicom.files import classic, save

CARM = CArm(
    primary_angle_deg=0.0, secondary_angle_deg=0.0, sod_mm=750.0, sdd_mm=1000.0, rows=256,
    columns=256, pixel_spacing_mm=(0.6, 0.6),
)  # fmt: skip


@pytest.mark.parametrize(
    ("filling", "bare"),
    [
        ([0.0, 0.0, 0.0, 0.0, 0.2, 0.9, 1.0], (0, 1, 2)),
        ([0.3, 0.35, 0.28, 0.3, 0.7, 1.0], (0, 1, 2)),  # a catheter that beats
        ([0.0, 0.9, 1.0], ()),  # the frame before the first drop is not surely bare
        ([0.9, 0.8, 1.0, 0.9, 1.0], ()),
        ([0.6, 0.6, 0.6, 1.0, 1.0], ()),  # half full is not bare
        ([0.3, 0.3, 0.3, 0.5, 0.6], ()),  # hardly more comes
    ],
)
def test_frames_before_the_first_drop(filling, bare):
    assert bare_frames(np.array(filling)) == bare


def test_of_many_some_are_taken_from_all_over():
    frames = bare_frames(np.array([0.0] * 41 + [1.0] * 10))
    assert len(frames) == MOST and frames[0] == 0 and frames[-1] == 39


def _run(filled_from: int, frames: int = 12, still: bool = False) -> SeenRun:
    """Draw vessels that beat and fill from a frame on, a catheter in all frames, and a rib."""
    rng = np.random.default_rng(3)
    pictures = []
    for k in range(frames):
        beat = 0.0 if still else 6 * np.sin(2 * np.pi * k / 5)
        absorbed = np.zeros((256, 256), np.float32)
        cv2.polylines(absorbed, [_course(beat)], False, 0.5, 4)
        tree = np.zeros_like(absorbed)
        for turn in np.linspace(0.3, 2.6, 5):
            way = np.arange(8, 110, 4.0)
            row = 100 + beat + way * np.sin(turn) + 6 * np.sin(way / 15 + turn)
            column = 128 + 0.6 * beat + way * np.cos(turn)
            cv2.polylines(tree, [np.stack([column, row], 1).astype(np.int32)], False, 0.7, 4)
        share = np.clip((k - filled_from + 1) / 2, 0, 1)
        absorbed = cv2.GaussianBlur(np.maximum(absorbed, share * tree), (0, 0), 1.0)
        absorbed += 0.2 * (np.abs(np.arange(256) - 200) < 12)[:, None]
        light = np.exp(-absorbed) + 0.01 * rng.normal(size=absorbed.shape)
        pictures.append(np.clip(200 * light, 0, 255).astype(np.float32))
    cine = Cine(name="run", count=frames, read=lambda k: (pictures[k], 8, ""))
    return SeenRun(cine=cine, carm=CARM, intensity=Intensity(kind="raw"))


def _course(beat: float) -> np.ndarray:
    return np.array([[20, 0], [60, 30], [110, 70], [128 + int(0.6 * beat), 100 + int(beat)]])


def test_a_run_that_begins_early_has_some_and_one_that_begins_filled_none():
    assert bare_before(_run(6), 11) == (0, 1, 2, 3, 4)
    assert bare_before(_run(-5), 11) == ()


def test_of_a_long_run_only_the_last_seconds_are_read():
    short, read = _run(6), []

    def late(k):
        read.append(k)
        return short.cine.read(min(max(0, k - 400), 11))

    cine = Cine(name="long", count=422, read=late)
    long = SeenRun(cine=cine, carm=CARM, intensity=Intensity(kind="raw"))
    frames = bare_before(long, 421)
    assert len(frames) == MOST and min(read) == frames[0] == 331 and 390 < frames[-1] < 406
    assert len(read) == len(set(read)) == 91


def test_a_phantom_at_rest_has_none():
    assert bare_before(_run(-5, still=True), 11) == ()


def test_the_first_frames_of_a_run_have_nothing_before_them():
    assert bare_before(_run(6), 1) == ()


@pytest.fixture(scope="module")
def patient(tmp_path_factory):
    """Folders of frames of one patient whose contrast comes late, and the truth."""
    made = cine_pair(CHOSEN_ON, 6, 22, 8.0)
    folder = tmp_path_factory.mktemp("late")
    views = []
    for k, run in enumerate(made.runs, start=1):
        (folder / f"run{k}").mkdir()
        for i, pixels in enumerate(run.pixels, start=1):
            Pillow.fromarray(pixels).save(folder / f"run{k}" / f"frame{i}.png")
        views.append(View(id=str(k), carm=run.carm, intensity=Intensity(kind="raw")))
    (folder / "geom.json").write_text(scene_to_json(Scene(views=tuple(views))))
    return made, folder


@pytest.mark.slow
def test_a_chosen_frame_and_the_same_asked_for_know_the_same_frames_before(patient):
    made, folder = patient
    views = [folder / "run1", folder / "run2"]
    chosen, _, notes = prepare(views, folder / "geom.json", RunOptions())
    numbers = tuple(a.frame.number for a in chosen)
    options = RunOptions(dicom=DicomOptions(frames=numbers))
    asked, _, said = prepare(views, folder / "geom.json", options)
    for k, (a, b) in enumerate(zip(chosen, asked, strict=True)):
        assert len(a.bare) == len(b.bare) > 0
        filled = made.runs[k].path_mm.sum(axis=(1, 2))
        pixels = made.runs[k].pixels
        for one, other in zip(a.bare, b.bare, strict=True):
            np.testing.assert_array_equal(one, other)
            number = [np.array_equal(one, frame) for frame in pixels].index(True)
            assert filled[number] < 0.01 * filled.max()
    for told in (notes, said):
        assert sum("hold no contrast yet" in note for note in told) == 2


@pytest.mark.slow
def test_pictures_and_early_frames_know_none(patient):
    _, folder = patient
    early = RunOptions(dicom=DicomOptions(frames=(1,)))
    one = folder / "run2" / "frame20.png"
    angiograms, _, _ = prepare([folder / "run1", one], folder / "geom.json", early)
    assert [a.bare for a in angiograms] == [(), ()]


@pytest.mark.slow
def test_dicom_runs_know_them_in_run_and_in_enhance(tmp_path):
    cine = _run(6).cine
    pixels = np.stack([cine.decode(k) for k in range(len(cine))]).astype(np.uint8)
    spacing = {"ImagerPixelSpacing": ["0.6", "0.6"]}
    views = [
        save(classic(pixels, PositionerPrimaryAngle=angle, **spacing), tmp_path / f"run{angle}.dcm")
        for angle in ("-40", "30")
    ]
    options = RunOptions(dicom=DicomOptions(frames=(12,)))
    angiograms, _, notes = prepare(views, None, options)
    for one in angiograms:
        np.testing.assert_array_equal(one.bare, pixels[:5])
    assert sum("frames 1 .. 5 hold no contrast yet" in note for note in notes) == 2
    told = gcar("enhance", views[0], "--frame", "12", "--out", tmp_path / "seen")
    assert told.code == 0 and "frames 1 .. 5 hold no contrast yet" in told.err
    mask = cv2.imread(str(tmp_path / "seen" / "mask.png"), cv2.IMREAD_GRAYSCALE) > 0
    catheter = np.zeros(mask.shape, np.uint8)
    cv2.polylines(catheter, [_course(6 * np.sin(2 * np.pi * 11 / 5))[:3]], False, 1, 1)
    assert mask[catheter > 0].mean() < 0.2 and mask.mean() > 0.02

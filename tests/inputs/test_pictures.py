"""What a caller in Python may get wrong is one sentence of the project, whatever its type."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest

from gcar_deploy.config import DicomOptions, PredictOptions, RunOptions
from gcar_deploy.engine import Engine
from gcar_deploy.errors import GcarError, GeometryError, ImageError, UsageError
from gcar_deploy.inputs.pictures import prepare
from tests.cli.conftest import geometry, good_case  # noqa: F401 - a fixture

MASK = np.eye(96, dtype=bool)
THIN = RunOptions(predict=PredictOptions(predictor="none"))


@pytest.mark.parametrize(
    ("views", "words"),
    [
        ("view1.png", "views is a str; give a list of two or more pictures"),
        (b"view1.png", "views is a bytes; give a list"),
        ({"a": 1, "b": 2}, "views is a dict; give a list"),
        (None, "views is a NoneType; give a list"),
        ([], "0 picture given"),
        (["view1.png"], "1 picture given"),
        (["view1.png", 3], "view 2 is a int; give a path, an array"),
        ([None, None], "view 1 is a NoneType"),
        ([[[1, 2], [3, 4]], np.zeros((96, 96))], "view 1 is a list"),
    ],
)
def test_views_of_a_wrong_type(views, words):
    with pytest.raises(UsageError) as refused:
        prepare(views, geometry(), RunOptions())
    assert words in str(refused.value)


@pytest.mark.parametrize(
    ("told", "words"),
    [(json.dumps({"a": 1}), "geometry is JSON text"), (7, "geometry is a int; give a path")],
)
def test_geometry_of_a_wrong_type(told, words):
    with pytest.raises(UsageError, match=words):
        prepare([np.zeros((96, 96), np.uint8)] * 2, told, RunOptions())


@pytest.mark.parametrize(
    ("masks", "words"),
    [
        ([MASK], "masks is a list; give a dict: number of the view"),
        (MASK, "masks is a ndarray; give a dict"),
        ({"1": MASK}, "masks has a str as a key; give a dict"),
        ({1: None}, "mask 1 is a NoneType; give a dict"),
        ({3: MASK}, "mask 3: there are views 1 .. 2"),
    ],
)
def test_masks_of_a_wrong_type(good_case, masks, words):  # noqa: F811
    files = [good_case / "view1.png", good_case / "view2.png"]
    with pytest.raises(UsageError, match=words):
        Engine(options=THIN).reconstruct(files, geometry(), masks=masks)


@pytest.mark.parametrize("kind", ["U4", "M8[s]", "c8", "u1,u1", "O"])
def test_masks_that_hold_no_numbers(good_case, kind):  # noqa: F811
    files = [good_case / "view1.png", good_case / "view2.png"]
    with pytest.raises(ImageError, match=r"mask 1 holds .*; give numbers or booleans"):
        Engine(options=THIN).reconstruct(files, geometry(), masks={1: np.zeros((96, 96), kind)})


def test_what_is_no_list_of_pictures_nor_a_geometry(good_case):  # noqa: F811
    deep = {"schema": "gcar-geometry/1"}
    for _ in range(100_000):
        deep = {"views": deep}
    with pytest.raises(UsageError, match="views is one number"):
        Engine(options=THIN).reconstruct(np.array(5), geometry())
    with pytest.raises(GeometryError, match="geometry cannot be written as JSON"):
        Engine(options=THIN).reconstruct([good_case / "view1.png"] * 2, deep)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_users_mask_of_nothing_or_of_far_too_much(good_case, share):  # noqa: F811
    files = [good_case / "view1.png", good_case / "view2.png"]
    mask = np.broadcast_to(np.arange(96) < share * 96, (96, 96))
    with pytest.raises(ImageError, match=rf"mask 1 marks {share:.0%} of .*at most 35% can"):
        prepare(files, geometry(), RunOptions(), {1: mask})


@pytest.mark.parametrize("value", [1e300, 1e39, np.inf, np.nan, -1.0])
@pytest.mark.filterwarnings("error")
def test_counts_that_single_precision_does_not_hold(value):
    views = [np.full((96, 96), value)] * 2
    with pytest.raises(ImageError, match="view 1: grey values must be finite in single precision"):
        prepare(views, geometry(), RunOptions())


def test_an_array_of_two_pictures_is_two_pictures(good_case):  # noqa: F811
    files = [good_case / "view1.png", good_case / "view2.png"]
    read = [one.pixels for one in prepare(files, geometry(), RunOptions())[0]]
    again = prepare(np.stack(read), geometry(), RunOptions())[0]
    for one, other in zip(again, read, strict=True):
        np.testing.assert_array_equal(one.pixels, other)


def test_what_has_nothing_to_act_on_is_said(good_case):  # noqa: F811
    files = [good_case / "view1.png", good_case / "view2.png"]
    asked = DicomOptions(frames=(3,), pixel_spacing_mm=0.3, sod_mm=700.0)
    notes = prepare(files, geometry(), RunOptions(dicom=asked))[2]
    for words in ("(frames) is not used", "pixel_spacing_mm as an option", "sod_mm as an option"):
        assert sum(words in note for note in notes) == 1
    assert not any("not used" in note for note in prepare(files, geometry(), RunOptions())[2])


def test_folders_of_dicom_files_say_what_to_name(tmp_path):
    """The 128 bytes and four letters that every DICOM file begins with."""
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / "IM1").write_bytes(bytes(128) + b"DICM")
    folders = [tmp_path / name for name in "ab"]
    with pytest.raises(UsageError, match="a is a folder: name the DICOM file of the run in it"):
        prepare(folders, None, RunOptions())
    with pytest.raises(ImageError, match="the folder holds DICOM files; name the run's file"):
        prepare(folders, geometry(), RunOptions())
    shutil.rmtree(folders[0])
    with pytest.raises(GcarError):
        prepare(folders, geometry(), RunOptions())


def test_a_geometry_of_numpys_numbers_is_taken():
    plain, pixels = geometry(), [np.zeros((96, 96), np.uint8)] * 2
    wanted, _, _ = prepare(pixels, plain, RunOptions())
    told = geometry()
    for view in told["views"]:
        view["primary_angle_deg"] = np.float32(view["primary_angle_deg"])
        view["rows"] = np.int64(view["rows"])
        view["pixel_spacing_mm"] = np.array(view["pixel_spacing_mm"])
    found, _, _ = prepare(pixels, told, RunOptions())
    assert [a.carm for a in found] == [a.carm for a in wanted]
    told["views"][0]["rows"] = np.True_
    with pytest.raises(GeometryError, match="rows = True"):
        prepare(pixels, told, RunOptions())


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("power", [-100, -60, 100, 112])
def test_counts_of_any_scale_are_the_same_picture(good_case, power):  # noqa: F811
    """A product of two counts must be a number of single precision, and none must be 0."""
    scene = json.loads((good_case / "geom.json").read_text())
    for view in scene["views"]:
        view["intensity"] = {"kind": "attenuation"}
    views = [
        cv2.imread(str(good_case / f"view{k}.png"), cv2.IMREAD_UNCHANGED).astype(np.float64)
        for k in (1, 2)
    ]
    engine = Engine(options=THIN, threads=1)
    usual = engine.reconstruct(views, scene)
    other = engine.reconstruct([np.ldexp(view, power) for view in views], scene)
    assert other.tree.length_mm == pytest.approx(usual.tree.length_mm, abs=1e-3)
    assert other.status == usual.status


def test_only_counts_far_out_are_scaled(good_case):  # noqa: F811
    for kind in ("attenuation", "raw", "mask"):
        scene = geometry()
        for view in scene["views"]:
            view["intensity"] = {"kind": kind}
        rows, columns = scene["views"][0]["rows"], scene["views"][0]["columns"]
        pixels = np.random.default_rng(3).random((rows, columns), np.float32)
        for power in (-31, 0, 31, 99):
            given = np.ldexp(pixels, power)
            found = prepare([given, given], scene, RunOptions())[0][0].pixels
            far = power == 99 and kind != "mask"
            np.testing.assert_array_equal(found, pixels if far else given)

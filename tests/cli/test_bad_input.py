"""Bad input ends with its exit code and one line that names it; nothing is ever written."""

from __future__ import annotations

import copy
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import cv2
import numpy as np
import pytest

from tests.cli.conftest import gcar

Edit = Callable[[dict[str, Any]], None]


def geometry(*edits: tuple[str, Any]) -> Callable[[Path], None]:
    """Change values of geom.json; a key like ``views.0.sod_mm``, ``...`` deletes."""

    def apply(folder: Path) -> None:
        file = folder / "geom.json"
        data = json.loads(file.read_text())
        for key, value in edits:
            *path, last = key.split(".")
            target = data
            for part in path:
                target = target[int(part) if part.isdigit() else part]
            name = int(last) if last.isdigit() else last
            if value is ...:
                del target[name]
            else:
                target[name] = copy.deepcopy(value)
        file.write_text(json.dumps(data))

    return apply


def text(content: str | bytes) -> Callable[[Path], None]:
    """Replace geom.json."""

    def apply(folder: Path) -> None:
        data = content if isinstance(content, bytes) else content.encode()
        (folder / "geom.json").write_bytes(data)

    return apply


def picture(make: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Change the pixels of view2.png."""

    def apply(folder: Path) -> None:
        file = folder / "view2.png"
        cv2.imwrite(str(file), make(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)))

    return apply


def mask(make: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Say that view 2 is a mask, and change its pixels."""

    def apply(folder: Path) -> None:
        geometry(("views.1.intensity", {"kind": "mask"}))(folder)
        picture(make)(folder)

    return apply


def raw(change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    """Change the bytes of view2.png."""

    def apply(folder: Path) -> None:
        file = folder / "view2.png"
        file.write_bytes(change(file.read_bytes()))

    return apply


def gone(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def same_picture(folder: Path) -> None:
    shutil.copy(folder / "view1.png", folder / "view2.png")


def both_blank(folder: Path) -> None:
    picture(np.zeros_like)(folder)
    shutil.copy(folder / "view2.png", folder / "view1.png")


def a_folder(folder: Path) -> None:
    (folder / "view2.png").unlink()
    (folder / "view2.png").mkdir()


def other_tree(pixels: np.ndarray) -> np.ndarray:
    """Turn the picture a quarter: vessels of the same kind in places that do not fit."""
    return np.ascontiguousarray(np.rot90(pixels))


def colour(pixels: np.ndarray) -> np.ndarray:
    grey = (pixels >> 8).astype(np.uint8)
    return np.stack([grey, grey, 255 - grey], axis=-1)


def speckle(pixels: np.ndarray) -> np.ndarray:
    out = np.zeros_like(pixels)
    out[10, 10] = 3000
    return out


def nearly_full(pixels: np.ndarray) -> np.ndarray:
    out = np.full_like(pixels, 60000)
    out[10, 10] = 0
    return out


NAN = "NaN is not a number"
#: name -> (what is done to a good case, exit code, what the line must say)
CASES: dict[str, tuple[Callable[[Path], None], int, str]] = {
    # 3: pictures
    "missing picture": (gone("view2.png"), 3, "view2.png"),
    "folder for a picture": (a_folder, 3, "view2.png"),
    "empty picture": (raw(lambda data: b""), 3, "empty"),
    "truncated picture": (raw(lambda data: data[: len(data) // 2]), 3, "view2.png"),
    "text named png": (raw(lambda data: b"hello world\n" * 40), 3, "not a PNG"),
    "jpeg named png": (raw(lambda data: b"\xff\xd8\xff\xe0" + data), 3, "view2.png"),
    "flipped bits": (raw(lambda data: data[:60] + b"\x00\xff" * 20 + data[100:]), 3, "view2.png"),
    "1x1 picture": (picture(lambda p: p[:1, :1]), 3, "view2.png"),
    "colour picture": (picture(colour), 3, "colour"),
    # 4: geometry
    "missing geometry": (gone("geom.json"), 4, "geom.json"),
    "empty geometry": (text(""), 4, "geom.json"),
    "not JSON": (text("{views: 1}"), 4, "not JSON"),
    "binary geometry": (text(b"\x80\x00\x01"), 4, "UTF-8"),
    "half of UTF-16": (text(b"\xff\xfe{\x00}"), 4, "UTF-16"),
    "a list": (text("[]"), 4, "object"),
    "nested deeply": (text("[" * 20000), 4, "geom.json"),
    "huge geometry": (text(" " * 100_000), 4, "larger"),
    "NaN": (text('{"schema": NaN}'), 4, "schema: " + NAN),
    "NaN in a list": (text('{"views": [1, [[2], [NaN]]]}'), 4, "views: " + NAN),
    "NaN alone": (text("[NaN]"), 4, "json: " + NAN),
    "angle a little too large": (
        geometry(("views.0.primary_angle_deg", 180.0001)), 4, "= 180.0001 deg is outside",
    ),
    "no view for a picture": (
        lambda folder: geometry(
            ("views", [{**json.loads((folder / "geom.json").read_text())["views"][0], "id": str(k),
                        "primary_angle_deg": 30 * k} for k in range(3)])
        )(folder),
        4, "geom.json: 2 pictures are given, but the geometry has 3 views",
    ),
    "key twice": (text('{"schema": 1, "schema": 2}'), 4, "twice"),
    "wrong schema": (geometry(("schema", "gcar-geometry/2")), 4, "schema"),
    "RAS frame": (geometry(("frame", "RAS")), 4, "frame"),
    "unknown key": (geometry(("views.0.primary_angle", 1)), 4, "primary_angle_deg"),
    "missing angle": (geometry(("views.0.primary_angle_deg", ...)), 4, "primary_angle_deg"),
    "missing rows": (geometry(("views.1.rows", ...)), 4, "rows"),
    "text for a number": (geometry(("views.0.sod_mm", "765")), 4, "sod_mm"),
    "truth for a number": (geometry(("views.0.sod_mm", True)), 4, "sod_mm"),
    "null for a number": (geometry(("views.0.sdd_mm", None)), 4, "sdd_mm"),
    "infinite number": (text('{"schema": 1e999}'), 4, "geom.json"),
    "SOD in cm": (geometry(("views.0.sod_mm", 76.5)), 4, "sod_mm"),
    "SOD in m": (geometry(("views.0.sod_mm", 0.765)), 4, "sod_mm"),
    "SOD and SDD swapped": (
        geometry(("views.0.sod_mm", 1100), ("views.0.sdd_mm", 765)), 4, "swapped",
    ),
    "SDD equals SOD": (geometry(("views.0.sdd_mm", 765)), 4, "sdd_mm"),
    "angle in a circle": (geometry(("views.0.primary_angle_deg", 330)), 4, "primary_angle_deg"),
    "cranial beyond the pole": (
        geometry(("views.0.secondary_angle_deg", 91)), 4, "secondary_angle_deg",
    ),
    "spacing zero": (geometry(("views.0.pixel_spacing_mm", [0, 0])), 4, "pixel_spacing_mm"),
    "spacing negative": (geometry(("views.0.pixel_spacing_mm", [-1, 1])), 4, "pixel_spacing_mm"),
    "spacing in um": (geometry(("views.0.pixel_spacing_mm", [1600, 1600])), 4, "pixel_spacing_mm"),
    "one spacing": (geometry(("views.0.pixel_spacing_mm", [1.6])), 4, "pixel_spacing_mm"),
    "rows with a fraction": (geometry(("views.0.rows", 96.5)), 4, "rows"),
    "rows at odds": (geometry(("views.1.rows", 97)), 4, "rescaling"),
    "columns at odds": (geometry(("views.1.columns", 48)), 4, "rescaling"),
    "cropped picture": (picture(lambda p: p[:90]), 4, "rescaling"),
    "three views, two pictures": (
        lambda folder: geometry(
            ("views", [*json.loads((folder / "geom.json").read_text())["views"]] * 2)
        )(folder),
        4, "twice",
    ),
    "one view": (geometry(("views.1", ...)), 4, "views"),
    "no views": (geometry(("views", [])), 4, "views"),
    "id twice": (geometry(("views.1.id", "1")), 4, "twice"),
    "unknown kind": (geometry(("views.0.intensity.kind", "xray")), 4, "kind"),
    "unknown polarity": (geometry(("views.0.intensity.polarity", "inverse")), 4, "polarity"),
    "no scale": (geometry(("views.0.intensity.mm_per_count", ...)), 4, "mm_per_count"),
    "scale zero": (geometry(("views.0.intensity.mm_per_count", 0)), 4, "mm_per_count"),
    "dark path lengths": (geometry(("views.0.intensity.polarity", "dark")), 4, "(view1.png): "),
    "dark mask": (
        geometry(("views.0.intensity", {"kind": "mask", "polarity": "dark"})), 4, "polarity",
    ),
    "volume without shape": (geometry(("volume.shape", ...)), 4, "shape"),
    "volume of a fraction": (geometry(("volume.shape", [96, 96, 9.5])), 4, "shape"),
    "volume too fine": (geometry(("volume.shape", [1024, 1024, 1024])), 4, "2^28"),
    "volume reaching the source": (geometry(("volume.size_mm", [1600] * 3)), 4, "volume"),
    "matrix at odds": (
        geometry(("views.0.projection_matrix", [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 765]])),
        4, "projection_matrix",
    ),
    "matrix of three columns": (
        geometry(("views.0.projection_matrix", [[1, 0, 0]] * 3)), 4, "projection_matrix",
    ),
    # 6: no tree can honestly be made
    "blank view": (picture(np.zeros_like), 6, "no vessel"),
    "constant view": (picture(lambda p: np.full_like(p, 500)), 6, "view 2 (view2.png)"),
    "saturated view": (picture(lambda p: np.maximum(p, 60000)), 6, "no vessel"),
    "empty mask": (mask(np.zeros_like), 6, "no vessel"),
    "full mask": (mask(nearly_full), 6, "(view2.png): intensity.kind is mask, but "),
    "mask of one pixel": (mask(speckle), 6, "mm of line"),
    "both views blank": (both_blank, 6, "no vessel found in view 1 (view1.png)"),
    "both views the same picture": (same_picture, 6, "same picture"),
    "3 degrees apart": (
        geometry(("views.1.primary_angle_deg", -27), ("views.1.secondary_angle_deg", -20)),
        6, "deg apart",
    ),
    "opposite views": (
        geometry(("views.1.primary_angle_deg", 150), ("views.1.secondary_angle_deg", 20)),
        6, "deg apart",
    ),
    "another tree": (picture(other_tree), 6, ""),
    "one bright pixel": (picture(speckle), 6, ""),
    "volume beside the tree": (geometry(("volume.center_mm", [0, 0, 150])), 6, "volume"),
}  # fmt: skip


def test_the_table_is_long_enough():
    assert len(CASES) >= 40


@pytest.mark.parametrize("name", CASES)
@pytest.mark.req("REQ-02", "REQ-09", "REQ-13", "REQ-31")
def test_run_refuses(name, good_case, tmp_path):
    spoil, code, words = CASES[name]
    case = tmp_path / "case"
    shutil.copytree(good_case, case)
    spoil(case)
    done = gcar(
        "run", case / "view1.png", case / "view2.png", "--geom", case / "geom.json",
        "--out", tmp_path / "out", "--predictor", "none",
    )  # fmt: skip
    assert done.code == code, done.err
    lines = done.err.splitlines()
    assert lines[-1].startswith("gcar: error: ") and words in lines[-1]
    assert len([line for line in lines if "error" in line]) == 1
    assert "Traceback" not in done.err and done.out == ""
    assert sorted(p.name for p in tmp_path.iterdir()) == ["case"]


USAGE = {
    "no verb": ([], 2),
    "unknown verb": (["rum"], 2),
    "no picture": (["run", "--geom", "G", "--out", "O"], 2),
    "one picture": (["run", "V", "--geom", "G", "--out", "O"], 2),
    "no geometry": (["run", "V", "W", "--out", "O"], 2),
    "no folder": (["run", "V", "W", "--geom", "G"], 2),
    "unknown option": (["run", "V", "W", "--geom", "G", "--out", "O", "--fast"], 2),
    "unknown predictor": (["run", "V", "W", "--geom", "G", "--out", "O", "--predictor", "x"], 2),
    "unknown refiner": (["run", "V", "W", "--geom", "G", "--out", "O", "--refiner", "x"], 2),
    "deadline zero": (["run", "V", "W", "--geom", "G", "--out", "O", "--deadline", "0"], 2),
    "no threads": (["run", "V", "W", "--geom", "G", "--out", "O", "--threads", "0"], 2),
    "model with none": (
        ["run", "V", "W", "--geom", "G", "--out", "O", "--predictor", "none", "--model", "m.onnx"],
        2,
    ),
    "three pictures for two views": (["run", "V", "W", "V", "--geom", "G", "--out", "O"], 4),
    "missing model": (["run", "V", "W", "--geom", "G", "--out", "O", "--model", "m.onnx"], 5),
    "a picture for a model": (["run", "V", "W", "--geom", "G", "--out", "O", "--model", "V"], 5),
    "no such paper model": (
        [
            "run",
            "V",
            "W",
            "--geom",
            "G",
            "--out",
            "O",
            "--predictor",
            "paper",
            "--model",
            "m.onnx",
        ],
        5,
    ),
    "deadline too short": (["run", "V", "W", "--geom", "G", "--out", "O", "--deadline", "1e-6"], 7),
    "strict": (
        ["run", "V", "W", "--geom", "G", "--out", "O", "--strict", "--predictor", "none"],
        6,
    ),
}


@pytest.mark.parametrize("name", USAGE)
@pytest.mark.req("REQ-14", "REQ-15", "REQ-31")
def test_calls_that_end_early(name, good_case, tmp_path):
    arguments, code = USAGE[name]
    names = {
        "V": good_case / "view1.png",
        "W": good_case / "view2.png",
        "G": good_case / "geom.json",
        "O": tmp_path / "out",
    }
    done = gcar(*(names.get(a, a) for a in arguments))
    assert done.code == code, done.err
    assert "Traceback" not in done.err and done.out == ""
    assert list(tmp_path.iterdir()) == []


#: call with an empty path -> exit code, what the line must name
EMPTY: dict[str, tuple[list[str], int, str]] = {
    "first view": (["run", "", "W", "--geom", "G", "--out", "O"], 3, "view 1 "),
    "second view": (["run", "V", "", "--geom", "G", "--out", "O"], 3, "view 2 "),
    "geometry": (["run", "V", "W", "--geom", "", "--out", "O"], 4, "--geom"),
    "folder": (["run", "V", "W", "--geom", "G", "--out", ""], 2, "--out"),
    "model": (["run", "V", "W", "--geom", "G", "--out", "O", "--model", ""], 5, "--model"),
    "order": (["run", "--order", "", "--out", "O"], 2, "--order"),
    "validate": (["validate", "V", "", "--geom", "G"], 3, "view 2 "),
    "frames": (["frames", "", "W"], 3, "view 1 "),
    "enhance": (["enhance", "", "--out", "O"], 3, "view 1 "),
    "open": (["open", "V", "", "--geom", "G"], 3, "view 2 "),
    "open alone": (["open", ""], 3, "view 1 "),
    "from-dicom": (["geometry", "from-dicom", "V", ""], 3, "view 2 "),
    "show": (["geometry", "show", ""], 4, "path"),
    "dicom": (["dicom", "O", "", "--out", "O"], 3, "view 1 "),
    "batch": (["batch", "", "--out", "O"], 2, "path"),
    "info": (["info", ""], 2, "path"),
}


@pytest.mark.parametrize("name", EMPTY)
def test_an_empty_path_is_not_the_working_folder(name, good_case, tmp_path, monkeypatch):
    arguments, code, words = EMPTY[name]
    monkeypatch.chdir(good_case)  # which holds pictures
    names = {"V": "view1.png", "W": "view2.png", "G": "geom.json", "O": tmp_path / "out"}
    done = gcar(*(names.get(a, a) for a in arguments))
    assert (done.code, done.out) == (code, ""), done.err
    assert done.err.startswith(f"gcar: error: {words}") or words == "path"
    assert "empty text; name a file or folder" in done.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root reads all")
@pytest.mark.parametrize(("name", "code"), [("view2.png", 3), ("geom.json", 4)])
def test_a_file_that_may_not_be_read_has_the_exit_code_of_its_kind(name, code, good_case, tmp_path):
    case = tmp_path / "case"
    shutil.copytree(good_case, case)
    (case / name).chmod(0)
    done = gcar(
        "run", case / "view1.png", case / "view2.png", "--geom", case / "geom.json",
        "--out", tmp_path / "out",
    )  # fmt: skip
    assert (done.code, done.out) == (code, "") and name in done.err


def test_no_path_asks_the_system_whether_it_may_be_read():
    """As root, whom nothing is forbidden, the test above says nothing."""
    from gcar_deploy.cli.main import VERBS
    from gcar_deploy.cli.main import gcar as group

    context = click.Context(group)
    commands = [group.get_command(context, verb) for verb in VERBS]
    commands += list(group.get_command(context, "geometry").commands.values())
    kinds = [p.type for c in commands for p in c.params if isinstance(p.type, click.Path)]
    assert len(kinds) > 20 and not any(k.readable and not k.exists for k in kinds)


def test_open_says_at_once_that_a_picture_is_missing(good_case):
    wrong = good_case / "no.png"
    done = gcar("open", good_case / "view1.png", wrong, "--geom", good_case / "geom.json")
    assert (done.code, done.out) == (3, "")
    assert done.err == f"gcar: error: {wrong}: no such file; check the path\n"


@pytest.mark.parametrize("kind", ["folder", "file", "link"])
@pytest.mark.req("REQ-29")
def test_an_existing_target_is_refused_before_any_work(kind, good_case, tmp_path):
    out = tmp_path / "out"
    if kind == "folder":
        out.mkdir()
        (out / "mine").write_text("1")
    elif kind == "file":
        out.write_text("1")
    else:
        out.symlink_to(tmp_path / "elsewhere")
    done = gcar(
        "run", good_case / "view1.png", good_case / "view2.png",
        "--geom", good_case / "geom.json", "--out", out,
    )  # fmt: skip
    assert done.code == 2 and str(out) in done.err
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
    assert kind != "folder" or [p.name for p in out.iterdir()] == ["mine"]

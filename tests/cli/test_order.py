"""An order made on the command line, printed, done again, and done by a table."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from gcar_deploy.batch.work import run_case
from gcar_deploy.cli.request import made_order
from gcar_deploy.config import LesionBorders
from gcar_deploy.inputs.order import Order, load_order
from tests.cli.conftest import gcar


def arguments(case, out, *more):
    return (
        "run", case / "view1.png", case / "view2.png", "--geom", case / "geom.json",
        "--out", out, "--predictor", "none", *more,
    )  # fmt: skip


def result_of(folder):
    found = json.loads((folder / "result.json").read_text())
    for key in ("seconds", "files"):
        found.pop(key)
    return found


@pytest.mark.slow
def test_edits_of_a_view_that_is_not_there_are_told(good_case, tmp_path):
    order = {
        "views": [str(good_case / f"view{k}.png") for k in (1, 2)],
        "geometry": str(good_case / "geom.json"),
        "edits": {"3": [{"do": "erase", "width_px": 9, "points": [[1, 2], [3, 4]]}]},
    }
    file = tmp_path / "o.json"
    file.write_text(json.dumps(order))
    for verb in (("validate",), ("run", "--out", tmp_path / "out")):
        done = gcar(*verb, "--order", file)
        assert done.code == 2 and "edits 3: there are views 1 .. 2" in done.err
    pictures = [good_case / "view1.png", good_case / "view2.png"]
    done = gcar("validate", *pictures, "--order", file)
    assert done.code == 2 and "edits 3" in done.err


def test_a_printed_order_repeats_the_run(good_case, tmp_path):
    told = ("--landmark", "48,48:48,48", "--refiner", "none", "--pose", "auto", "--glb")
    asked = gcar(*arguments(good_case, tmp_path / "a", *told, "--print-order"))
    assert asked.code == 0 and asked.err == "" and not (tmp_path / "a").exists()
    file = tmp_path / "order.json"
    file.write_text(asked.out)
    assert gcar(*arguments(good_case, tmp_path / "a", *told)).code == 0
    again = gcar("run", "--order", file, "--out", tmp_path / "b")
    assert again.code == 0, again.err
    assert result_of(tmp_path / "a") == result_of(tmp_path / "b")
    assert (tmp_path / "b" / "surface.glb").is_file()
    checked = gcar("validate", "--order", file, "--json")
    assert checked.code == 0 and json.loads(checked.out)["would"] == "reconstruct"


def test_the_command_line_goes_before_the_file(tmp_path):
    (tmp_path / "o.json").write_text(
        '{"views": ["a", "b"], "sod_mm": 700, "refiner": "paper", "masks": {"1": "m"}}'
    )
    order = made_order({"file": tmp_path / "o.json", "sod_mm": 800.0, "force": False})
    assert (order.sod_mm, order.refiner, order.force) == (800.0, "paper", False)
    assert order.masks == {1: tmp_path / "m"}
    assert made_order({"masks": ("2:x.png",), "glb": True, "frames": "3,auto"}) == Order(
        masks={2: Path("x.png")}, extras=("glb",), frames=(3, None)
    )


def test_a_printed_order_names_its_files_from_anywhere(good_case, tmp_path, monkeypatch):
    monkeypatch.chdir(good_case)
    done = gcar("run", "view1.png", "view2.png", "--geom", "geom.json", "--mask", "2:view2.png",
                "--frame", "7,auto", "--print-order")  # fmt: skip
    (tmp_path / "o.json").write_text(done.out)
    monkeypatch.chdir(tmp_path)
    order = load_order(tmp_path / "o.json")
    assert all(path.is_file() and path.is_absolute() for path in order.files.values())
    assert sorted(order.files) == ["geometry", "mask2", "view1", "view2"]
    assert order.frames == (7, None) and order.out is None


def test_lesions_of_the_command_line_are_those_of_an_order(good_case, tmp_path):
    told = ("--lesion", "1:10,20.5:30,40", "--lesion", "2:1,2:3,4")
    (tmp_path / "o.json").write_text(
        gcar(*arguments(good_case, tmp_path / "a", *told, "--print-order")).out
    )
    assert sorted(load_order(tmp_path / "o.json").drawn_on) == [1, 2]
    assert load_order(tmp_path / "o.json").lesions == (
        LesionBorders(view=1, proximal=(10.0, 20.5), distal=(30.0, 40.0)),
        LesionBorders(view=2, proximal=(1.0, 2.0), distal=(3.0, 4.0)),
    )
    for text, words in (
        ("3:1,2:3,4", "lesions.view = 3: there are views 1 .. 2"), ("1:1,2", "'1:1,2' must be N:"),
        ("0:1,2:3,4", "must be N:"), ("1:1,nan:3,4", "must be N:"), ("1:1,2:3,4:5,6", "must be"),
    ):  # fmt: skip
        done = gcar(*arguments(good_case, tmp_path / "a", "--lesion", text))
        assert done.code == 2 and words in done.err and not (tmp_path / "a").exists()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "o.json: not JSON"),
        ('{"views": ["a"]}', "o.json: views has 1 entries"),
        ('{"views": ["a", "b"], "vews": []}', "did you mean 'views'"),
    ],
)
def test_a_wrong_order_file_is_2(content, words, tmp_path):
    (tmp_path / "o.json").write_text(content)
    done = gcar("run", "--order", tmp_path / "o.json", "--out", tmp_path / "r")
    assert done.code == 2 and words in done.err and not (tmp_path / "r").exists()


def test_a_mask_of_the_fifth_view_is_read(good_case, tmp_path):
    """Five views: a mask of the last is read, and refused for its size."""
    geometry = json.loads((good_case / "geom.json").read_text())
    first = geometry["views"][0]
    geometry["views"] = [
        {**first, "id": str(k), "primary_angle_deg": 20.0 * k - 50} for k in range(5)
    ]
    (tmp_path / "g.json").write_text(json.dumps(geometry))
    cv2.imwrite(str(tmp_path / "m.png"), np.eye(20, dtype=np.uint8))
    option = ("--mask", f"5:{tmp_path / 'm.png'}")
    done = gcar("run", *[good_case / "view1.png"] * 5, "--geom", tmp_path / "g.json",
                "--out", tmp_path / "r", *option)  # fmt: skip
    assert done.code == 3 and "mask 5 has (20, 20)" in done.err
    checked = gcar("validate", *[good_case / "view1.png"] * 5, "--geom", tmp_path / "g.json",
                   *option)  # fmt: skip
    assert checked.code == 3 and "mask 5" in checked.err


@pytest.mark.slow
def test_a_table_does_what_its_columns_say(good_case, tmp_path, monkeypatch):
    """Runs that want their pixel spacing, a mask for one case, another refiner for the next."""
    pytest.importorskip("pydicom")
    from tests.dicom.files import tiny_runs

    monkeypatch.setattr(
        "gcar_deploy.batch.batch.in_processes", lambda jobs, _: (run_case(job) for job in jobs)
    )
    tiny_runs(tmp_path, ImagerPixelSpacing=None)
    a, b, g = (os.path.relpath(good_case / n, tmp_path)
               for n in ("view1.png", "view2.png", "geom.json"))  # fmt: skip
    cv2.imwrite(str(tmp_path / "small.png"), np.eye(20, dtype=np.uint8))
    (tmp_path / "cases.csv").write_text(
        "case,geom,view1,view2,mask1,pixel_spacing_mm,refiner,landmarks\n"
        "runs,,run1.dcm,run2.dcm,,1.6,none,\n"
        "without,,run1.dcm,run2.dcm,,,,\n"
        f"masked,{g},{a},{b},small.png,,,\n"
        f'marked,{g},{a},{b},,,none,"48,48:48,48 40,40:40,40"\n'
    )
    done = gcar("batch", tmp_path / "cases.csv", "--out", tmp_path / "out", "--predictor", "none",
                "--jobs", "1", "--json")  # fmt: skip
    assert done.code == 0, done.err
    rows = {row["case"]: row for row in json.loads(done.out)["cases"]}
    assert [row["exit_code"] for row in rows.values()] == [0, 4, 3, 0], rows
    assert "pixel_spacing_mm" in rows["without"]["sentence"]
    assert "mask 1 has (20, 20)" in rows["masked"]["sentence"]
    made = result_of(tmp_path / "out" / "runs")
    assert made["options"]["dicom"]["pixel_spacing_mm"] == 1.6 and made["refiner"] == "none"
    assert len(result_of(tmp_path / "out" / "marked")["options"]["landmarks"]) == 2


def test_a_table_takes_order_files(tmp_path):
    """Pictures and corrections of the file; what the line and the command say goes before it."""
    from gcar_deploy.batch.cases import read_cases

    (tmp_path / "case").mkdir()
    (tmp_path / "case" / "order.json").write_text(
        json.dumps(
            {
                "views": ["a.png", "b.png"],
                "geometry": "g.json",
                "out": "result",
                "force": True,
                "edits": {"1": [{"do": "erase", "width_px": 9, "points": [[1, 2], [3, 4]]}]},
                "deleted_mm": [[1, 2, 3]],
                "refiner": "paper",
                "masks": {"1": "m.png"},
            }
        )
    )
    (tmp_path / "c.csv").write_text(
        "case,geom,view1,view2,order,mask2,refiner\n"
        "whole,,,,case/order.json,,\n"
        "other,h.json,c.png,d.png,case/order.json,n.png,none\n"
    )
    whole, other = (c.order for c in read_cases(tmp_path / "c.csv", Order(predictor="none")))
    folder = tmp_path / "case"
    assert whole.views == (folder / "a.png", folder / "b.png")
    assert whole.geometry == folder / "g.json" and whole.masks == {1: folder / "m.png"}
    assert (whole.refiner, whole.predictor, whole.out, whole.force) == (
        "paper",
        "none",
        None,
        False,
    )
    assert whole.deleted_mm == other.deleted_mm == ((1.0, 2.0, 3.0),) and 1 in other.edits
    assert other.views == (tmp_path / "c.png", tmp_path / "d.png") and other.refiner == "none"
    assert other.geometry == tmp_path / "h.json"
    assert other.masks == {1: folder / "m.png", 2: tmp_path / "n.png"}
    (tmp_path / "c.csv").write_text("case,geom,view1,view2,order\nx,,,,none.json\n")
    done = gcar("batch", tmp_path / "c.csv", "--out", tmp_path / "o")
    assert done.code == 2 and "c.csv: line 2: none.json" in done.err


@pytest.mark.parametrize(
    ("column", "text", "words"),
    [
        ("sod_mm", "76", "sod_mm = 76.0"),
        ("sod_mm", "far", "'far' must be a number"),
        ("mask3", "m.png", "mask 3: there are views 1 .. 2"),
        ("refiner", "tubes", "refiner = 'tubes'"),
        ("landmarks", "1;2", "landmark '1;2'"),
        ("frame", "first", "frame 'first'"),
        ("mask17", "m.png", "unknown column 'mask17'"),
    ],
)
def test_columns_that_are_refused(tmp_path, column, text, words):
    (tmp_path / "c.csv").write_text(f"case,geom,view1,view2,{column}\na,g,1,2,{text}\n")
    done = gcar("batch", tmp_path / "c.csv", "--out", tmp_path / "o")
    assert done.code == 2 and words in done.err and not (tmp_path / "o").exists()

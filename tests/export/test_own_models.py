"""Rows made with a model of the user's own: asked, named, and made anew when it changes."""

import shutil
from pathlib import Path

import nibabel
import numpy as np
import pytest

from gcar_deploy.errors import ModelError, UsageError
from gcar_export.evaluate import evaluate, tables
from gcar_export.methods.own_models import OwnModels
from gcar_export.methods.settings import MethodSettings

TINY = Path(__file__).parents[1] / "data" / "tiny.onnx"
SHIPPED = Path(__file__).parents[2] / "models"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """One bent tube."""
    folder = tmp_path_factory.mktemp("data")
    volume = np.zeros((100, 100, 120), np.uint8)
    for z in range(10, 110):
        x, y = int(50 + 25 * np.sin(z / 30)), int(50 + 20 * np.cos(z / 20))
        volume[x - 2 : x + 3, y - 2 : y + 3, z] = 1
    nibabel.save(nibabel.Nifti1Image(volume, np.diag([-0.7, -0.7, 0.7, 1])), folder / "a.nii.gz")
    return folder


def own(folder, name, source=TINY):
    for suffix in (".onnx", ".json", ".golden.npz"):
        if source.with_suffix(suffix).is_file():
            shutil.copy(source.with_suffix(suffix), folder / f"{name}{suffix}")
    return MethodSettings(own=OwnModels(predictor=folder / f"{name}.onnx"))


def test_rows_ask_the_model_of_their_kind_and_the_digest_says_so(tmp_path):
    mine, plain = own(tmp_path, "mine"), MethodSettings()
    changed = {m for m in ("ours", "ours-classic", "multi", "multi+tube", "hull", "3dgr-gcp", "fdk")
               if mine.digest(m) != plain.digest(m)}  # fmt: skip
    assert changed == {"ours", "ours-classic", "multi", "multi+tube"}
    assert mine.own_models("3dgr-gcp") == OwnModels()
    paper = own(tmp_path, "paper", TINY.with_name("tiny-paper.onnx"))
    assert paper.own_models("3dgr-gcp").files == (tmp_path / "paper.onnx",)
    assert paper.own_models("multi").files == ()
    finder = MethodSettings(own=OwnModels(segmenter=SHIPPED / "segmenter.onnx"))
    assert finder.digest("ours") != plain.digest("ours")
    assert finder.digest("ours-classic") == plain.digest("ours-classic")


@pytest.mark.slow
def test_an_own_model_is_used_named_in_the_table_and_tied_to_its_rows(data, tmp_path, caplog):
    given = {"data": data, "protocol": "paper", "methods": ("multi", "visual_hull"),
             "out": tmp_path / "out"}  # fmt: skip
    shipped = evaluate.evaluate(evaluate.EvaluateOptions(**given))
    mine = own(tmp_path, "mine")
    options = evaluate.EvaluateOptions(**given, settings=mine)
    with pytest.raises(UsageError, match=r"1 rows of multi .* made with other settings"):
        evaluate.evaluate(evaluate.EvaluateOptions(**given, settings=mine, changed="refuse"))
    rows = evaluate.evaluate(options)
    # An untrained predictor finds nothing of what the trained one finds.
    assert rows[0]["measures"]["dsc"] != shipped[0]["measures"]["dsc"]
    assert rows[0]["models"].startswith("mine.onnx (") and not rows[1]["models"]
    again = tables.read_case_rows(tmp_path / "out" / "cases.csv")
    assert [row["models"] for row in again] == [row["models"] for row in rows]
    text = (tmp_path / "out" / "tables.md").read_text()
    assert f"multi: with {rows[0]['models']}, not with what comes along" in text
    assert "comes along" not in tables.markdown(shipped)


def test_a_model_that_no_row_asks_is_refused(data, tmp_path):
    given = {"data": data, "protocol": "paper", "out": tmp_path / "out"}
    mine = own(tmp_path, "mine")
    with pytest.raises(UsageError, match="asked by none of the methods hull, fdk"):
        evaluate.evaluate(evaluate.EvaluateOptions(**given, methods=("hull", "fdk"), settings=mine))
    finder = MethodSettings(own=OwnModels(segmenter=SHIPPED / "segmenter.onnx"))
    with pytest.raises(UsageError, match=r"has nothing to do: protocol paper with ours"):
        evaluate.evaluate(evaluate.EvaluateOptions(**given, methods=("ours",), settings=finder))
    gone = MethodSettings(own=OwnModels(predictor=tmp_path / "gone.onnx"))
    with pytest.raises(ModelError, match=r"gone\.onnx"):
        evaluate.evaluate(evaluate.EvaluateOptions(**given, methods=("ours",), settings=gone))
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_command_takes_the_model(data, tmp_path):
    from click.testing import CliRunner

    from gcar_export.cli.main import main

    own(tmp_path, "mine")
    done = CliRunner().invoke(
        main, ["evaluate", "--data", str(data), "--methods", "multi", "--quiet",
               "--model", str(tmp_path / "mine.onnx"), "--out", str(tmp_path / "out")],
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert "multi: with mine.onnx (" in done.output

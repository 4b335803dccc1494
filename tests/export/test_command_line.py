"""What the workshop's commands refuse before they work: numbers, places to write to."""

import re
import subprocess
import sys

import pytest
from click.testing import CliRunner

from gcar_deploy.imaging.net import KIND
from gcar_export.cli.main import main
from gcar_export.training.scene_stream import Terminated


def said(*words):
    done = CliRunner().invoke(main, [str(word) for word in words])
    return done.exit_code, done.output


@pytest.mark.parametrize(
    "words",
    ["train --minutes 0", "train --minutes nan", "train --minutes inf", "train --learning-rate nan",
     "train-segmenter --steps 0", "train-segmenter --minutes -3", "train-segmenter --batch 0",
     "train-segmenter --pictures 0", "train-segmenter --learning-rate 0",
     "train-segmenter --real-share 2", "train-devices --minutes 0", "train-devices --seed -1",
     "verify M --scenes 0", "verify M --scenes -1", "gate-table --trees 0", "sigma-table --trees 0",
     "pair-time M --repeats 0", "score D --limit nan", "simulate M OUT --views 17",
     "evaluate --jobs 0", "flow-table --count 0", "pose-table --trees 0", "tree-table --count 0",
     "lumen-table --vessels -1", "wrong-scenes --trees 0", "frame-pairs --patients 0"],
)  # fmt: skip
def test_numbers_out_of_range_are_refused(tmp_path, words):
    (tmp_path / "M").touch()
    places = {"M": tmp_path / "M", "D": tmp_path, "OUT": tmp_path / "out"}
    *rest, option, value = (places.get(word, word) for word in words.split())
    code, output = said(*rest, option, value)
    assert code == 2
    assert re.search(rf"Invalid value for '{option}': {value}(\.0)? is not", output), output


@pytest.mark.parametrize(
    "words", ["train --out", "train-segmenter --out", "evaluate --out", "simulate MODEL"]
)
def test_a_folder_to_write_that_is_a_file_or_below_one_is_one_line(tmp_path, words):
    file = tmp_path / "file"
    file.write_text("x")
    given = [file if word == "MODEL" else word for word in words.split()]
    for path in (file, file / "below" / "it"):
        code, output = said(*given, path)
        name = "OUT" if given[0] == "simulate" else "--out"
        assert (code, output) == (
            2, f"gcar-export: error: {name} {path}: {file} is a file, not a folder\n"
        )  # fmt: skip
    assert file.read_text() == "x"


def test_a_model_to_write_that_is_a_folder_is_one_line(tmp_path):
    (tmp_path / "c.safetensors").touch()
    code, output = said("export", tmp_path / "c.safetensors", "--out", tmp_path)
    assert (code, output) == (
        2, f"gcar-export: error: --out {tmp_path} is a folder: name a file\n"
    )  # fmt: skip


@pytest.mark.parametrize("verb", ["export", "export-segmenter"])
@pytest.mark.parametrize("name", ["m.onnx", "m.json", "m.golden.npz"])
def test_no_file_of_a_model_is_replaced_unasked(tmp_path, verb, name):
    (tmp_path / "c.safetensors").touch()
    (tmp_path / name).write_text("mine")
    given = [verb, tmp_path / "c.safetensors", "--out", tmp_path / "m.onnx"]
    line = f"gcar-export: error: {tmp_path / name} exists; add --force to replace it\n"
    assert said(*given) == (2, line)
    if verb == "export":
        (tmp_path / name).rename(tmp_path / name.replace("m.", "m-int8."))
        line = line.replace("/m.", "/m-int8.")
        assert said(*given, "--int8") == (2, line)
    code, output = said(*given[:-1], tmp_path / "m.json")
    assert code == 2 and output.endswith("m.json: the file to write must end in .onnx\n")


def test_a_preset_for_a_device_that_is_not_there_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    for verb in ("train", "train-segmenter"):
        code, output = said(verb, "--preset", "gpu", "--out", tmp_path / "run")
        assert code == 2 and output.startswith("gcar-export: error: preset gpu needs a CUDA device")
        assert not (tmp_path / "run").exists()


def test_methods_are_listed_without_anything_else():
    code, output = said("evaluate", "--methods", "help")
    assert code == 0 and "\nvisual_hull " in output
    assert said("evaluate", "--methods", "ours")[0] == 2


def test_what_the_system_refuses_is_one_line_with_its_file(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device", "runs/a/log.csv")

    monkeypatch.setattr("gcar_export.training.train.start", full)
    code, output = said("train", "--out", tmp_path / "a")
    assert (code, output) == (1, "gcar-export: error: runs/a/log.csv: No space left on device\n")


def test_a_segmenter_is_verified_like_a_predictor():
    code, output = said("verify", KIND.path, "--scenes", "2")
    assert code == 0 and "golden case: largest difference" in output
    dice = float(re.search(r"angiograms: Dice at 0\.5 (\S+) \(2 scenes\)", output)[1])
    assert dice > 0.5


@pytest.mark.parametrize(("error", "code", "line"), [
    (KeyboardInterrupt(), 130, "gcar-export: interrupted"),
    (Terminated(), 143, "gcar-export: terminated"),
    (OSError(28, "No space left on device", "/a/b"), 1,
     "gcar-export: error: /a/b: No space left on device"),
    (OSError(28, "No space left on device"), 1,
     "gcar-export: error: cannot write: No space left on device"),
    (BrokenPipeError(32, "Broken pipe"), 1, ""),
])  # fmt: skip
def test_what_ends_a_verb_is_one_line_and_its_exit_code(tmp_path, monkeypatch, error, code, line):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr("gcar_export.training.train.start", fail)
    ended, output = said("train", "--out", tmp_path / "run")
    assert (ended, output.strip()) == (code, line)


@pytest.mark.parametrize("library", ["torch", "nibabel"])
def test_a_missing_extra_is_one_line(library, tmp_path):
    (tmp_path / "label.nii.gz").touch()
    words = ["train", "--out", "run"] if library == "torch" else ["simulate", "label.nii.gz", "out"]
    code = (
        f"import sys; sys.modules[{library!r}] = None\n"
        f"from gcar_export.cli.main import main; main({words!r})"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 2, done.stderr
    assert done.stderr == (
        f"gcar-export: error: {library} is missing; pip install 'gcar[export]'\n"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["label.nii.gz"]

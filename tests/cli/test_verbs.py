"""What each verb prints and where; help, streams, exit codes of good calls."""

from __future__ import annotations

import inspect
import json
import os
import shutil
import subprocess
import sys
import time
from importlib import resources

import click
import cv2
import numpy as np
import pytest

from gcar_deploy.cli import doctor as doctor_verb
from gcar_deploy.cli import main as entry
from gcar_deploy.cli.main import VERBS
from gcar_deploy.cli.main import gcar as gcar_group
from gcar_deploy.config import ImagingOptions, RunOptions
from gcar_deploy.data.demo_case import demo_case
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.inputs.pictures import prepare
from gcar_deploy.predict.kinds import MULTI, PREDICTOR_KINDS
from tests.cli.conftest import gcar


def run_arguments(case, out, *extra):
    return (
        "run", case / "view1.png", case / "view2.png", "--geom", case / "geom.json",
        "--out", out, "--predictor", "none", *extra,
    )  # fmt: skip


@pytest.mark.parametrize("verb", VERBS)
def test_help_shows_an_example(verb):
    done = gcar(verb, "--help")
    assert done.code == 0 and done.err == ""
    assert "Example" in done.out and f"gcar {verb}" in done.out


def test_group_help_names_every_verb_and_version_prints():
    done = gcar("--help")
    assert done.code == 0
    for verb in VERBS:
        assert f"  {verb} " in done.out
    assert "gcar run view1.png view2.png --geom geom.json --out result" in done.out
    assert gcar("--version").out.startswith("gcar")


def leaves(group=gcar_group, *path):
    """Yield every command with its name's words."""
    for name in group.list_commands(click.Context(group)):
        command = group.get_command(click.Context(group), name)
        if isinstance(command, click.Group):
            yield from leaves(command, *path, name)
        yield (*path, name), command


def test_no_help_shows_clicks_marks():
    for words, command in leaves():
        shown = gcar(*words, "--help").out
        assert "\\b" not in shown and "\b" not in shown, words
        lines = shown.split("Example:\n")[1].splitlines() if "Example:" in shown else ["  gcar"]
        assert lines[0].strip().startswith(("gcar ", "storescu ")), words
        assert len(inspect.signature(inspect.unwrap(command.callback)).parameters) <= 6, words


@pytest.mark.parametrize(
    ("wrong", "meant"),
    [("rnu", "run"), ("valdiate", "validate"), ("docter", "doctor"), ("xyzzy", None)],
)
def test_a_misspelt_verb_is_told_which_it_may_be(wrong, meant):
    done = gcar(wrong, "view1.png")
    assert done.code == 2 and done.out == "" and len(done.err.splitlines()) == 1
    said = f"no verb {wrong!r}; did you mean {meant!r}?" if meant else "; known: run, "
    assert said in done.err


@pytest.mark.skipif(os.name != "posix", reason="shells")
def test_the_shell_completes_verbs_and_options():
    """What the tour tells to put into the shell's start-up file asks the command like this."""
    for words, wanted in (("gcar va", "validate"), ("gcar run --pixel", "--pixel-spacing")):
        done = subprocess.run(
            [sys.executable, "-m", "gcar_deploy.cli.main"], capture_output=True, text=True,
            env={**os.environ, "_GCAR_COMPLETE": "bash_complete", "COMP_WORDS": words,
                 "COMP_CWORD": str(words.count(" "))},
        )  # fmt: skip
        assert f"plain,{wanted}" in done.stdout.splitlines(), done.stderr


@pytest.mark.parametrize(("set_before", "then"), [(None, "1"), ("3", "3")])
def test_products_are_not_shared_out_unless_that_was_asked(set_before, then, monkeypatch):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", set_before or "")
    if set_before is None:
        monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    assert gcar("--version").code == 0
    assert os.environ["OPENBLAS_NUM_THREADS"] == then


@pytest.mark.benchmark
def test_help_is_quick():
    times = []
    for _ in range(5):
        start = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "gcar_deploy.cli.main", "--help"],
            check=True,
            capture_output=True,
        )
        times.append(time.perf_counter() - start)
    assert min(times) < 0.15


@pytest.mark.req("REQ-35")
def test_run_prints_the_folder_first_and_nothing_on_stderr(good_case, tmp_path):
    done = gcar(*run_arguments(good_case, tmp_path / "out", "--quiet"))
    assert done.code == 0, done.err
    lines = done.out.splitlines()
    assert lines[0] == str(tmp_path / "out") and lines[1].startswith(("ok:", "degraded:"))
    views = json.loads((tmp_path / "out" / "result.json").read_text())["views"]
    assert lines[-1].endswith(
        f"{views[-1]['coverage_even']:.0%} of the length of the vessels seen is explained "
        f"({views[-1]['coverage']:.0%} weighed by thickness)"
    )
    assert done.err == ""
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.req("REQ-35")
def test_json_is_one_object_that_is_the_result(good_case, tmp_path):
    done = gcar(*run_arguments(good_case, tmp_path / "out", "--json"))
    assert done.code == 0, done.err
    printed = json.loads(done.out)
    jsonschema = pytest.importorskip("jsonschema")
    schema = resources.files("gcar_deploy.output").joinpath("result.schema.json").read_text()
    jsonschema.validate(printed, json.loads(schema))
    stored = json.loads((tmp_path / "out" / "result.json").read_text())
    assert printed.pop("out") == str(tmp_path / "out")
    stored.pop("files")
    assert printed == stored


@pytest.mark.slow
def test_json_of_a_refusal_is_one_object_too(good_case, tmp_path):
    jsonschema = pytest.importorskip("jsonschema")
    case = tmp_path / "case"
    shutil.copytree(good_case, case)
    shutil.copy(case / "view1.png", case / "view2.png")
    done = gcar(*run_arguments(case, tmp_path / "out", "--json"))
    assert done.code == 6
    found = json.loads(done.out)
    assert found["status"] == "refused" and found["sentence"] in done.err
    schema = resources.files("gcar_deploy.output").joinpath("result.schema.json").read_text()
    jsonschema.validate(found, json.loads(schema))


@pytest.mark.slow
@pytest.mark.req("REQ-27")
def test_force_replaces_and_info_reads(good_case, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.txt").write_text("1")
    done = gcar(*run_arguments(good_case, out, "--force"))
    assert done.code == 2 and "thesis.txt" in done.err and (out / "thesis.txt").exists()
    (out / "thesis.txt").unlink()
    assert gcar(*run_arguments(good_case, out, "--force")).code == 0
    assert gcar(*run_arguments(good_case, out)).code == 2
    assert gcar(*run_arguments(good_case, out, "--force")).code == 0
    done = gcar("info", out)
    assert done.code == 0 and "branches" in done.out and "Research use only" in done.out
    assert json.loads(gcar("info", out, "--json").out)["altered"] == []
    with open(out / "centerline.csv", "a") as stream:
        stream.write("x")
    done = gcar("info", out)
    assert done.code == 2 and "centerline.csv" in done.err


@pytest.mark.slow
def test_a_second_demo_takes_the_place_of_the_first_and_of_nothing_else(good_case, tmp_path):
    out = tmp_path / "gcar-demo"
    demo = ("demo", "--out", out, "--predictor", "none", "--refiner", "none", "--quiet")
    for _ in range(2):
        done = gcar(*demo)
        assert done.code == 0, done.err
    shutil.rmtree(out)
    assert gcar(*run_arguments(good_case, out)).code == 0
    done = gcar(*demo)
    assert done.code == 2 and "add --force" in done.err


@pytest.mark.parametrize("content", [None, "{", "[]", '{"schema": "other"}'])
def test_info_of_something_else(content, tmp_path):
    if content is not None:
        (tmp_path / "result.json").write_text(content)
    done = gcar("info", tmp_path)
    assert done.code == 2 and done.out == "" and len(done.err.splitlines()) == 1


@pytest.mark.req("REQ-05")
def test_rescaled_pictures_are_taken_where_that_is_allowed_and_said(good_case, tmp_path):
    case = tmp_path / "case"
    shutil.copytree(good_case, case)
    data = json.loads((case / "geom.json").read_text())
    for view in data["views"]:
        view["rows"] = view["columns"] = 120
        view["pixel_spacing_mm"] = [1.28, 1.28]
    (case / "geom.json").write_text(json.dumps(data))
    looked = ("validate", case / "view1.png", case / "view2.png", "--geom", case / "geom.json")
    for call in (run_arguments(case, tmp_path / "out"), looked):
        done = gcar(*call)
        assert (
            done.code == 4
            and "view1.png, view 1: rows" in done.err
            and "--allow-rescale" in done.err
        )
    assert not (tmp_path / "out").exists()
    done = gcar(*run_arguments(case, tmp_path / "out", "--allow-rescale"))
    assert done.code == 0 and "0.8 times" in done.err


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be"])
def test_geometry_as_windows_writes_it(good_case, tmp_path, encoding):
    text = (good_case / "geom.json").read_text()
    mark = "\ufeff" if encoding == "utf-16-be" else ""
    (tmp_path / "geom.json").write_bytes((mark + text).encode(encoding))
    shown = gcar("geometry", "show", tmp_path / "geom.json", "--json")
    plain = gcar("geometry", "show", good_case / "geom.json", "--json")
    assert shown.code == 0 and shown.out == plain.out


def test_enhance_masks_as_run_does_or_says_what_it_takes_for_a_pixel(tmp_path):
    case = demo_case()
    data = json.loads(case.geometry.read_text())
    for view in data["views"]:
        view["intensity"] = {"kind": "attenuation", "polarity": "bright"}
    imaging = ImagingOptions(segmenter="classic")
    of_run = prepare(case.pictures, data, RunOptions(imaging=imaging))[0][0]
    look = ("enhance", case.pictures[0], "--segmenter", "classic", "--kind", "attenuation",
            "--polarity", "bright")  # fmt: skip
    told = gcar(*look, "--out", tmp_path / "a", "--pixel-mm", of_run.carm.pixel_at_isocenter_mm)
    assert told.code == 0 and told.err == ""
    mask = cv2.imread(str(tmp_path / "a" / "mask.png"), cv2.IMREAD_UNCHANGED) > 0
    np.testing.assert_array_equal(mask, extract_vessels(of_run, imaging).mask)
    guessed = gcar(*look, "--out", tmp_path / "b")
    assert guessed.code == 0 and "150 mm" in guessed.err and "--pixel-mm" in guessed.err


def test_enhance_tells_each_methods_own_files(tmp_path):
    """Both methods at once say what each alone says, under the names that its files have."""
    clean = cv2.imread(str(demo_case().pictures[0]), cv2.IMREAD_GRAYSCALE)
    grain = np.random.default_rng(0).normal(0, 4, clean.shape)
    # Uneven, so that the network is asked.
    ground = 150 + 25 * np.sin(np.arange(clean.shape[1]) / 40)
    cv2.imwrite(str(tmp_path / "raw.png"), (ground - 2.0 * clean + grain).astype(np.uint8))
    out, look = tmp_path / "a", ("enhance", tmp_path / "raw.png")
    both = gcar(*look, "--segmenter", "both", "--out", out).out.splitlines()
    assert len(both) == 2
    for who, prefix, line in zip(("classic", "net"), ("", "net_"), both, strict=True):
        alone = gcar(*look, "--segmenter", who, "--out", out, "--force").out
        for name in ("vesselness", "mask", "skeleton", "steps"):
            alone = alone.replace(f"{name}.png", f"{prefix}{name}.png")
        assert line == alone.strip()
    assert both[0].replace("net_", "") != both[1].replace("net_", "")


def test_doctor_passes_its_self_test():
    # Other tests of this process may have imported torch before.
    before = "torch" in sys.modules
    done = gcar("doctor", "--json")
    assert done.code == 0, done.err
    report = json.loads(done.out)
    assert report["self_test"]["passed"] and report["torch_imported"] == before
    assert report["versions"]["numpy"]
    assert {one["name"] for one in report["models"]} == {"gcp-multi", "gcp-paper", "segmenter"}
    assert all(one["sound"] and one["golden"] < 1e-3 for one in report["models"])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gcp-multi", "gcp-paper", "segmenter"])
@pytest.mark.parametrize("fault", ["missing", "altered"])
def test_doctor_checks_every_shipped_model(name, fault, tmp_path, monkeypatch):
    for file in MULTI.path.parent.iterdir():
        if file.suffix in (".onnx", ".json", ".npz"):
            (tmp_path / file.name).symlink_to(file)
    model = tmp_path / f"{name}.onnx"
    data = bytearray(model.read_bytes())
    data[len(data) // 2] ^= 1
    model.unlink()
    if fault == "altered":
        model.write_bytes(data)
    monkeypatch.setattr("gcar_deploy.models.spec.resources.files", lambda _: tmp_path)
    monkeypatch.setattr(
        doctor_verb,
        "self_test",
        lambda: {"passed": True, "sentence": "", "seconds": None, "distance_mm": None},
    )
    done = gcar("doctor", "--json")
    assert done.code == 5 and name in done.err
    unsound = {
        one["name"]: one["sentence"] for one in json.loads(done.out)["models"] if not one["sound"]
    }
    words = "was altered" if fault == "altered" else "not installed"
    assert list(unsound) == [name] and words in unsound[name]


@pytest.mark.slow
def test_demo_ends_with_a_picture_and_the_time(tmp_path):
    done = gcar("demo", "--out", tmp_path / "demo")
    assert done.code == 0, done.err
    for words in ("DSC", "Ot(1 mm)", "Chamfer", "time:", "overlay_view1.png", "report.html"):
        assert words in done.out
    assert (tmp_path / "demo" / "overlay_view1.png").is_file()


@pytest.mark.req("REQ-23")
def test_an_internal_error_is_one_line_unless_verbose(good_case, tmp_path, monkeypatch):
    from gcar_deploy import engine

    def broken(*_, **__):
        raise ZeroDivisionError("division\nby zero")

    monkeypatch.setattr(engine, "reconstruct", broken)
    done = gcar(*run_arguments(good_case, tmp_path / "out"))
    assert done.code == 1 and len(done.err.splitlines()) == 1 and "Traceback" not in done.err
    assert done.err == "gcar: error: internal error: ZeroDivisionError division; see -v\n"
    assert "Traceback" in gcar(*run_arguments(good_case, tmp_path / "out", "-v")).err
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr("gcar_deploy.output.folder.check_target", broken)
    verb = ("dicom", tmp_path, tmp_path / "a.dcm", "--out", tmp_path / "o")
    assert gcar(*verb).err == "gcar: error: internal error: ZeroDivisionError division\n"  # no -v


def test_a_path_that_the_output_has_no_letters_for_is_told_all_the_same(tmp_path):
    program = "from gcar_deploy.cli.common import say_result as s; import pathlib; "
    program += "s('\\u65e5: \\xe9', pathlib.Path('x'))"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, check=False,
        env={**os.environ, "PYTHONIOENCODING": "latin-1"},
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.decode("latin-1").strip() == "\\u65e5: \xe9"


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_full_disk_behind_stdout_is_one_line_and_the_result_stays(good_case, tmp_path):
    command = [sys.executable, "-m", "gcar_deploy.cli.main"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [*command, *map(str, run_arguments(good_case, tmp_path / "out"))],
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == (
        "gcar: error: standard output cannot be written (No space left on device); "
        f"the result lies in {tmp_path / 'out'}"
    )
    assert (tmp_path / "out" / "result.json").is_file()


def test_a_lesion_where_no_branch_runs_is_said(good_case, tmp_path):
    done = gcar(*run_arguments(good_case, tmp_path / "out", "--lesion", "1:1,1:3,3"))
    assert done.code == 0 and "lesion 1: no branch passes within 3 mm" in done.err
    notes = json.loads((tmp_path / "out" / "result.json").read_text())["notes"]
    assert sum("lesion 1" in note for note in notes) == 1


@pytest.mark.parametrize(
    ("raised", "word", "code"),
    [(entry.Terminated, "terminated", 143), (KeyboardInterrupt, "interrupted", 130)],
)
def test_a_signal_while_a_library_loads_is_a_signal(monkeypatch, capsys, raised, word, code):
    """An extension module in whose loading a signal arrives reports an ImportError of its own."""

    def load(*_, **__):
        try:
            raise raised
        except BaseException as signal:
            raise ImportError("initialization failed") from signal

    monkeypatch.setattr(entry.gcar, "main", load)
    with pytest.raises(SystemExit) as ended:
        entry.main(["run"])
    assert ended.value.code == code
    assert capsys.readouterr().err == f"gcar: error: {word}\n"


@pytest.mark.req("REQ-35")
def test_the_progress_bar_is_for_terminals_only(monkeypatch, capsys):
    from gcar_deploy.cli import common

    monkeypatch.setattr(common, "_PATIENCE_S", -1.0)
    bar = common.ProgressBar(quiet=False)
    bar("refine", 0.5)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(common.sys.stderr, "isatty", lambda: True, raising=False)
    with common.ProgressBar(quiet=False) as bar:
        bar("refine", 0.5)
        assert " 50% refine" in capsys.readouterr().err
    with common.ProgressBar(quiet=True) as bar:
        bar("refine", 0.5)
    assert "refine" not in capsys.readouterr().err


@pytest.mark.slow
def test_run_with_the_papers_predictor_and_refinement_is_never_ok(good_case, tmp_path):
    out = tmp_path / "paper"
    pictures = [good_case / f"view{k}.png" for k in (1, 2)]
    done = gcar("run", *pictures, "--geom", good_case / "geom.json", "--out", out,
                "--predictor", "paper", "--refiner", "paper")  # fmt: skip
    assert done.code == 0, done.err
    summary = json.loads((out / "result.json").read_text())
    assert (summary["predictor"], summary["refiner"]) == ("paper", "paper")
    assert summary["status"] == "degraded" and summary["model"]["name"] == "gcp-paper"


@pytest.mark.parametrize("kind", ["multi", "paper"])
def test_info_prints_the_card_of_a_model(kind, tmp_path):
    path = PREDICTOR_KINDS[kind].path
    done = gcar("info", path)
    assert done.code == 0 and f"gcp-{kind}: Gaussian centre predictor" in done.out
    spec = json.loads(path.with_suffix(".json").read_text())
    assert spec["sha256"] in done.out and f"{spec['parameters']:,} parameters" in done.out
    assert "trained on: generated trees" in done.out
    assert json.loads(gcar("info", path, "--json").out) == spec
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "m.onnx").write_bytes(bytes(data))
    (tmp_path / "m.json").write_text(json.dumps(spec))
    altered = gcar("info", tmp_path / "m.onnx")
    assert altered.code == 5 and "was altered" in altered.err


def test_info_prints_the_card_of_the_segmenter():
    from gcar_deploy.imaging.net import KIND

    done = gcar("info", KIND.path)
    assert done.code == 0 and "segmenter: segmenter (which pixels are vessel" in done.out
    spec = json.loads(KIND.path.with_suffix(".json").read_text())
    dice = f"dice {spec['training']['validation']['dice']:.3f}"
    assert spec["sha256"] in done.out and dice in done.out
    assert "devices: trained on gcar_export.scenes.device_pictures" in done.out


def test_the_end_of_a_process_collects_nothing():
    """What is frozen by then is not searched for cycles, which takes 0.1 s after a run."""
    code = (
        "import atexit, gc; atexit.register(lambda: print(gc.get_freeze_count()))\n"
        "from gcar_deploy.cli.main import main; main(['--version'])"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(told.stdout.split()[-1]) > 1000

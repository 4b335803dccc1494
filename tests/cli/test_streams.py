"""Standard output and error as services and shells hand them over: closed, or full."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from importlib import resources

import pytest

from gcar_deploy.cli import main as entry
from tests.cli.conftest import gcar

pytestmark = pytest.mark.skipif(os.name != "posix", reason="shells")


def in_shell(redirected, folder, *words):
    """Run the command as a process whose streams a shell redirects."""
    return subprocess.run(
        ["sh", "-c", f'exec "$@" {redirected}', "sh", sys.executable, "-m", "gcar_deploy.cli.main",
         *map(str, words)],
        capture_output=True, text=True, cwd=folder,
    )  # fmt: skip


def test_what_nohup_ignores_stays_ignored(monkeypatch):
    kept = []
    monkeypatch.setattr(
        entry.gcar, "main", lambda *_, **__: kept.append(signal.getsignal(signal.SIGHUP))
    )
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert gcar("run").code == 0
        assert [*kept, signal.getsignal(signal.SIGHUP)] == [signal.SIG_IGN] * 2
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        assert gcar("run").code == 0
        assert kept[1] is entry._terminate
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_DFL
    finally:
        signal.signal(signal.SIGHUP, before)


def words_of(verb, case, folder):
    """A short call of a verb that writes into ``folder``, if anywhere."""
    geometry, *views = (case / name for name in ("geom.json", "view1.png", "view2.png"))
    to = ("--out", folder / "out", "--predictor", "none")
    table = folder / "cases.csv"
    table.write_text(f"case,geom,view1,view2\na,{geometry},{views[0]},{views[1]}\n")
    return {
        "run": ("run", *views, "--geom", geometry, *to),
        "demo": ("demo", *to),
        "batch": ("batch", table, *to, "--jobs", "2"),
        "bench": ("bench", "--stages", "--repeats", "1"),
    }[verb]


@pytest.mark.parametrize(
    "verb", ["run", "demo", "batch", pytest.param("bench", marks=pytest.mark.slow)]
)
def test_a_closed_standard_error_is_none(verb, good_case, tmp_path):
    """Its number is free then, and the next file that is opened would get it."""
    done = in_shell("2>&-", tmp_path, *words_of(verb, good_case, tmp_path))
    assert done.returncode == 0 and done.stdout != ""
    assert verb == "bench" or (tmp_path / "out").is_dir()


def test_a_closed_standard_output_is_none(good_case, tmp_path):
    """As of standard error: the result is made, and who writes to the number hits no file."""
    done = in_shell(">&-", tmp_path, *words_of("run", good_case, tmp_path))
    assert (done.returncode, done.stderr) == (0, "") and (tmp_path / "out").is_dir()
    code = (
        "import os\nfrom gcar_deploy.cli.main import main\n"
        "try:\n    main(['--version'])\nfinally:\n    os.write(1, b'to nobody')"
    )
    shell = ["sh", "-c", 'exec "$@" >&-', "sh", sys.executable, "-c", code]
    assert subprocess.run(shell, capture_output=True).returncode == 0


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
@pytest.mark.parametrize("verb", ["demo", "batch"])
def test_a_result_whose_summary_nobody_can_read_stays_and_is_named(verb, good_case, tmp_path):
    """As of ``run``, beside the other faults of that verb."""
    done = in_shell(">/dev/full", tmp_path, *words_of(verb, good_case, tmp_path))
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].endswith(f"; the result lies in {tmp_path / 'out'}")
    assert (tmp_path / "out").is_dir()


def with_stderr_gone(kind, folder, *words):
    """Run the command with a standard error that takes nothing."""
    command = [sys.executable, "-m", "gcar_deploy.cli.main", *map(str, words)]
    if kind == "full":
        with open("/dev/full", "w") as full:
            return subprocess.run(command, stdout=subprocess.PIPE, stderr=full, cwd=folder)
    reader, writer = os.pipe()
    os.close(reader)
    try:
        return subprocess.run(command, stdout=subprocess.PIPE, stderr=writer, cwd=folder)
    finally:
        os.close(writer)


@pytest.mark.parametrize("kind", ["reader gone", "full"])
@pytest.mark.parametrize("code", [2, 3, 4])
def test_an_error_that_nobody_can_read_keeps_its_exit_code(kind, code, good_case, tmp_path):
    if kind == "full" and not os.path.exists("/dev/full"):
        pytest.skip("needs /dev/full")
    words = list(words_of("run", good_case, tmp_path))
    words[{2: 0, 3: 2, 4: 4}[code]] = {2: "rum", 3: tmp_path / "no.png", 4: tmp_path / "no"}[code]
    assert with_stderr_gone(kind, tmp_path, *words).returncode == code


@pytest.mark.parametrize("kind", ["reader gone", "full"])
def test_a_warning_that_nobody_can_read_costs_no_result(kind, good_case, tmp_path):
    if kind == "full" and not os.path.exists("/dev/full"):
        pytest.skip("needs /dev/full")
    words = (*words_of("run", good_case, tmp_path), "--lesion", "1:1,1:3,3")  # lies on no branch
    done = with_stderr_gone(kind, tmp_path, *words)
    assert done.returncode == 0 and (tmp_path / "out").is_dir()
    assert done.stdout.decode().startswith(str(tmp_path / "out"))


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        (("--predictor", "x"), 2), (("--landmark", "x"), 2), (("--mask", "1:no.png"), 3),
        (("--geom", "no.json"), 4), (("--model", "no.onnx"), 5), (("--strict",), 6),
        (("--deadline", "1e-6"), 7),
    ],
)  # fmt: skip
def test_json_is_one_object_whatever_went_wrong(wrong, code, good_case, tmp_path):
    jsonschema = pytest.importorskip("jsonschema")
    words = [*words_of("run", good_case, tmp_path), "--json", *wrong]
    if code == 5:
        words = [word for word in words if word not in ("--predictor", "none")]
    done = gcar(*words)
    assert done.code == code
    found = json.loads(done.out)
    assert (found["status"], found["exit_code"]) == ("refused" if code == 6 else "failed", code)
    assert done.err.splitlines()[-1] == "gcar: error: " + " ".join(found["sentence"].split())
    schema = resources.files("gcar_deploy.output").joinpath("result.schema.json").read_text()
    jsonschema.validate(found, json.loads(schema))


def test_json_of_what_tells_its_own_errors_stays_one_object(good_case, tmp_path):
    looked = ("validate", good_case / "view1.png", tmp_path / "no.png", "--json")
    done = gcar(*looked, "--geom", good_case / "geom.json")
    assert done.code == 3 and json.loads(done.out)["schema"] == "gcar-validation/1"
    done = gcar("geometry", "show", tmp_path / "no.json", "--json")
    assert done.code == 4 and json.loads(done.out)["status"] == "failed"
    done = gcar("info", tmp_path / "no", "--json")
    assert done.code == 2 and json.loads(done.out)["status"] == "failed"

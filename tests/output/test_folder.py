"""A result folder appears whole or not at all."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gcar_deploy.errors import GcarError, UsageError
from gcar_deploy.output import folder
from gcar_deploy.output.folder import check_target, in_the_way, write_folder

FILES = {"a.txt": b"alpha", "b.bin": bytes(range(256))}


def listing(path: Path) -> dict[str, bytes]:
    """All files but the manifest."""
    return {
        p.relative_to(path).as_posix(): p.read_bytes()
        for p in path.rglob("*")
        if p.is_file() and p.name != "manifest.json"
    }


def test_writes_exactly_the_files_and_nothing_beside(tmp_path):
    write_folder(tmp_path / "out", FILES)
    assert listing(tmp_path) == {f"out/{name}": data for name, data in FILES.items()}


def test_makes_missing_parents(tmp_path):
    write_folder(tmp_path / "x" / "y" / "out", FILES)
    assert listing(tmp_path / "x" / "y" / "out") == FILES


@pytest.mark.req("REQ-29")
def test_an_existing_folder_is_refused_and_untouched(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine").write_bytes(b"1")
    with pytest.raises(UsageError, match="--force"):
        write_folder(out, FILES)
    assert listing(out) == {"mine": b"1"}


@pytest.mark.parametrize("exchange", [True, False], ids=["one step", "two renames"])
def test_force_replaces_the_folder_whole(tmp_path, monkeypatch, exchange):
    if not exchange:
        monkeypatch.setattr(folder, "_rename2", lambda *_: False)
    out = tmp_path / "out"
    write_folder(out, {"old": b"1"})
    write_folder(out, FILES, force=True)
    assert listing(tmp_path) == {f"out/{name}": data for name, data in FILES.items()}


@pytest.mark.parametrize("kind", ["link to folder", "dangling link", "file"])
@pytest.mark.req("REQ-29")
def test_links_and_files_are_refused(tmp_path, kind):
    out = tmp_path / "out"
    if kind == "file":
        out.write_bytes(b"1")
    else:
        target = tmp_path / "target"
        if kind == "link to folder":
            target.mkdir()
        out.symlink_to(target)
    for force in (False, True):
        with pytest.raises(UsageError):
            write_folder(out, FILES, force=force)
    assert out.is_symlink() or out.read_bytes() == b"1"


@pytest.mark.parametrize("force", [False, True])
def test_inputs_and_the_working_folder_are_never_taken_along(tmp_path, monkeypatch, force):
    """With or without --force, so that no one is told to add what does not help."""
    out = tmp_path / "out"
    write_folder(out, {"view1.png": b"1"})
    with pytest.raises(UsageError, match=r"holds the input view1.png, which is not deleted"):
        check_target(out, force=force, inputs=(out / "view1.png",))
    monkeypatch.chdir(out)
    for name in (".", out):
        with pytest.raises(UsageError, match=r"is the working folder") as told:
            check_target(Path(name), force=force)
        assert "--force" not in str(told.value)
    with pytest.raises(UsageError, match=r"\.\. holds the working folder"):
        check_target(Path(".."), force=force)
    with pytest.raises(UsageError, match="mount point"):
        check_target(Path("/"), force=force)


def test_neither_a_home_nor_a_working_folder_is_needed(tmp_path, monkeypatch):
    def absent(*_):
        raise RuntimeError("no home")

    out, gone = tmp_path / "out", tmp_path / "gone"
    write_folder(out, {"view1.png": b"1"})
    gone.mkdir()
    monkeypatch.chdir(gone)
    monkeypatch.setattr(Path, "home", absent)
    if os.name == "posix":
        gone.rmdir()
    check_target(out, force=True)
    write_folder(out, {"view1.png": b"2"}, force=True)
    assert (out / "view1.png").read_bytes() == b"2"


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize(
    "content",
    [
        {"thesis.txt": "x"},
        {"thesis.txt": "x", "result.json": "{"},
        {"thesis.txt": "x", "result.json": '{"schema": "other/1", "files": {"thesis.txt": {}}}'},
        {"thesis.txt": "x", "manifest.json": '{"files": {"thesis.txt": {}}}'},
        {"thesis.txt": "x", "manifest.json": "[" * 100_000},
        {"chapters/one.txt": "x"},
    ],
    ids=["alone", "no json", "another's", "no schema", "deep", "a folder"],
)
def test_what_others_wrote_is_never_replaced(tmp_path, force, content):
    out = tmp_path / "out"
    for name, text in content.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(text)
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    first = min(p.name for p in out.iterdir())
    with pytest.raises(UsageError, match=rf"holds {first}, which gcar did not write") as told:
        write_folder(out, FILES, force=force)
    assert told.value.exit_code == 2
    assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == before


def test_what_was_put_beside_a_result_is_in_the_way(tmp_path):
    out = tmp_path / "out"
    write_folder(out, FILES)
    assert in_the_way(out) is None
    (out / ".DS_Store").write_bytes(b"1")
    write_folder(out, FILES, force=True)
    (out / "thesis.txt").write_text("x")
    with pytest.raises(UsageError, match=r"holds thesis.txt.*--force"):
        write_folder(out, FILES, force=True)
    assert (out / "thesis.txt").read_text() == "x"


def test_an_empty_folder_may_be_replaced(tmp_path):
    (tmp_path / "out").mkdir()
    with pytest.raises(UsageError, match="add --force"):
        write_folder(tmp_path / "out", FILES)
    write_folder(tmp_path / "out", FILES, force=True)
    assert listing(tmp_path / "out") == FILES


def test_the_manifest_lists_every_file(tmp_path):
    write_folder(tmp_path / "out", FILES)
    told = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert told["schema"] == "gcar-folder/1" and told["files"].keys() == FILES.keys()
    for name, data in FILES.items():
        assert told["files"][name]["sha256"] == hashlib.sha256(data).hexdigest()
    own = {"result.json": b'{"schema": "gcar-result/1", "files": {}}'}
    write_folder(tmp_path / "result", own)
    assert [p.name for p in (tmp_path / "result").iterdir()] == ["result.json"]


def test_a_file_in_the_way_of_the_parents(tmp_path):
    (tmp_path / "x").write_bytes(b"1")
    with pytest.raises(UsageError, match="not a folder"):
        write_folder(tmp_path / "x" / "out", FILES)


@pytest.mark.parametrize("step", ["_write", "_sync_folder", "_put"])
@pytest.mark.parametrize("error", [OSError(28, "No space left"), KeyboardInterrupt()])
@pytest.mark.parametrize("existing", [False, True])
@pytest.mark.req("REQ-28")
def test_any_fault_leaves_what_was_there(tmp_path, monkeypatch, step, error, existing):
    parent = tmp_path / "new"
    if existing:
        write_folder(parent / "out", {"old": b"1"})

    def fail(*_, **__):
        raise error

    monkeypatch.setattr(folder, step, fail)
    with pytest.raises(GcarError if isinstance(error, OSError) else KeyboardInterrupt):
        write_folder(parent / "out", FILES, force=existing)
    monkeypatch.undo()
    assert listing(tmp_path) == ({"new/out/old": b"1"} if existing else {})
    assert existing or not parent.exists()


def test_a_failed_second_rename_puts_the_old_folder_back(tmp_path, monkeypatch):
    out = tmp_path / "out"
    write_folder(out, {"old": b"1"})
    monkeypatch.setattr(folder, "_rename2", lambda *_: False)
    rename = os.rename

    def refuse(source, target):
        if Path(source).name == "new":
            raise OSError(5, "Input/output error")
        rename(source, target)

    monkeypatch.setattr(folder.os, "rename", refuse)
    with pytest.raises(GcarError):
        write_folder(out, FILES, force=True)
    monkeypatch.undo()
    assert listing(tmp_path) == {"out/old": b"1"}


def test_a_folder_made_meanwhile_is_not_overwritten(tmp_path, monkeypatch):
    out = tmp_path / "out"
    write = folder._write

    def meanwhile(path, data):
        write(path, data)
        out.mkdir(exist_ok=True)
        (out / "theirs").write_bytes(b"1")

    monkeypatch.setattr(folder, "_write", meanwhile)
    with pytest.raises(GcarError):
        write_folder(out, FILES)
    monkeypatch.undo()
    assert listing(tmp_path) == {"out/theirs": b"1"}


@pytest.mark.parametrize("where", ["_sync_folder", "_rename2", "os.rename"])
@pytest.mark.parametrize("force", [False, True])
def test_the_slower_of_two_runs_is_told_as_if_it_had_come_later(
    tmp_path, monkeypatch, where, force
):
    """The faster one is done before the folder is put in place, or just when it is."""
    out, theirs = tmp_path / "out", {"theirs": b"1"}
    place = folder.os if where == "os.rename" else folder
    name = where.removeprefix("os.")
    real = getattr(place, name)

    def late(*arguments):
        monkeypatch.undo()
        write_folder(out, theirs)
        return real(*arguments)

    if where == "os.rename":
        monkeypatch.setattr(folder, "_rename2", lambda *_: False)
    monkeypatch.setattr(place, name, late)
    if force:
        write_folder(out, FILES, force=True)
    else:
        with pytest.raises(UsageError, match="out exists; choose another folder or add --force"):
            write_folder(out, FILES)
    monkeypatch.undo()
    assert listing(out) == (FILES if force else theirs)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="POSIX signals")
@pytest.mark.parametrize(
    ("number", "code"),
    [("SIGTERM", 143), ("SIGHUP", 143), pytest.param("SIGINT", 130, marks=pytest.mark.slow)],
)
@pytest.mark.req("REQ-24")
def test_signals_leave_nothing_and_end_with_their_code(tmp_path, number, code):
    out = tmp_path / "out"
    script = (
        "import signal, sys, time\n"
        # A test run in the background hands down that interrupts are ignored.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"
        "from gcar_deploy.cli import main as cli\n"
        "from gcar_deploy.output import folder\n"
        "from gcar_deploy.cli.main import main\n"
        "write = folder._write\n"
        "def slow(path, data):\n"
        "    write(path, data)\n"
        "    sys.stdout.write('writing\\n')\n"  # in one piece: several files are written at once
        "    sys.stdout.flush()\n"
        "    time.sleep(1)\n"
        "folder._write = slow\n"
        f"main(['demo', '--predictor', 'none', '--refiner', 'none', '--out', {str(out)!r}])\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline().strip() == "writing"
        time.sleep(0.1)
        process.send_signal(getattr(signal, number))
        _, errors = process.communicate(timeout=300)
    assert process.returncode == code
    assert errors.strip().splitlines()[-1].startswith("gcar: error:")
    assert "Traceback" not in errors
    assert list(tmp_path.iterdir()) == []


def test_a_name_that_is_too_long_is_refused(tmp_path):
    for out in (tmp_path / ("a" * 300), tmp_path / ("a" * 300) / "out"):
        with pytest.raises(UsageError, match="cannot be made"):
            check_target(out, force=False)
    assert list(tmp_path.iterdir()) == []

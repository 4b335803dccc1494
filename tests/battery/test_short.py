"""The short version of every part of the battery, as a process of its own.

Children are forked from it, which a test process with its threads must not be.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.skipif(os.name != "posix", reason="forks and POSIX limits")


def battery(*arguments: object) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "tests.battery", *(str(a) for a in arguments)],
        capture_output=True, text=True, cwd=ROOT, timeout=900, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
    assert "findings: 0" in done.stdout
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "share", "module"),
    [
        ("png", 0.05, "cv2"),
        ("json", 0.05, "json"),
        pytest.param("onnx", 0.05, "onnx", marks=pytest.mark.slow),
        pytest.param("dicom", 0.05, "pydicom", marks=pytest.mark.slow),
        pytest.param("checkpoint", 0.2, "safetensors", marks=pytest.mark.slow),
        pytest.param("http", 0.05, "flask", marks=pytest.mark.slow),
    ],
)
@pytest.mark.req("REQ-45")
def test_damaged_input_is_refused_in_one_line(kind, share, module):
    pytest.importorskip(module, reason=f"{kind} needs {module}")
    said = battery("fuzz", "--kind", kind, "--share", share, "--seed", 7)
    found = re.search(r"(\d+) cases, 0 findings", said)
    assert found and int(found[1]) >= 100, said


@pytest.mark.slow
@pytest.mark.req("REQ-45")
def test_damaged_command_lines_are_refused_in_one_line():
    pytest.importorskip("torch", reason="needs the export extra")
    said = battery("fuzz", "--kind", "command", "--share", 0.1, "--seed", 7)
    assert "30 cases, 0 findings" in said


@pytest.mark.slow
def test_a_run_goes_on_where_it_stopped(tmp_path):
    state = tmp_path / "state.json"
    first = battery("fuzz", "--kind", "json", "--share", 0.01, "--state", state)
    again = battery("fuzz", "--kind", "json", "--share", 0.02, "--state", state)
    assert "200 cases" in first and "400 cases" in again
    whole = battery("fuzz", "--kind", "json", "--share", 0.02)
    counts = re.compile(r"400 cases.*?;(.*?); at most")
    assert counts.search(again)[1] == counts.search(whole)[1]


@pytest.mark.slow
@pytest.mark.req("REQ-46")
def test_faults_leave_the_old_result_or_the_new_one():
    said = battery("faults", "--kills", 4, "--signals", 4)
    assert "4 at random moments" in said and "4 of SIGINT, SIGTERM" in said


@pytest.mark.slow
@pytest.mark.req("REQ-33")
def test_same_input_same_bytes():
    said = battery("determinism", "--repeats", 2, "--hash-seeds", 2)
    assert said.count(": 1 hash") == 2


@pytest.mark.slow
def test_threads_and_files_stay_in_a_warm_process():
    """A short line says nothing of the memory's slope; the rest of it holds at once."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.battery", "soak", "--count", "40"],
        capture_output=True, text=True, cwd=ROOT, timeout=900, check=False,
    )  # fmt: skip
    findings = [line for line in done.stdout.splitlines() if line.startswith("    ")]
    assert all("memory grows" in line for line in findings), done.stdout + done.stderr
    assert "same bytes" in done.stdout and "40 cases" in done.stdout


def test_every_bug_of_the_mutation_check_can_still_be_put_in():
    from tests.battery.mutants import MUTANTS

    names = [mutant.name for mutant in MUTANTS]
    assert len(set(names)) == len(names)
    assert {name.split(":")[0] for name in names} >= {
        "geometry", "projection", "loss", "hashing", "models", "atomicity", "output", "worker",
        "sigma", "rays", "views", "pictures", "tree", "measures",
    }  # fmt: skip
    for mutant in MUTANTS:
        text = (ROOT / mutant.file).read_text(encoding="utf-8")
        assert mutant.old in text, mutant.name
        for test in mutant.tests:
            assert (ROOT / test.partition("::")[0]).is_file(), mutant.name

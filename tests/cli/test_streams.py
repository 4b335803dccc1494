"""Standard output and error as services and shells hand them over: closed, or full."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(os.name != "posix", reason="shells")


def in_shell(redirected, folder, *words):
    """Run the command as a process whose streams a shell redirects."""
    return subprocess.run(
        ["sh", "-c", f'exec "$@" {redirected}', "sh", sys.executable, "-m", "gcar_deploy.cli.main",
         *map(str, words)],
        capture_output=True, text=True, cwd=folder,
    )  # fmt: skip


def run_of(case, out, *extra):
    return (
        "run", case / "view1.png", case / "view2.png", "--geom", case / "geom.json",
        "--out", out, "--predictor", "none", *extra,
    )  # fmt: skip


@pytest.mark.parametrize(
    "verb", ["run", "demo", "batch", pytest.param("bench", marks=pytest.mark.slow)]
)
def test_a_closed_standard_error_is_none(verb, good_case, tmp_path):
    """Its number is free then, and the next file that is opened would get it."""
    table, out = tmp_path / "cases.csv", tmp_path / "out"
    files = ",".join(str(good_case / name) for name in ("geom.json", "view1.png", "view2.png"))
    table.write_text(f"case,geom,view1,view2\na,{files}\n")
    words = {
        "run": run_of(good_case, out),
        "demo": ("demo", "--out", out, "--predictor", "none"),
        "batch": ("batch", table, "--out", out, "--jobs", "2", "--predictor", "none"),
        "bench": ("bench", "--stages", "--repeats", "1"),
    }[verb]
    done = in_shell("2>&-", tmp_path, *words)
    assert done.returncode == 0 and done.stdout != ""
    assert verb == "bench" or out.is_dir()

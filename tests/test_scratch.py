"""What killed runs leave is swept; what lives, or is somebody else's, is not touched."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from gcar_deploy.output.folder import write_folder
from gcar_deploy.scratch import scratch_folder, sweep

pytestmark = pytest.mark.skipif(os.name != "posix", reason="POSIX locks")

OWNER = """
import sys, time
from pathlib import Path
from gcar_deploy.scratch import scratch_folder
with scratch_folder(Path(sys.argv[1])) as folder:
    (folder / "new").mkdir()
    (folder / "new" / "half").write_bytes(b"1")
    print(folder, flush=True)
    time.sleep(600)
"""


def owner(parent: Path) -> tuple[subprocess.Popen[str], Path]:
    process = subprocess.Popen(
        [sys.executable, "-c", OWNER, str(parent)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    return process, Path(process.stdout.readline().strip())


@pytest.mark.req("REQ-30")
def test_a_living_owners_folder_stays_and_a_killed_ones_goes(tmp_path):
    process, folder = owner(tmp_path)
    with process:
        try:
            assert sweep(tmp_path) == 0 and (folder / "new" / "half").exists()
        finally:
            process.kill()
            process.wait(timeout=60)
    assert process.returncode == -signal.SIGKILL and folder.exists()
    write_folder(tmp_path / "out", {"a": b"1"})
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_own_folder_is_not_swept_from_within(tmp_path):
    with scratch_folder(tmp_path) as folder:
        assert sweep(tmp_path) == 0 and folder.exists()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.req("REQ-30")
def test_what_is_not_ours_stays(tmp_path):
    for name in (".gcar-save-", ".gcar-save-short", ".gcar-cache", "gcar-save-abcdefgh"):
        (tmp_path / name).mkdir(mode=0o700)
    (tmp_path / ".gcar-save-afile123").write_bytes(b"1")
    (tmp_path / ".gcar-save-readable").mkdir(mode=0o755)
    (tmp_path / ".gcar-save-alink123").symlink_to(tmp_path / ".gcar-cache")
    before = sorted(p.name for p in tmp_path.iterdir())
    assert sweep(tmp_path) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == before


@pytest.mark.req("REQ-30")
def test_the_only_copy_of_a_result_is_never_swept(tmp_path):
    """Killed between two renames, the old result lies in the scratch folder alone."""
    scratch = tmp_path / ".gcar-save-abcdefgh"
    for name in ("new", "old"):
        (scratch / name).mkdir(parents=True, mode=0o700)
    scratch.chmod(0o700)
    assert sweep(tmp_path) == 0 and (scratch / "old").is_dir()
    (scratch / "new").rmdir()
    assert sweep(tmp_path) == 1 and not scratch.exists()

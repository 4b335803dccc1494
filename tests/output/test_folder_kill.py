"""Killed at any moment, the folder is the old complete one or the new complete one."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time

import pytest

from gcar_deploy.errors import UsageError
from gcar_deploy.output import folder
from gcar_deploy.output.folder import listed, write_folder

NAMES = [f"file{k}.bin" for k in range(6)]
SCRIPT = """
import os, sys
from pathlib import Path
from gcar_deploy.output.folder import write_folder
out = Path(sys.argv[1])
print("started", flush=True)
for generation in range(100000):
    data = f"{os.getpid()}-{generation} ".encode() * 2000
    write_folder(out, {name: data for name in sys.argv[2:]}, force=True)
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="POSIX signals")
@pytest.mark.req("REQ-28")
def test_twenty_kills_never_leave_half_a_folder(tmp_path):
    out = tmp_path / "out"
    write_folder(out, dict.fromkeys(NAMES, b"first"))
    chance = random.Random(0)  # noqa: S311 - a reproducible moment, no secret
    seen, left = set(), 0
    for _ in range(20):
        with subprocess.Popen(
            [sys.executable, "-c", SCRIPT, str(out), *NAMES], stdout=subprocess.PIPE
        ) as process:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(chance.uniform(0.0, 0.25))
            process.send_signal(signal.SIGKILL)
            process.wait(timeout=30)
        assert process.returncode == -signal.SIGKILL
        assert sorted(p.name for p in out.iterdir()) == [*NAMES, "manifest.json"]
        contents = {(out / name).read_bytes() for name in NAMES}
        assert json.loads((out / "manifest.json").read_text())["files"] == listed(
            {name: (out / name).read_bytes() for name in NAMES}
        )
        assert len(contents) == 1, "files of two runs in one folder"
        seen |= contents
        # What a kill leaves is only its own hidden folder, readable by nobody else; the next
        # process takes those of the dead away.
        rests = [rest for rest in tmp_path.iterdir() if rest != out]
        for rest in rests:
            assert rest.name.startswith(".gcar-") and rest.stat().st_mode & 0o077 == 0
        left += bool(rests)
    assert left > 3 and len(seen) > 1, "the kills did not come while it was writing"
    write_folder(out, dict.fromkeys(NAMES, b"last"), force=True)
    assert list(tmp_path.iterdir()) == [out]


def test_a_read_only_place_is_refused_before_any_work(tmp_path, monkeypatch):
    # Permissions do not bind root, under whom tests may run.
    monkeypatch.setattr(folder.os, "access", lambda *_: False)
    with pytest.raises(UsageError, match="not writable"):
        write_folder(tmp_path / "out", {"a": b"1"})
    monkeypatch.undo()
    assert list(tmp_path.iterdir()) == []

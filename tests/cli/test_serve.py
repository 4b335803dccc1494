"""gcar serve as a process: one token, the loopback port, a clean end."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import urllib.request

import pytest

from gcar_deploy.cli.serve import read_token
from gcar_deploy.errors import UsageError
from tests.cli.conftest import gcar

pytest.importorskip("flask")


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_serves_until_it_is_told_to_stop(number):
    # A test run in the background hands down that interrupts are ignored.
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from gcar_deploy.cli.main import main; main(['serve', '--predictor', 'none'])"
    )
    worker = subprocess.Popen(
        [sys.executable, "-c", code],
        stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env={k: v for k, v in os.environ.items() if k != "GCAR_TOKEN"},
    )  # fmt: skip
    assert worker.stderr
    address = re.fullmatch(r"gcar: (http://127\.0\.0\.1:\d+)\n", worker.stderr.readline())
    token = re.fullmatch(r"gcar: token (\S{40,})\n", worker.stderr.readline())
    assert address and token
    with urllib.request.urlopen(address[1] + "/health", timeout=60) as reply:
        assert json.load(reply)["status"] == "ok"
    worker.send_signal(number)
    out, err = worker.communicate(timeout=300)
    assert worker.returncode == 0 and out == "" and token[1] not in err


def test_tokens_from_the_environment_and_files(tmp_path, monkeypatch):
    monkeypatch.delenv("GCAR_TOKEN", raising=False)
    assert read_token(None) is None
    monkeypatch.setenv("GCAR_TOKEN", "0123456789abcdef")
    assert read_token(None) == "0123456789abcdef"
    file = tmp_path / "token"
    file.write_text("fedcba9876543210\n")
    file.chmod(0o600)
    assert read_token(file) == "fedcba9876543210"
    if os.name == "posix":
        file.chmod(0o644)
        with pytest.raises(UsageError, match="chmod 600"):
            read_token(file)
    for bad in ("short", "has a space in the middle"):
        monkeypatch.setenv("GCAR_TOKEN", bad)
        with pytest.raises(UsageError, match="16 or more"):
            read_token(None)
    with pytest.raises(UsageError, match="cannot be read"):
        read_token(tmp_path / "absent")


def test_a_folder_that_is_none_is_refused(tmp_path):
    done = gcar("serve", "--folder", tmp_path / "absent", "--stdio", "--predictor", "none")
    assert done.code == 2 and "not a folder" in done.err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verb", "library", "extra"),
    [
        (("serve",), "flask", "serve"),
        (("serve",), "waitress", "serve"),
        (("listen", "--out", "results"), "pynetdicom", "listen"),
    ],
)
def test_a_missing_extra_is_one_line(verb, library, extra, tmp_path):
    """Told before anything is loaded or made."""
    code = (
        f"import sys; sys.modules[{library!r}] = None\n"
        f"from gcar_deploy.cli.main import main; main({list(verb)!r})"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 2 and f"pip install 'gcar[{extra}]'" in done.stderr
    assert len(done.stderr.splitlines()) == 1 and not list(tmp_path.iterdir())


def test_a_refused_call_leaves_its_process_as_it_was(tmp_path):
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_AS), signal.getsignal(signal.SIGTERM)
    assert gcar("serve", "--folder", tmp_path / "absent", "--stdio").code == 2
    assert (resource.getrlimit(resource.RLIMIT_AS), signal.getsignal(signal.SIGTERM)) == before

"""gcar serve as a process: one token, the loopback port, a clean end."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.request

import pytest

from gcar_deploy.cli.serve import read_token
from gcar_deploy.errors import UsageError
from tests.cli.conftest import gcar, good_case  # noqa: F401 - a fixture

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


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("times", [1, 2])
def test_told_to_stop_while_clients_wait_it_leaves_no_picture(good_case, tmp_path, times):  # noqa: F811
    private = tmp_path / "private"
    private.mkdir()
    worker = subprocess.Popen(
        [sys.executable, "-m", "gcar_deploy.cli.main", "serve", "--predictor", "none",
         "--folder", str(good_case)],
        stderr=subprocess.PIPE, text=True,
        env={**os.environ, "GCAR_TOKEN": "0123456789abcdef", "TMPDIR": str(private)},
    )  # fmt: skip
    assert worker.stderr
    address = worker.stderr.readline().split()[1]
    order = {"views": ["view1.png", "view2.png"], "geometry": "geom.json"}

    def ask():
        request = urllib.request.Request(
            f"{address}/v1/reconstruct?wait=60", json.dumps(order).encode(),
            {"Authorization": "Bearer 0123456789abcdef", "Content-Type": "application/json"},
        )  # fmt: skip
        with contextlib.suppress(OSError), urllib.request.urlopen(request, timeout=120) as reply:
            reply.read()

    clients = [threading.Thread(target=ask) for _ in range(8)]
    for client in clients:
        client.start()
    end = time.monotonic() + 60
    while len(list(private.iterdir())) < len(clients):
        assert time.monotonic() < end
        time.sleep(0.005)
    for _ in range(times):
        worker.send_signal(signal.SIGTERM)
        time.sleep(0.02)
    _, err = worker.communicate(timeout=300)
    for client in clients:
        client.join()
    assert "Traceback" not in err and "descriptor" not in err and not list(private.iterdir()), err


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

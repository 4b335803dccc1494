"""A worker with a real engine on a free port of this machine, and a small client."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shutil
import subprocess
import threading
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from gcar_deploy.config import PredictOptions, RunOptions
from gcar_deploy.engine import Engine
from gcar_deploy.worker.folder import AllowedFolder
from gcar_deploy.worker.jobs import JobQueue
from gcar_deploy.worker.orders import do_order
from tests.cli.conftest import good_case  # noqa: F401 - a fixture

TOKEN = "a-token-of-the-tests"


@pytest.fixture(scope="session")
def engine():
    return Engine(options=RunOptions(predict=PredictOptions(predictor="none")))


@pytest.fixture
def gate():
    """Set: jobs run; cleared: the next one waits before it starts."""
    event = threading.Event()
    event.set()
    return event


@pytest.fixture
def make_queue(engine, gate):
    made = []

    def work(order, on_progress, cancel):
        while not gate.wait(0.01):
            if cancel():
                break
        return do_order(engine, order, on_progress, cancel, limit_s=60.0)

    def make(**options) -> JobQueue:
        made.append(JobQueue(work, **options))
        return made[-1]

    yield make
    gate.set()
    for queue in made:
        queue.close()


@dataclasses.dataclass(frozen=True)
class Reply:
    status: int
    headers: Any
    body: bytes

    def json(self) -> Any:
        return json.loads(self.body)


@dataclasses.dataclass(frozen=True)
class Client:
    port: int
    token: str | None = TOKEN

    def __call__(self, method: str, path: str, body: Any = None, **headers: str) -> Reply:
        data = body
        if isinstance(body, (dict, list)):
            data = json.dumps(body).encode()
            headers.setdefault("Content-Type", "application/json")
        request = urllib.request.Request(
            f"http://127.0.0.1:{self.port}{path}", data=data, method=method
        )
        if self.token is not None:
            request.add_header("Authorization", f"Bearer {self.token}")
        for name, value in headers.items():
            request.add_header(name.replace("_", "-"), value)
        try:
            with urllib.request.urlopen(request, timeout=120) as reply:
                return Reply(reply.status, reply.headers, reply.read())
        except urllib.error.HTTPError as error:
            return Reply(error.code, error.headers, error.read())


def multipart(parts: list[tuple[str, str | None, bytes]]) -> tuple[bytes, str]:
    """Body and content type of (name, file name or None, content) parts."""
    mark = "part-of-the-tests"
    out = b""
    for name, file, content in parts:
        named = f'; filename="{file}"' if file else ""
        head = f'--{mark}\r\nContent-Disposition: form-data; name="{name}"{named}\r\n\r\n'
        out += head.encode() + content + b"\r\n"
    return out + f"--{mark}--\r\n".encode(), f"multipart/form-data; boundary={mark}"


@pytest.fixture
def serving(make_queue, good_case, tmp_path):  # noqa: F811 - the imported fixture
    """Client of a worker whose folder holds the good case."""
    pytest.importorskip("flask")
    pytest.importorskip("waitress")
    from gcar_deploy.worker.http import create_app
    from gcar_deploy.worker.loopback import listen

    folder = tmp_path / "folder"
    folder.mkdir()
    for file in good_case.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    app = create_app(make_queue(most_waiting=2), TOKEN, folder=AllowedFolder(folder), body_mib=1)
    server = listen(app, 0)

    def run() -> None:
        # Closing the server under its loop is how waitress is stopped from another thread.
        with contextlib.suppress(OSError):
            server.run()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    yield Client(int(server.effective_port)), folder
    # Nothing left to serve, and a pull at its sleeve: else the loop sleeps on for a second.
    server._map.clear()
    server.pull_trigger()
    thread.join(10)
    server.close()


@pytest.fixture
def case_folder(good_case) -> Path:  # noqa: F811
    return good_case


def dcmtk(name: str) -> str | None:
    """Return DCMTK's own tool: pynetdicom installs scripts of the same names."""
    for place in os.get_exec_path():
        path = shutil.which(name, path=place)
        if path is None:
            continue
        said = subprocess.run([path, "--version"], capture_output=True, text=True, check=False)
        if "$dcmtk" in said.stdout:
            return path
    return None

"""JSON lines: one message a line, answers with the ids of their questions."""

from __future__ import annotations

import io
import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import threading

import pytest

from gcar_deploy.worker.folder import AllowedFolder
from gcar_deploy.worker.stdio import MOST_CHARACTERS, LineServer


class Pipe:
    """A text stream that blocks on reading until something was written or it was closed."""

    def __init__(self):
        self._lines = queue.Queue()

    def write(self, text):
        for line in text.splitlines(keepends=True):
            self._lines.put(line)

    def flush(self):
        pass

    def empty(self):
        return self._lines.empty()

    def close(self):
        self._lines.put("")

    def readline(self, _=-1):
        return self._lines.get(timeout=120)


class Host:
    def __init__(self, make_queue, folder=None):
        self.to, self.back = Pipe(), Pipe()
        server = LineServer(lambda tell: make_queue(on_change=tell), folder, self.to, self.back)
        self.thread = threading.Thread(target=server.run, daemon=True)
        self.thread.start()
        self.seen = []

    def send(self, ident, method, **params):
        message = {"jsonrpc": "2.0", "id": ident, "method": method, "params": params}
        self.to.write(json.dumps(message) + "\n")

    def notify(self, method, **params):
        self.to.write(json.dumps({"jsonrpc": "2.0", "method": method, "params": params}) + "\n")

    def answer(self, ident):
        while True:
            message = json.loads(self.back.readline())
            self.seen.append(message)
            if message.get("id") == ident and "method" not in message:
                return message

    def end(self):
        self.to.close()
        self.thread.join(60)
        assert not self.thread.is_alive()


def order(case, out):
    return {
        "views": [str(case / "view1.png"), str(case / "view2.png")],
        "geometry": str(case / "geom.json"),
        "out": str(out),
    }


def test_a_reconstruction_with_progress(make_queue, case_folder, tmp_path):
    host = Host(make_queue)
    host.send(7, "reconstruct", **order(case_folder, tmp_path / "out"))
    found = host.answer(7)["result"]
    assert found["out"] == str(tmp_path / "out") and found["result"]["schema"] == "gcar-result/1"
    assert (tmp_path / "out" / "report.html").is_file()
    told = [m["params"] for m in host.seen if m.get("method") == "progress"]
    assert {p["id"] for p in told} == {7} and [p["share"] for p in told] == sorted(
        p["share"] for p in told
    )
    host.end()


def test_cancel_and_health(make_queue, case_folder, tmp_path, gate):
    gate.clear()
    host = Host(make_queue)
    host.send("a", "reconstruct", **order(case_folder, tmp_path / "out"))
    host.send("b", "cancel", id="a")
    assert host.answer("a")["error"]["code"] == 7
    host.send("c", "cancel", id="a")
    assert host.answer("c")["result"] == {"cancelled": False}
    host.send("d", "health")
    assert host.answer("d")["result"]["status"] == "ok"
    assert not (tmp_path / "out").exists()
    host.end()


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("{", -32700),
        ("[]", -32600),
        ('{"id": 1, "method": "health"}', -32600),
        ('{"method": "health"}', -32600),
        ('{"jsonrpc": "2.0", "method": 1}', -32600),
        ('{"jsonrpc": "2.0", "id": null, "method": "health"}', -32600),
        ('{"jsonrpc": "2.0", "id": true, "method": "health"}', -32600),
        ('{"jsonrpc": "2.0", "id": 1.5, "method": "health"}', -32600),
        ('[{"jsonrpc": "2.0", "id": 1, "method": "health"}]', -32600),
        ('{"jsonrpc": "2.0", "id": 1, "method": "dance"}', -32601),
        ('{"jsonrpc": "2.0", "id": 1, "method": "reconstruct", "params": {}}', -32602),
        ('{"jsonrpc": "2.0", "id": 1, "method": "reconstruct", "params": [1]}', -32602),
    ],
)
def test_messages_that_are_not_understood(make_queue, line, code):
    host = Host(make_queue)
    host.to.write(line + "\n")
    answer = json.loads(host.back.readline())
    assert answer["error"]["code"] == code
    assert answer["id"] == (None if code in (-32700, -32600) else 1)
    host.end()


def test_a_line_too_long_is_passed_over(make_queue):
    to, back = io.StringIO(), io.StringIO()
    to.write('{"jsonrpc": "2.0", "id": 1, "x": "' + 3 * MOST_CHARACTERS * "x" + '"}\n')
    to.write('\ufeff{"jsonrpc": "2.0", "id": 2, "method": "health"}\n')
    to.seek(0)
    LineServer(lambda tell: make_queue(on_change=tell), None, to, back).run()
    first, second = map(json.loads, back.getvalue().splitlines())
    assert first["id"] is None and first["error"]["code"] == -32600
    assert second["id"] == 2 and second["result"]["status"] == "ok"


def test_an_id_at_work_is_not_answered_for_another(make_queue, case_folder, tmp_path, gate):
    gate.clear()
    host = Host(make_queue)
    for name in ("one", "two"):
        host.send(1, "reconstruct", **order(case_folder, tmp_path / name))
    assert "id 1 is in use" in host.answer(None)["error"]["message"]
    host.send(2, "cancel", id=1)
    assert host.answer(1)["error"]["code"] == 7
    host.end()


def test_a_host_that_no_longer_listens_ends_the_worker(make_queue):
    class Full(io.StringIO):
        def write(self, _):
            raise OSError(28, "no space")

    to = io.StringIO(2 * '{"jsonrpc": "2.0", "id": 2, "method": "health"}\n')
    LineServer(lambda tell: make_queue(on_change=tell), None, to, Full()).run()
    assert len(to.readlines()) == 1  # what followed is nobody's order any more


def test_notifications_are_never_answered(make_queue, case_folder, tmp_path, gate):
    gate.clear()
    host = Host(make_queue)
    host.send(1, "reconstruct", **order(case_folder, tmp_path / "out"))
    for method in ("health", "dance", "reconstruct"):
        host.notify(method)
    host.notify("reconstruct", **order(case_folder, tmp_path / "other"))
    host.send(2, "health")
    assert sum(host.answer(2)["result"]["jobs"].values()) == 1
    # To Python, true is 1.
    host.send(3, "cancel", id=True)
    assert host.answer(3)["result"] == {"cancelled": False}
    host.notify("cancel", id=1)
    assert host.answer(1)["error"]["code"] == 7
    host.notify("shutdown")
    host.thread.join(60)
    assert not host.thread.is_alive()
    answered = [message["id"] for message in host.seen if "method" not in message]
    assert answered == [2, 3, 1] and host.back.empty()


@pytest.mark.req("REQ-41")
def test_paths_are_held_to_the_folder_where_one_is_given(make_queue, case_folder, tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    host = Host(make_queue, AllowedFolder(folder))
    host.send(1, "reconstruct", **order(case_folder, tmp_path / "out"))
    assert host.answer(1)["error"]["code"] == -32602
    host.end()


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="POSIX limits")
@pytest.mark.req("REQ-41")
def test_a_job_that_needs_too_much_memory_fails_alone(good_case, tmp_path):
    """2^28 voxels are allowed and want several GiB; the worker, a process, may have two.

    Nothing but messages is on its stdout, and the end of its input ends it.
    """
    geometry = json.loads((good_case / "geom.json").read_text())
    huge = json.loads(json.dumps(geometry))
    huge["volume"]["shape"] = [640, 640, 640]
    views = [str(good_case / f"view{k}.png") for k in (1, 2)]
    lines = [b"\xff\xfe no text", b'{"jsonrpc": "2.0", "jsonrpc": "2.0"}']
    for number, scene in enumerate((huge, geometry)):
        order = {"views": views, "geometry": scene, "out": str(tmp_path / f"out{number}")}
        message = {"jsonrpc": "2.0", "id": number, "method": "reconstruct", "params": order}
        lines.append(json.dumps(message).encode())
    command = [sys.executable, "-m", "gcar_deploy.cli.main", "serve", "--stdio", "--predictor",
               "none", "--threads", "1", "--memory-mib", "2048"]  # fmt: skip
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    ) as worker:  # fmt: skip
        assert worker.stdin and worker.stdout
        worker.stdin.write(b"\n".join(lines) + b"\n")
        worker.stdin.flush()
        answers: dict[object, dict] = {}
        refused = 0
        for line in worker.stdout:
            message = json.loads(line)
            if message.get("method") == "progress":
                continue
            if message["id"] is None:
                refused += 1
            else:
                answers[message["id"]] = message
            if len(answers) == 2:
                break
        out, err = worker.communicate(timeout=120)
        assert worker.returncode == 0 and out == b"" and err == b""
    assert refused == 2
    assert "out of memory" in answers[0]["error"]["message"] and answers[0]["error"]["code"] == 1
    assert answers[1]["result"]["result"]["status"] in ("ok", "degraded")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out1"]


@pytest.mark.slow
def test_a_full_queue_is_said_and_keeps_no_copies(
    make_queue, case_folder, tmp_path, gate, monkeypatch
):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "private"))
    (tmp_path / "private").mkdir()
    folder = tmp_path / "folder"
    shutil.copytree(case_folder, folder)
    gate.clear()
    host = Host(
        lambda on_change: make_queue(on_change=on_change, most_waiting=1), AllowedFolder(folder)
    )
    names = {"views": ["view1.png", "view2.png"], "geometry": "geom.json"}
    host.send(0, "reconstruct", **names, out="out0")
    jobs, asked = {}, 0
    while jobs.get("running") != 1:
        asked += 1
        host.send(f"health {asked}", "health")
        jobs = host.answer(f"health {asked}")["result"]["jobs"]
    for number in range(1, 6):
        host.send(number, "reconstruct", **names, out=f"out{number}")
    refused = [host.answer(number)["error"] for number in range(2, 6)]
    assert {error["code"] for error in refused} == {-32000}
    assert "try again" in refused[-1]["message"]
    assert len(list((tmp_path / "private").iterdir())) == 2
    gate.set()
    assert "result" in host.answer(0) and "result" in host.answer(1)
    host.end()
    assert not list((tmp_path / "private").iterdir())

"""Runs sent by real storage clients become results; what is no run is turned away."""

from __future__ import annotations

import errno
import io
import json
import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pydicom", reason="needs the dicom extra")
pytest.importorskip("pynetdicom", reason="needs the listen extra")

import pydicom
from pydicom.uid import ExplicitVRLittleEndian, SecondaryCaptureImageStorage, generate_uid
from pynetdicom import AE

from gcar_deploy.cli.listen import listen
from gcar_deploy.dicom.header import CLASSIC
from gcar_deploy.errors import UsageError
from gcar_deploy.worker.jobs import JobQueue
from gcar_deploy.worker.listen import Listener, tell
from tests.dicom.files import classic, jpeg_lossless
from tests.dicom.made_result import named
from tests.worker.conftest import dcmtk

VERIFICATION = "1.2.840.10008.1.1"


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two X-ray pictures of a small tree as XA files of one study."""
    return named(tmp_path_factory.mktemp("runs"))


@pytest.fixture
def said():
    """What the listener says."""
    return []


@pytest.fixture
def listening(tmp_path, said):
    """(port, orders that came, out); the orders are not worked on."""
    orders, lines = [], []

    def work(order, on_progress, cancel):
        orders.append((order.out, [view.read_bytes() for view in order.views]))
        return {"status": "ok"}, order.out

    queue = JobQueue(work, on_change=tell(lines.append))
    listener = Listener(queue, tmp_path, title="GCAR", most_mib=1, say=said.append)
    yield listener.start(0), orders, lines, queue
    listener.stop()
    queue.close()


def associate(port, *kinds, title="GCAR"):
    entity = AE(ae_title="SENDER")
    for kind in kinds or (CLASSIC, VERIFICATION):
        entity.add_requested_context(kind, ExplicitVRLittleEndian)
    return entity.associate("127.0.0.1", port, ae_title=title)


def wait_for(queue, count, lines=None):
    """Until so many jobs have ended and, where they are given, as many lines said so."""
    end = time.monotonic() + 60
    while sum(queue.counts().get(s, 0) for s in ("done", "failed")) < count or (
        lines is not None and len(lines) < count
    ):
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_study_is_ordered_once_its_sender_lets_go(listening, runs, tmp_path):
    port, orders, lines, queue = listening
    study, files = runs
    link = associate(port)
    assert link.is_established and link.send_c_echo().Status == 0
    data = [pydicom.dcmread(file) for file in files]
    for one in (data[0], data[0], data[1]):
        assert link.send_c_store(one).Status == 0
    assert orders == []
    link.release()
    wait_for(queue, 1, lines)
    ((out, views),) = orders
    assert out == tmp_path / study and len(views) == 2
    assert [pydicom.dcmread(io.BytesIO(v)).PixelData for v in views] == [d.PixelData for d in data]
    assert json.loads(lines[0]) == {
        "study": study, "state": "done", "out": str(tmp_path / study), "status": "ok",
        "error": None, "exit_code": 0,
    }  # fmt: skip


def test_runs_that_come_one_by_one_and_a_folder_that_exists(listening, runs, said, tmp_path):
    port, orders, _, queue = listening
    study, files = runs
    (tmp_path / study).mkdir()
    for file in files:
        link = associate(port)
        assert link.send_c_store(pydicom.dcmread(file)).Status == 0
        link.release()
    wait_for(queue, 1)
    assert orders[0][0] == tmp_path / f"{study}-2"
    told = [line.removeprefix(f"study {study}: ").partition(",")[0] for line in said]
    assert told == [
        "run1 received", "1 of 2 runs; waits for more", "run2 received", "2 runs",
    ]  # fmt: skip


def test_what_waits_when_it_ends_is_said_to_be_dropped(runs, said, tmp_path):
    queue = JobQueue(lambda *_: None)
    listener = Listener(queue, tmp_path, title="GCAR", most_mib=1, say=said.append)
    study, (file, _) = runs
    link = associate(listener.start(0))
    assert link.send_c_store(pydicom.dcmread(file)).Status == 0
    link.release()
    listener.stop()
    queue.close()
    assert said[-1] == f"study {study}: 1 of 2 runs, dropped"
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_study_waits_for_its_own_sender(listening, runs):
    port, orders, _, queue = listening
    data = [pydicom.dcmread(file) for file in runs[1]]
    data.append(pydicom.dcmread(runs[1][0]))
    data[2].SOPInstanceUID = generate_uid()
    link, other = associate(port), associate(port)
    for one in data[:2]:
        assert link.send_c_store(one).Status == 0
    assert other.send_c_echo().Status == 0
    other.release()
    # Its end is handled after its release was answered.
    time.sleep(0.5)
    assert link.send_c_store(data[2]).Status == 0 and orders == []
    link.release()
    wait_for(queue, 1)
    assert [len(views) for _, views in orders] == [3]


@pytest.mark.slow
def test_two_orders_of_a_study_at_work_have_a_folder_each(runs, tmp_path):
    study, files = runs
    at_work, outs = threading.Event(), []

    def work(order, on_progress, cancel):
        at_work.wait(60)
        outs.append(order.out)
        return {"status": "ok"}, order.out

    queue = JobQueue(work)
    listener = Listener(queue, tmp_path, title="GCAR")
    port = listener.start(0)
    for _ in range(2):
        link = associate(port)
        for file in files:
            assert link.send_c_store(pydicom.dcmread(file)).Status == 0
        link.release()
    end = time.monotonic() + 60
    while sum(queue.counts().values()) < 2:
        assert time.monotonic() < end
        time.sleep(0.01)
    at_work.set()
    wait_for(queue, 2)
    listener.stop()
    queue.close()
    assert outs == [tmp_path / study, tmp_path / f"{study}-2"]


def test_a_run_that_could_not_be_written_is_none(listening, runs, monkeypatch):
    port, orders, _, queue = listening
    first, second = (pydicom.dcmread(file) for file in runs[1])
    link = associate(port)
    assert link.send_c_store(first).Status == 0

    def full(self, data):
        self.touch()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_bytes", full)
        for one in (first, second):
            assert link.send_c_store(one).Status == 0xA700
    assert link.send_c_store(second).Status == 0
    link.release()
    wait_for(queue, 1)
    assert [len(views) for _, views in orders] == [2]
    assert all(orders[0][1])


@pytest.mark.filterwarnings("ignore:Invalid value for VR UI")
def test_what_is_no_run_is_turned_away(listening, runs):
    port, orders, _, _ = listening
    assert not associate(port, title="SOMEONE").is_established
    assert not associate(port, SecondaryCaptureImageStorage).is_established
    link = associate(port)
    big = classic(np.zeros((1, 1200, 1200), np.uint8), StudyInstanceUID=generate_uid())
    assert link.send_c_store(big).Status == 0xA700
    assert link.send_c_store(classic()).Status == 0xA900
    crooked = pydicom.dcmread(runs[1][0])
    crooked.StudyInstanceUID = "../../etc"
    assert link.send_c_store(crooked).Status == 0xA900
    link.release()
    assert orders == []


def test_wrong_calls(tmp_path, listening):
    port, _, _, queue = listening
    with pytest.raises(UsageError, match="runs = 1"):
        Listener(queue, tmp_path, title="GCAR", runs=1)
    with pytest.raises(UsageError, match=f"port {port}"):
        Listener(queue, tmp_path, title="GCAR").start(port)


@pytest.mark.slow
def test_the_documented_storescu_sends_what_archives_keep(runs, tmp_path):
    """The line of the guide, with DCMTK's tool and runs in JPEG lossless."""
    pytest.importorskip("gdcm", reason="encodes JPEG lossless")
    tool = dcmtk("storescu")
    if tool is None:
        pytest.skip("no storescu of DCMTK")
    study, files = runs
    for number, file in enumerate(files, start=1):
        jpeg_lossless(file, tmp_path / f"run{number}.dcm")
    listener = subprocess.Popen(
        [sys.executable, "-m", "gcar_deploy.cli.main", "listen", "--out", tmp_path / "out",
         "--port", "0", "--predictor", "none", "--once"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert listener.stderr
    port = re.fullmatch(r"gcar: GCAR on 127\.0\.0\.1:(\d+)\n", listener.stderr.readline())
    assert port
    guide = (Path(__file__).parents[2] / "docs" / "host-guide.md").read_text(encoding="utf-8")
    (line,) = re.findall(r"storescu -xs .*\.dcm", guide)
    assert line in (listen.help or "")
    command = [tool, *line.replace("11112", port[1]).split()[1:]]
    sent = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert sent.returncode == 0, sent.stderr
    out, err = listener.communicate(timeout=300)
    assert listener.returncode == 0, err
    told = json.loads(out)
    assert told["study"] == study and told["state"] == "done", told
    assert (tmp_path / "out" / study / "report.html").is_file()

"""The way back to the archive: what arrives, and what is said where it does not."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest

pytest.importorskip("pydicom", reason="needs the dicom extra")
pytest.importorskip("pynetdicom", reason="needs the listen extra")

import pydicom
from pydicom.uid import (
    Comprehensive3DSRStorage,
    EncapsulatedSTLStorage,
    ExplicitVRLittleEndian,
    SecondaryCaptureImageStorage,
)
from pynetdicom import AE, evt

from gcar_deploy.errors import UsageError
from gcar_deploy.worker.send import Peer, parse_peer, sent_back
from tests.dicom.made_result import of_jane, result_of
from tests.worker.conftest import dcmtk
from tests.worker.test_listen import runs  # noqa: F401 - a fixture

pytest.importorskip("highdicom", reason="needs the sr extra")

ALL = (EncapsulatedSTLStorage, SecondaryCaptureImageStorage, Comprehensive3DSRStorage)


@pytest.fixture(scope="module")
def named_runs(tmp_path_factory):
    return of_jane(tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="module")
def folder(named_runs, tmp_path_factory):
    return result_of(named_runs, tmp_path_factory.mktemp("result") / "out")


def archive(kinds=ALL, status=0x0000):
    """A storage service: (server, what it got)."""
    got = []

    def store(event):
        data = event.dataset
        data.file_meta = event.file_meta
        got.append(data)
        return status

    entity = AE(ae_title="ARCHIVE")
    entity.require_called_aet = True
    for kind in kinds:
        entity.add_supported_context(kind, ExplicitVRLittleEndian)
    server = entity.start_server(
        ("127.0.0.1", 0), block=False, evt_handlers=[(evt.EVT_C_STORE, store)]
    )
    return server, got


def sent_to(server, folder, named_runs, title="ARCHIVE"):
    try:
        peer = Peer(title, "127.0.0.1", server.server_address[1])
        return sent_back(folder, named_runs, peer, "GCAR")
    finally:
        server.shutdown()


@pytest.mark.slow
def test_surface_and_overlays_arrive_in_the_study_of_the_pictures(folder, named_runs):
    server, got = archive()
    assert sent_to(server, folder, named_runs) == {"sent": 4, "send_error": None}
    source = pydicom.dcmread(named_runs[0])
    assert [data.SOPClassUID for data in got] == [ALL[0], ALL[1], ALL[1], ALL[2]]
    for data in got:
        for keyword in ("PatientName", "PatientID", "StudyInstanceUID", "StudyDate",
                        "AccessionNumber"):  # fmt: skip
            assert data[keyword].value == source[keyword].value
        assert "OperatorsName" not in data
        assert data.SeriesInstanceUID not in (source.SeriesInstanceUID, "")
    surface, first, second, _ = got
    stl = (folder / "surface.stl").read_bytes()
    assert surface.EncapsulatedDocument[: surface.EncapsulatedDocumentLength] == stl
    assert first.SeriesInstanceUID == second.SeriesInstanceUID != surface.SeriesInstanceUID
    for data, name in ((first, "overlay_view1.png"), (second, "overlay_view2.png")):
        shown = cv2.imread(str(folder / name), cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(data.pixel_array, shown[..., ::-1])
    assert len({data.SOPInstanceUID for data in got}) == 4


@pytest.mark.slow
def test_a_kind_that_the_peer_does_not_take_keeps_nothing_else_back(folder, named_runs):
    server, got = archive(kinds=ALL[1:])
    told = sent_to(server, folder, named_runs)
    assert told["sent"] == len(got) == 3
    assert re.fullmatch(r"ARCHIVE@127\.0\.0\.1:\d+ does not take Encapsulated STL Storage",
                        told["send_error"])  # fmt: skip


@pytest.mark.slow
def test_refusals_are_one_sentence(folder, named_runs):
    server, _ = archive(status=0xA700)
    told = sent_to(server, folder, named_runs)
    assert told["sent"] == 0 and told["send_error"].endswith(
        "refuses Encapsulated STL Storage (status 0xA700)"
    )
    server, got = archive()
    told = sent_to(server, folder, named_runs, title="SOMEONE")
    assert not got and told["send_error"].endswith("refuses the association")
    # Bound, not listening: nobody else can take the port meanwhile.
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        peer = Peer("ARCHIVE", "127.0.0.1", taken.getsockname()[1])
        assert sent_back(folder, named_runs, peer, "GCAR") == {
            "sent": 0, "send_error": f"{peer} cannot be reached"
        }  # fmt: skip


def test_a_result_that_cannot_be_read_back_is_said(tmp_path, named_runs):
    server, _ = archive()
    told = sent_to(server, tmp_path, named_runs)
    assert told["sent"] == 0 and "result.json" in told["send_error"]


@pytest.mark.parametrize(
    "text", ["host:104", "A@host", "A@host:0", "A@host:99999", "A B@host:104", "@host:104", "A@:1",
             "A" * 17 + "@host:104"],
)  # fmt: skip
def test_peers_that_are_none(text):
    with pytest.raises(UsageError, match="must be AET@HOST:PORT"):
        parse_peer(text)


def test_peers():
    assert parse_peer("PACS@10.0.0.7:104") == Peer("PACS", "10.0.0.7", 104)
    assert str(parse_peer("A-1@archive.local:11112")) == "A-1@archive.local:11112"


def started_archive(command, folder):
    """Start a storage service of another maker on a port that was free: (process, port)."""
    for _ in range(5):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        process = subprocess.Popen(
            [*command, "-od", str(folder), str(port)],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        end = time.monotonic() + 60
        while process.poll() is None and time.monotonic() < end:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    return process, port
            time.sleep(0.05)
        process.kill()
        process.wait()
    raise AssertionError("no storage service would start")


ARCHIVES = {"pynetdicom": [sys.executable, "-m", "pynetdicom", "storescp"],
            "dcmtk": [dcmtk("storescp")]}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("maker", ARCHIVES)
def test_from_storescu_to_storescp(runs, tmp_path, maker):  # noqa: F811
    study, files = runs
    command = ARCHIVES[maker]
    if command[0] is None:
        pytest.skip("no storescp of DCMTK")
    (tmp_path / "archive").mkdir()
    other, port = started_archive(command, tmp_path / "archive")
    try:
        listener = subprocess.Popen(
            [sys.executable, "-m", "gcar_deploy.cli.main", "listen", "--out", tmp_path / "out",
             "--port", "0", "--predictor", "none", "--once", "--send-to",
             f"ANY-SCP@127.0.0.1:{port}"],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        found = re.fullmatch(r"gcar: GCAR on 127\.0\.0\.1:(\d+)\n", listener.stderr.readline())
        sent = subprocess.run(
            [sys.executable, "-m", "pynetdicom", "storescu", "-cx", "-aec", "GCAR", "127.0.0.1",
             found[1], *map(str, files)],
            capture_output=True, text=True, timeout=120,
        )  # fmt: skip
        assert sent.returncode == 0, sent.stderr
        out, err = listener.communicate(timeout=300)
    finally:
        other.terminate()
        other.wait(60)
    told = json.loads(out)
    assert listener.returncode == 0, err
    assert told["study"] == study and told["state"] == "done", told
    assert (told["sent"], told["send_error"]) == (4, None), err
    assert [path.name for path in (tmp_path / "out").iterdir()] == [study]
    assert (tmp_path / "out" / study / "report.html").is_file()
    stored = [pydicom.dcmread(path) for path in (tmp_path / "archive").iterdir()]
    assert sorted(data.SOPClassUID for data in stored) == sorted([*ALL, ALL[1]])
    assert {data.StudyInstanceUID for data in stored} == {study}

"""The worker over real sockets: orders, files, cancelling, and everything that is refused."""

from __future__ import annotations

import contextlib
import dataclasses
import http.client
import json
import os
import socket
import time
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
import pytest

from gcar_deploy.worker.folder import AllowedFolder
from tests.worker.conftest import TOKEN, Client, multipart

ORDER = {"views": ["view1.png", "view2.png"], "geometry": "geom.json"}


def until(ask, wanted, seconds=120.0):
    end = time.monotonic() + seconds
    while (found := ask()) != wanted:
        assert time.monotonic() < end, f"still {found}"
        time.sleep(0.01)


def parts_of(case, options=None):
    parts = [("view", f"view{k}.png", (case / f"view{k}.png").read_bytes()) for k in (1, 2)]
    parts.append(("geometry", "geom.json", (case / "geom.json").read_bytes()))
    if options is not None:
        parts.append(("options", None, json.dumps(options).encode()))
    return parts


def test_files_of_the_folder_become_a_result_folder(serving):
    ask, folder = serving
    reply = ask("POST", "/v1/reconstruct?wait=60", {**ORDER, "out": "results/a"})
    assert reply.status == 200, reply.body
    job = reply.json()
    assert job["state"] == "done" and job["error"] is None and job["share"] == pytest.approx(1.0)
    assert job["out"] == str(folder / "results" / "a")
    stored = json.loads((folder / "results" / "a" / "result.json").read_text())
    assert stored.pop("files").keys() <= set(job["files"])
    assert stored == job["result"]
    again = ask("POST", "/v1/reconstruct?wait=60", {**ORDER, "out": "results/a"}).json()
    assert again["state"] == "failed" and again["error"]["exit_code"] == 2
    assert again["error"]["message"].startswith("results/a exists; ")
    assert "in an order force" in again["error"]["message"]
    (folder / "file").write_bytes(b"1")
    barred = ask("POST", "/v1/reconstruct?wait=60", {**ORDER, "out": "file/a"}).json()
    assert barred["error"]["message"] == "file/a cannot be made: file is not a folder"


def test_texts_name_paths_as_orders_do(tmp_path):
    folder = AllowedFolder(tmp_path)
    assert folder.inside(f"{tmp_path}/a{tmp_path}/b exists") == f"a{tmp_path}/b exists"
    assert folder.inside(f"x: {tmp_path} is not writable") == "x: the folder is not writable"
    assert folder.inside(f"{tmp_path}2/a exists") == f"{tmp_path}2/a exists"
    assert AllowedFolder(Path("/")).inside("2 / 3 of /a") == "2 / 3 of /a"


def test_uploads_are_fetched_and_forgotten(serving):
    ask, folder = serving
    body, kind = multipart(parts_of(folder, {"deadline_s": 50}))
    job = ask("POST", "/v1/reconstruct?wait=60", body, Content_Type=kind).json()
    assert job["state"] == "done", job
    place = f"/v1/jobs/{job['id']}"
    report = ask("GET", f"{place}/files/report.html")
    assert report.status == 200 and b"<!DOCTYPE html>" in report.body[:100]
    for name in ("view1.png", "..%2Fview1.png", "%2e%2e/view1.png", ".."):
        assert ask("GET", f"{place}/files/{name}").status == 404
    assert ask("DELETE", place).status == 204
    assert ask("GET", place).status == 404


def test_a_waiting_and_a_running_job_are_cancelled(serving, gate):
    ask, _ = serving
    gate.clear()
    first, second = (ask("POST", "/v1/reconstruct", ORDER) for _ in range(2))
    assert first.status == second.status == 202
    place = first.headers["Location"]
    until(lambda: ask("GET", place).json()["state"], "running")
    waiting = ask("GET", second.headers["Location"]).json()
    assert waiting["state"] == "queued" and waiting["ahead"] == 1
    assert ask("DELETE", second.headers["Location"]).json()["state"] == "cancelled"
    assert ask("DELETE", place).status == 202
    until(lambda: ask("GET", place).json()["state"], "cancelled")
    assert ask("GET", place).json()["error"]["exit_code"] == 7


def test_a_full_queue_says_when_to_come_back(serving, gate):
    ask, _ = serving
    gate.clear()
    running = ask("POST", "/v1/reconstruct", ORDER).headers["Location"]
    until(lambda: ask("GET", running).json()["state"], "running")
    assert [ask("POST", "/v1/reconstruct", ORDER).status for _ in range(2)] == [202, 202]
    full = ask("POST", "/v1/reconstruct", ORDER)
    assert full.status == 503 and full.headers["Retry-After"] == "2"


@pytest.mark.req("REQ-40")
def test_health_and_document_need_no_token_all_else_does(serving):
    ask, _ = serving
    for token in (None, "wrong", TOKEN + "x", ""):
        other = Client(ask.port, token)
        assert other("GET", "/health").json()["status"] == "ok"
        assert other("GET", "/openapi.json").status == 200
        for method, path in (
            ("POST", "/v1/reconstruct"), ("GET", "/v1/jobs/x"), ("DELETE", "/v1/jobs/x"),
            ("GET", "/v1/jobs/x/files/report.html"), ("GET", "/elsewhere"),
        ):  # fmt: skip
            reply = other(method, path)
            assert reply.status == 401 and reply.headers["WWW-Authenticate"] == "Bearer"


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example", "192.0.2.1", ""])
@pytest.mark.req("REQ-40")
def test_other_host_names_are_not_served(serving, host):
    ask, _ = serving
    reply = ask("GET", "/health", Host=host)
    assert reply.status in (400, 421)


@pytest.mark.req("REQ-40")
def test_web_pages_are_not_served(serving):
    ask, _ = serving
    assert ask("GET", "/health", Origin="http://127.0.0.1").status == 403


@pytest.mark.req("REQ-40")
def test_only_the_loopback_interface_listens(serving):
    ask, _ = serving
    table = Path("/proc/net/tcp")
    if not table.exists():
        pytest.skip("needs /proc")
    rows = [line.split() for line in table.read_text().splitlines()][1:]
    local = {row[1] for row in rows if row[3] == "0A" and int(row[1].split(":")[1], 16) == ask.port}
    assert local == {f"0100007F:{ask.port:04X}"}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"views": ["view1.png"]}, "1 entries"),
        ({"views": "view1.png"}, "list"),
        ({"views": ["view1.png", "../geom.json"]}, "inside"),
        ({"views": ["view1.png", "/etc/passwd"]}, "inside"),
        ({"views": ["view1.png", "a\\b"]}, "inside"),
        ({"views": ["view1.png", "absent.png"]}, "no such file"),
        ({"geometry": "link.json"}, "not allowed"),
        ({"views": ["view1.png", "linked/view2.png"]}, "not allowed"),
        ({"views": ["view1.png", "pipe"]}, "regular"),
        ({"views": ["view1.png", "."]}, "inside"),
        ({"out": "../a"}, "inside"),
        ({"out": "linked/a"}, "link"),
        ({"geometry": 3}, "geometry"),
        ({"deadline_s": -1}, "deadline_s = -1"),
        ({"deadline_s": "soon"}, "deadline_s"),
        ({"strict": "yes"}, "strict"),
        ({"forse": True}, "did you mean 'force'"),
        ({"masks": {"1": "../view1.png"}}, "inside"),
        ({"masks": {"1": "/etc/passwd"}}, "inside"),
        ({"masks": {"2": "linked/view2.png"}}, "not allowed"),
        ({"masks": {"3": "view1.png"}}, "views 1 .. 2"),
        ({"sod_mm": 76}, "sod_mm = 76.0 must be a number, 300 .. 5,000"),
    ],
)
@pytest.mark.req("REQ-41")
def test_orders_that_are_refused(serving, tmp_path, change, words):
    ask, folder = serving
    secret = tmp_path / "outside"
    secret.mkdir()
    (secret / "view2.png").write_bytes((folder / "view2.png").read_bytes())
    (folder / "linked").symlink_to(secret)
    (folder / "link.json").symlink_to(folder / "geom.json")
    os.mkfifo(folder / "pipe")
    reply = ask("POST", "/v1/reconstruct", {**ORDER, **change})
    assert reply.status == 400, reply.body
    message = reply.json()["error"]["message"]
    assert words in message and "\n" not in message
    assert sorted(p.name for p in secret.iterdir()) == ["view2.png"]


def test_what_gcar_run_would_refuse_is_told_with_its_exit_code(serving):
    ask, folder = serving
    geometry = json.loads((folder / "geom.json").read_text())
    geometry["views"][1]["sod_mm"] = 1
    job = ask("POST", "/v1/reconstruct?wait=60", {**ORDER, "geometry": geometry}).json()
    assert job["state"] == "failed" and job["error"]["exit_code"] == 4
    twice = {**ORDER, "views": ["view1.png", "view1.png"]}
    job = ask("POST", "/v1/reconstruct?wait=60", twice).json()
    assert job["state"] == "refused" and job["error"]["exit_code"] == 6


def test_pictures_without_a_geometry_are_told_so(serving):
    ask, folder = serving
    body, kind = multipart(parts_of(folder)[:2])
    job = ask("POST", "/v1/reconstruct?wait=60", body, Content_Type=kind).json()
    assert job["state"] == "failed" and job["error"]["exit_code"] == 2
    assert "geometry is needed" in job["error"]["message"]


def test_dicom_runs_bring_their_own_geometry(serving):
    """Uploads are told apart by their content and suffix; tiny ones may honestly be refused."""
    pytest.importorskip("pydicom")
    from tests.dicom.files import as_bytes, classic

    ask, _ = serving
    files = [
        ("view", f"IM{k}.dcm", as_bytes(classic(PositionerPrimaryAngle=str(angle))))
        for k, angle in enumerate((-30, 45))
    ]
    body, kind = multipart(files)
    job = ask("POST", "/v1/reconstruct?wait=60", body, Content_Type=kind).json()
    assert job["state"] in ("done", "refused"), job
    assert job["error"] is None or job["error"]["exit_code"] == 6


def test_runs_that_want_their_pixel_spacing_get_it(serving):
    """What the answer advises can be done by the same door."""
    pytest.importorskip("pydicom")
    from tests.dicom.files import tiny_runs

    ask, folder = serving
    files = [("view", path.name, path.read_bytes())
             for path in tiny_runs(folder, ImagerPixelSpacing=None)]  # fmt: skip
    body, kind = multipart(files)
    job = ask("POST", "/v1/reconstruct?wait=60", body, Content_Type=kind).json()
    assert job["state"] == "failed" and "pixel_spacing_mm" in job["error"]["message"]
    told = json.dumps({"pixel_spacing_mm": 1.6, "refiner": "none"}).encode()
    body, kind = multipart([*files, ("options", None, told)])
    job = ask("POST", "/v1/reconstruct?wait=60", body, Content_Type=kind).json()
    assert job["state"] == "done", job
    assert job["result"]["options"]["dicom"]["pixel_spacing_mm"] == 1.6
    assert job["result"]["refiner"] == "none"


@pytest.mark.slow
@pytest.mark.parametrize("way", ["upload", "folder"])
def test_a_mask_comes_with_the_order(serving, way):
    ask, folder = serving
    mask = cv2.imread(str(folder / "view1.png"), cv2.IMREAD_UNCHANGED)
    mask = np.where(mask > 0, 255, 0).astype(np.uint8)
    mask[: len(mask) // 2] = 0
    cv2.imwrite(str(folder / "m.png"), mask)
    if way == "folder":
        job = ask("POST", "/v1/reconstruct?wait=60", {**ORDER, "masks": {"1": "m.png"}}).json()
    else:
        parts = [*parts_of(folder), ("mask1", "m.png", (folder / "m.png").read_bytes())]
        body, kind = multipart(parts)
        job = ask("POST", "/v1/reconstruct?wait=60", body, Content_Type=kind).json()
    assert job["state"] in ("done", "refused"), job
    if job["state"] == "done":
        assert "view 1: the vessel mask is the user's" in job["result"]["notes"]
    else:
        assert job["error"]["exit_code"] == 6


def test_bad_bodies(serving):
    ask, folder = serving
    post = lambda body, kind: ask("POST", "/v1/reconstruct", body, Content_Type=kind)  # noqa: E731
    assert post(b"{", "application/json").status == 400
    assert post(b"", "text/plain").status == 400
    good = parts_of(folder)
    for parts, words in (
        (good[1:], "1 parts"),
        ([*good[:2], ("geometry", None, b"3")], "content of a geom.json"),
        ([*good, ("more", None, b"1")], "unknown part"),
        ([*good[:2], ("geometry", None, b"{")], "not JSON"),
        ([*good, ("options", None, b'{"views": []}')], "parts of their own"),
        ([*good, ("options", None, b'{"masks": {}}')], "parts of their own"),
        ([*good, ("options", None, b"[]")], "object"),
        ([*good, ("mask3", "m.png", b"x")], "views 1 .. 2"),
        ([*good, ("mask17", "m.png", b"x")], "unknown part"),
    ):
        body, kind = multipart(parts)
        reply = post(body, kind)
        assert reply.status == 400 and words in reply.json()["error"]["message"]
    assert ask("GET", "/v1/jobs/none?wait=x").status == 404
    assert ask("PUT", "/v1/reconstruct").status == 405


@pytest.mark.req("REQ-41")
def test_a_declared_flood_is_cut_before_it_is_read(serving):
    ask, _ = serving
    link = http.client.HTTPConnection("127.0.0.1", ask.port, timeout=60)
    link.putrequest("POST", "/v1/reconstruct")
    link.putheader("Authorization", f"Bearer {TOKEN}")
    link.putheader("Content-Length", str(2**40))
    link.endheaders()
    assert link.getresponse().status == 413
    link.close()


def test_a_worker_without_a_folder_takes_uploads_alone(make_queue, case_folder):
    from gcar_deploy.worker.http import create_app

    client = create_app(make_queue(), TOKEN).test_client()
    headers = {"Authorization": f"Bearer {TOKEN}"}
    reply = client.post("/v1/reconstruct", json=ORDER, headers=headers)
    assert reply.status_code == 400 and "uploads alone" in reply.get_json()["error"]["message"]
    body, kind = multipart(parts_of(case_folder, {"out": "a"}))
    reply = client.post("/v1/reconstruct", data=body, content_type=kind, headers=headers)
    assert reply.status_code == 400 and "--folder" in reply.get_json()["error"]["message"]


@pytest.mark.slow
def test_the_document_is_openapi_and_names_every_route(serving):
    validator = pytest.importorskip("openapi_spec_validator")
    ask, _ = serving
    document = ask("GET", "/openapi.json").json()
    validator.validate(document)
    assert set(document["paths"]) == {
        "/health", "/openapi.json", "/v1/reconstruct", "/v1/jobs/{id}",
        "/v1/jobs/{id}/files/{name}",
    }  # fmt: skip
    raw = resources.files("gcar_deploy.worker").joinpath("openapi.json").read_text()
    assert document["info"]["version"] != "__VERSION__" and "__VERSION__" in raw


def test_a_job_is_what_the_document_says(serving):
    jsonschema = pytest.importorskip("jsonschema")
    ask, _ = serving
    document = ask("GET", "/openapi.json").json()
    job = ask("POST", "/v1/reconstruct?wait=60", ORDER).json()
    schema = {"$ref": "#/components/schemas/Job", "components": document["components"]}
    jsonschema.validate(job, schema)


def slowly(port, header, *, seconds, wait_s=0.2):
    """Send a request's header, then a byte now and then; return when the worker hung up."""
    start = time.monotonic()
    with socket.create_connection(("127.0.0.1", port), 10) as link:
        link.sendall(header)
        link.settimeout(wait_s)
        while time.monotonic() - start < seconds:
            try:
                link.sendall(b"x")
                if not link.recv(1):
                    return time.monotonic() - start
            except TimeoutError:
                continue
            except OSError:
                return time.monotonic() - start
    return None


@pytest.mark.slow
def test_a_stranger_that_drips_is_hung_up_on_and_who_bears_the_token_is_not(serving, monkeypatch):
    ask, _ = serving
    monkeypatch.setattr("gcar_deploy.worker.loopback._STRANGERS_S", 1.0)
    head = b"POST /v1/reconstruct HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 1000\r\n"
    bearer = f"Authorization: Bearer {TOKEN}\r\n".encode()
    for strange in (b"POST / HTTP/1.1\r\nX: ", head + b"\r\n"):
        hung_up = slowly(ask.port, strange, seconds=20)
        assert hung_up is not None and hung_up > 0.9
    assert slowly(ask.port, head + bearer + b"\r\n", seconds=4) is None


def test_more_slow_strangers_than_threads_hold_nothing_up(serving):
    ask, _ = serving
    head = b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 1000\r\n\r\n"
    with contextlib.ExitStack() as links:
        for _ in range(80):
            link = socket.create_connection(("127.0.0.1", ask.port), 10)
            links.enter_context(link).sendall(head)
        start = time.monotonic()
        assert ask("GET", "/health").status == 200 and time.monotonic() - start < 5


def test_of_a_stranger_no_body_is_kept_and_it_reads_why(serving, monkeypatch):
    from waitress.buffers import OverflowableBuffer

    ask, _ = serving
    kept = []
    append = OverflowableBuffer.append
    monkeypatch.setattr(
        OverflowableBuffer, "append", lambda self, data: (kept.append(data), append(self, data))[1]
    )
    body = b"picture " * 2**16
    stranger = dataclasses.replace(ask, token=TOKEN[:-1])
    assert stranger("POST", "/v1/reconstruct", body).status == 401
    link = http.client.HTTPConnection("127.0.0.1", ask.port, timeout=60)
    link.request("POST", "/v1/reconstruct", iter([body]), encode_chunked=True,
                 headers={"Transfer-Encoding": "chunked"})  # fmt: skip
    assert link.getresponse().status == 401
    link.close()
    assert b"picture" not in b"".join(kept)
    assert ask("POST", "/v1/reconstruct", body, Content_Type="application/json").status == 400
    assert b"picture" in b"".join(kept)

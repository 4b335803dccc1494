"""Many cases: broken ones are rows, interrupted runs go on, a dead process names its case."""

from __future__ import annotations

import csv
import dataclasses
import html.parser
import json
import multiprocessing
import os
import signal
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from gcar_deploy.batch import pools, work
from gcar_deploy.batch.batch import run_batch
from gcar_deploy.batch.cases import read_cases as cases_of
from gcar_deploy.batch.summary import summary_csv, summary_html
from gcar_deploy.engine_choice import EngineChoice
from gcar_deploy.errors import UsageError
from gcar_deploy.inputs.order import Order
from tests.batch.dying import patient, suicidal
from tests.cli.conftest import gcar, good_case  # noqa: F401 - a fixture

ENGINE = EngineChoice(threads=1)
LIKE = Order(predictor="none")


def read_cases(table, like=LIKE):
    return cases_of(table, like)


@pytest.fixture
def table(good_case, tmp_path):  # noqa: F811 - the imported fixture
    """Six cases: two good, one picture twice, one picture missing, broken geometry, blank."""
    geometry = json.loads((good_case / "geom.json").read_text())
    geometry["views"][0]["sod_mm"] = 1
    (tmp_path / "bad.json").write_text(json.dumps(geometry))
    a, b, g = (good_case / name for name in ("view1.png", "view2.png", "geom.json"))
    lines = [
        "case,geom,view1,view2,view3",
        f"good-1,{g},{a},{b},",
        f"twice,{g},{a},{a},",
        f"missing,{g},{a},absent.png,",
        f"bad-geometry,bad.json,{a},{b},",
        f"three,{g},{a},{b},{b}",
        f"good-2,{g},{a},{b},",
    ]
    path = tmp_path / "cases.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8-sig")
    return path


@pytest.mark.slow
def test_broken_cases_are_rows_and_the_rest_is_done(table, tmp_path):
    out = tmp_path / "out"
    done = gcar("batch", table, "--out", out, "--predictor", "none", "--jobs", 2)
    assert done.code == 0, done.err
    rows = {row["case"]: row for row in csv.DictReader((out / "summary.csv").open())}
    assert list(rows) == ["good-1", "twice", "missing", "bad-geometry", "three", "good-2"]
    codes = {name: int(row["exit_code"]) for name, row in rows.items()}
    assert codes == {
        "good-1": 0, "twice": 6, "missing": 3, "bad-geometry": 4, "three": 4, "good-2": 0,
    }  # fmt: skip
    assert rows["missing"]["status"] == "failed" and "absent.png" in rows["missing"]["sentence"]
    assert (out / "good-1" / "report.html").is_file() and not (out / "twice").exists()
    assert not list((out / "rows").glob("*.running"))
    assert "4 failed" not in done.out and "3 failed" in done.out and "1 refused" in done.out


def rows_without_processes(monkeypatch, kill=()):
    """Cases run in this process; the names of those that ran."""
    ran = []

    def here(jobs, processes):
        for job in jobs:
            if job.case in kill:
                raise KeyboardInterrupt
            ran.append(job.case)
            yield work.run_case(job)

    monkeypatch.setattr("gcar_deploy.batch.batch.in_processes", here)
    return ran


@pytest.mark.slow
def test_an_interrupted_batch_goes_on(table, tmp_path, monkeypatch):
    cases, out = read_cases(table), tmp_path / "out"
    first = rows_without_processes(monkeypatch, kill=("missing",))
    with pytest.raises(KeyboardInterrupt):
        run_batch(cases, out, ENGINE)
    assert first == ["good-1", "twice"]
    told = [line.split(",")[0] for line in (out / "summary.csv").read_text().splitlines()]
    assert told == ["case", "good-1", "twice"]
    assert "2 of 6 cases: " in (out / "summary.html").read_text()
    second = rows_without_processes(monkeypatch)
    told = []
    rows = run_batch(cases, out, ENGINE, on_case=lambda *what: told.append(what[:2]))
    assert second == ["missing", "bad-geometry", "three", "good-2"]
    assert told == [(2, 6), (3, 6), (4, 6), (5, 6), (6, 6)]
    assert [row["case"] for row in rows] == [case.name for case in cases]
    third = rows_without_processes(monkeypatch)
    assert run_batch(cases, out, ENGINE) == rows and third == []
    again = rows_without_processes(monkeypatch)
    run_batch(cases, out, ENGINE, force=True)
    assert again == ["missing", "bad-geometry", "three"]


def test_a_changed_case_is_not_passed_off_as_the_old_one(table, tmp_path, monkeypatch):
    rows_without_processes(monkeypatch)
    cases = [case for case in read_cases(table) if case.name in ("twice", "bad-geometry")]
    rows = run_batch(cases, tmp_path / "out", ENGINE)
    assert run_batch(cases, tmp_path / "out", EngineChoice(threads=2)) == rows
    unrefined = read_cases(table, Order(predictor="none", refiner="none"))
    with pytest.raises(UsageError, match=r"'twice'.*--force"):
        run_batch([c for c in unrefined if c.name == "twice"], tmp_path / "out", ENGINE)
    (tmp_path / "bad.json").write_text("{}")
    with pytest.raises(UsageError, match="bad-geometry"):
        run_batch(cases, tmp_path / "out", ENGINE)


@pytest.mark.parametrize("role", ["model", "segmenter_model"])
def test_a_model_file_that_changed_is_another_engine(table, tmp_path, monkeypatch, role):
    rows_without_processes(monkeypatch)
    (case,) = (case for case in read_cases(table) if case.name == "missing")
    file = tmp_path / "mine.onnx"
    file.write_bytes(b"first")
    engine = EngineChoice(threads=1, **{role: str(file)})
    rows = run_batch([case], tmp_path / "out", engine)
    assert run_batch([case], tmp_path / "out", engine) == rows
    file.write_bytes(b"second")
    with pytest.raises(UsageError, match=r"'missing'.*--force"):
        run_batch([case], tmp_path / "out", engine)


def folder_case(tmp_path):
    """A case whose first view is a folder of frames, given as it lies on the disk now."""
    folder = tmp_path / "frames"
    folder.mkdir(exist_ok=True)
    path = tmp_path / "folder.csv"
    path.write_text("case,geom,view1,view2\na,g.json,frames,b.png\n")
    return read_cases(path)[0], folder


def test_only_what_changes_a_result_is_in_the_fingerprint(tmp_path):
    case, _ = folder_case(tmp_path)
    models = [tmp_path / name for name in ("a.onnx", "b.onnx")]
    for file in models:
        file.write_bytes(b"weights")
    a, b = (dataclasses.replace(ENGINE, model=file, threads=n) for n, file in enumerate(models, 1))
    assert case.fingerprint(a) == case.fingerprint(b) != case.fingerprint(ENGINE)
    models[1].write_bytes(b"others")
    assert case.fingerprint(a) != case.fingerprint(b)


def test_a_frame_that_changed_in_a_folder_is_noticed(tmp_path):
    case, folder = folder_case(tmp_path)
    seen = {case.fingerprint(ENGINE)}
    for change in (
        lambda: (folder / "1.png").write_bytes(b"first"),
        lambda: (folder / "1.png").write_bytes(b"other"),
        lambda: (folder / "1.png").rename(folder / "2.png"),
        lambda: (folder / "3.tif").write_bytes(b"first"),
    ):
        change()
        before = len(seen)
        seen.add(case.fingerprint(ENGINE))
        assert len(seen) == before + 1
    # No run reads these.
    (folder / "notes.txt").write_text("x")
    (folder / ".hidden.png").write_text("x")
    assert case.fingerprint(ENGINE) in seen


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="named pipes")
def test_pipes_and_devices_are_not_read(tmp_path):
    case, folder = folder_case(tmp_path)
    (folder / "1.png").write_bytes(b"x")
    before = case.fingerprint(ENGINE)
    os.mkfifo(folder / "2.png")
    assert case.fingerprint(ENGINE) != before
    os.mkfifo(tmp_path / "b.png")
    piped = case.fingerprint(ENGINE)
    (tmp_path / "b.png").unlink()
    (tmp_path / "b.png").symlink_to("/dev/zero")
    assert case.fingerprint(ENGINE) == piped


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_a_process_that_dies_costs_only_its_own_case(tmp_path, monkeypatch):
    monkeypatch.setattr(pools, "run_case", suicidal)
    jobs = [
        work.BatchJob(
            case=name, order=Order(), engine=EngineChoice(), marker=str(tmp_path / name),
            fingerprint="f",
        )
        for name in ("a", "killer", "b", "c")
    ]  # fmt: skip
    rows = {row["case"]: row for row in pools.in_processes(jobs, 2)}
    assert {name: row["status"] for name, row in rows.items()} == {
        "a": "ok", "killer": "failed", "b": "ok", "c": "ok",
    }  # fmt: skip
    assert "died" in rows["killer"]["sentence"]


def rows_of_interrupted(tmp_path, monkeypatch, *, times):
    """Interrupt a pool of one process once its second case runs; return rows and seconds."""
    monkeypatch.setattr(pools, "run_case", patient)
    names = ("a", "b", "c", "d")
    jobs = [
        work.BatchJob(
            case=name, order=Order(), engine=EngineChoice(), marker=str(tmp_path / name),
            fingerprint="stubborn" if times > 1 else "f",
        )
        for name in names
    ]  # fmt: skip
    begun = []

    def interrupt():
        while not (tmp_path / "b").exists():
            time.sleep(0.01)
        begun.append(time.monotonic())
        for _ in range(times):
            time.sleep(0.3)
            os.kill(os.getpid(), signal.SIGINT)

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    sender = threading.Thread(target=interrupt)
    sender.start()
    rows = []
    try:
        with pytest.raises(KeyboardInterrupt):
            rows.extend(row["case"] for row in pools.in_processes(jobs, 1))
    finally:
        sender.join()
        signal.signal(signal.SIGINT, handler)
    begun_cases = [name for name in names if (tmp_path / f"{name}.begun").exists()]
    return begun_cases, time.monotonic() - begun[0]


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("times", [1, 2])
def test_an_interrupt_ends_the_cases_and_begins_none(tmp_path, monkeypatch, times):
    begun, seconds = rows_of_interrupted(tmp_path, monkeypatch, times=times)
    assert begun == ["a", "b"] and seconds < 20
    end = time.monotonic() + 20
    while multiprocessing.active_children():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_second_batch_in_a_folder_is_refused_in_one_line(table, tmp_path, monkeypatch):
    (case,) = (case for case in read_cases(table) if case.name == "missing")
    out, refused = tmp_path / "out", []

    def meanwhile(jobs, processes):
        for job in jobs:
            Path(job.marker).touch()
            with pytest.raises(
                UsageError, match=rf"process {os.getpid()}\) is at work in"
            ) as caught:
                run_batch([case], out, ENGINE)
            refused.append(str(caught.value))
            # Nothing of the first is taken for what a dead one left.
            assert Path(job.marker).exists()
            yield work.run_case(job)

    monkeypatch.setattr("gcar_deploy.batch.batch.in_processes", meanwhile)
    rows = run_batch([case], out, ENGINE)
    assert len(refused) == 1 and rows[0]["exit_code"] == 3
    # Over, or dead: the folder is free again.
    (out / "rows" / "batch.lock").write_text("4194304\n")
    assert run_batch([case], out, ENGINE) == rows


def test_a_result_that_was_taken_away_is_made_again(table, tmp_path, monkeypatch):
    (case,) = (case for case in read_cases(table) if case.name == "good-1")
    out, ran = tmp_path / "out", []

    def made(jobs, processes):
        for job in jobs:
            ran.append(job.case)
            (out / job.case).mkdir(exist_ok=True)
            (out / job.case / "result.json").write_text("{}")
            yield {**work.error_row(job.case, "ok", "", 0), "fingerprint": job.fingerprint}

    monkeypatch.setattr("gcar_deploy.batch.batch.in_processes", made)
    for _ in range(2):
        run_batch([case], out, ENGINE)
    assert ran == ["good-1"]
    (out / "good-1" / "result.json").unlink()
    (out / "good-1").rmdir()
    run_batch([case], out, ENGINE)
    assert ran == ["good-1", "good-1"]


@pytest.mark.slow
def test_on_a_dask_cluster(table, tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    dask = pytest.importorskip("dask")
    # A busy machine is slow to start a cluster.
    monkeypatch.setattr(pools, "CONNECT_S", 240)
    cases = [case for case in read_cases(table) if case.name in ("good-1", "missing")]
    patience = dask.config.set({"distributed.comm.timeouts.connect": "240s"})
    with patience, distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tcp",
        dashboard_address=None, worker_dashboard_address=None,
    ) as cluster:  # fmt: skip
        rows = run_batch(
            cases, tmp_path / "out", ENGINE, pool=pools.Pool(scheduler=cluster.scheduler_address)
        )
    assert [row["exit_code"] for row in rows] == [0, 3]
    assert (tmp_path / "out" / "good-1" / "result.json").is_file()
    # What is done asks no cluster.
    gone = pools.Pool(scheduler="tcp://127.0.0.1:9")
    assert run_batch(cases, tmp_path / "out", ENGINE, pool=gone) == rows


def test_a_scheduler_that_is_not_there(table, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(pools, "CONNECT_S", 0.2)
    absent = pools.Pool(scheduler="tcp://127.0.0.1:9")
    with pytest.raises(UsageError, match="does not answer"):
        run_batch(read_cases(table), tmp_path / "o", ENGINE, pool=absent)
    assert not (tmp_path / "o").exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("1")
    with pytest.raises(UsageError, match="holds no batch"):
        run_batch(read_cases(table), tmp_path / "mine", ENGINE, pool=absent)
    done = gcar("batch", table, "--out", tmp_path / "p", "--engine", "dask")
    assert done.code == 2 and "--scheduler" in done.err


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "'case' is missing"),
        ("case,geom,view1\na,g,1\n", "'view1' and 'view2'"),
        ("case,geom,view1,view2\n", "0 cases"),
        ("case,geom,view1,view2,extra\na,g,1,2,3\n", "unknown column 'extra'"),
        (f"case,geom,view1,view2,{'x' * 5000}\na,g,1,2,3\n", f"'{'x' * 79} ..."),
        ("case,geom,view1,view2\na,g,1,2,3\n", "more fields"),
        ("case,geom,view1,view2\n../a,g,1,2\n", "line 2: case '../a'"),
        ("case,geom,view1,view2\nrows,g,1,2\n", "'rows'"),
        ("case,geom,view1,view2\na,g,1,2\nA,g,1,2\n", "line 3: case 'A' stands there twice"),
        ("case,geom,view1,view2\nSummary.csv.partial,g,1,2\n", "file of the batch itself"),
        ("case,geom,view1,view2\nbatch.json,g,1,2\n", "file of the batch itself"),
        ("case,geom,view1,view2,view2\na,g,1,2,3\n", "column 'view2' stands there twice"),
        ("case,geom,view1,view2\na,g,1,\n", "two or more views"),
        ("case,geom,view1,view2,view3\na,g,1,,3\n", "without a gap"),
    ],
)
def test_tables_that_are_refused(tmp_path, text, words):
    path = tmp_path / "cases.csv"
    path.write_text(text)
    with pytest.raises(UsageError, match=r"cases\.csv") as caught:
        read_cases(path)
    assert words in str(caught.value)


def test_nothing_of_the_users_is_touched(table, tmp_path):
    out = tmp_path / "mine"
    out.mkdir()
    (out / "thesis.txt").write_text("x")
    with pytest.raises(UsageError, match="holds no batch"):
        run_batch(read_cases(table), out, ENGINE)
    assert [p.name for p in out.iterdir()] == ["thesis.txt"]


def test_the_summary_page_fetches_nothing_and_runs_its_own_script_alone(tmp_path):
    rows = [
        {**work.error_row("a", "ok", "fine", 0), "length_mm": 12.5},
        work.error_row("b", "failed", "<script>alert(1)</script>", 1),
    ]
    (tmp_path / "a").mkdir()
    cv2.imwrite(str(tmp_path / "a" / "overlay_view1.png"), np.full((200, 100, 3), 90, np.uint8))
    page = summary_html(rows, tmp_path)
    tags = []

    class Reader(html.parser.HTMLParser):
        def handle_starttag(self, tag, attrs):
            tags.append((tag, dict(attrs)))

    Reader().feed(page)
    named = [value for _, attrs in tags for key, value in attrs.items() if key in ("src", "href")]
    assert sum(value.startswith("data:image/jpeg") for value in named) == 1
    assert [value for value in named if not value.startswith("data:")] == ["a/report.html"]
    assert [tag for tag, _ in tags].count("script") == 1 and "alert(1)" in page
    policy = next(a["content"] for t, a in tags if a.get("http-equiv"))
    assert "default-src 'none'" in policy and "unsafe" not in policy
    assert ">12<" in page and "1 failed, 1 ok" in page
    assert summary_csv(rows).splitlines()[1].startswith("a,ok,0,fine,")


def test_rows_travel_between_processes():
    import pickle

    job = work.BatchJob(
        case="a", order=Order(views=(Path("v"),), geometry=Path("g"), out=Path("o")),
        engine=EngineChoice(threads=1), marker=None, fingerprint="f",
    )  # fmt: skip
    assert pickle.loads(pickle.dumps(job)) == job  # noqa: S301

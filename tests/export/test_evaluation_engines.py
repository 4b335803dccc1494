"""The same rows wherever they are made: here, in processes, on a Dask cluster."""

import multiprocessing
import os
import sys

import pytest

from gcar_deploy.errors import UsageError
from gcar_export.evaluate import engines as evaluation_engines
from gcar_export.evaluate.evaluate import EvaluateOptions, evaluate
from gcar_export.methods.settings import MethodSettings
from tests.export.label_files import write_tree


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    folder = tmp_path_factory.mktemp("labels")
    for seed in (3, 4):
        write_tree(folder / f"{seed}.nii.gz", seed)
    return {"data": folder, "protocol": "paper", "methods": ("visual_hull",)}


def measures(rows):
    return [(row["case"], row["measures"]) for row in rows]


@pytest.fixture(scope="module")
def here(given, tmp_path_factory):
    out = tmp_path_factory.mktemp("here")
    return measures(evaluate(EvaluateOptions(**given, out=out)))


@pytest.mark.slow
def test_processes_make_the_same_rows(given, here, tmp_path):
    rows = evaluate(EvaluateOptions(**given, out=tmp_path, jobs=2))
    assert measures(rows) == here


@pytest.mark.slow
def test_an_interrupt_ends_the_workers_and_keeps_what_is_done(given, here, tmp_path):
    def stop(done, total, text):
        raise KeyboardInterrupt

    options = EvaluateOptions(**given, out=tmp_path, jobs=2)
    threads = {name: os.environ.get(name) for name in evaluation_engines.THREAD_VARIABLES}
    with pytest.raises(KeyboardInterrupt):
        evaluate(options, stop)
    assert threads == {n: os.environ.get(n) for n in evaluation_engines.THREAD_VARIABLES}
    assert not multiprocessing.active_children()
    assert len(list(tmp_path.glob("rows/*"))) == 1
    calls = []
    assert measures(evaluate(options, lambda *call: calls.append(call))) == here
    assert calls[0][2] == "1 rows kept"


@pytest.mark.slow
def test_a_dask_cluster_makes_the_same_rows(given, here, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, protocol="tcp://",
        host="127.0.0.1", dashboard_address=None,
    ) as cluster:  # fmt: skip
        options = EvaluateOptions(
            **given, out=tmp_path, engine="dask", scheduler=cluster.scheduler_address
        )
        assert cluster.scheduler_address.startswith("tcp://127.0.0.1:")
        calls = []
        rows = evaluate(options, lambda *call: calls.append(call))
        assert len(cluster.scheduler.tasks) == 0  # nothing is left behind
    assert measures(rows) == here
    assert [done for done, *_ in calls] == [1, 2]


@pytest.mark.slow
def test_a_scheduler_that_is_missing_is_one_line(given, tmp_path, monkeypatch):
    options = EvaluateOptions(**given, out=tmp_path, engine="dask")
    with pytest.raises(UsageError, match="--scheduler"):
        evaluate(options)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match=r"gcar\[dask\]"):
        list(evaluation_engines.run_on_dask([], MethodSettings(), "tcp://127.0.0.1:1"))


def test_a_scheduler_that_does_not_answer_is_one_line(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(evaluation_engines, "CONNECT_S", 1)
    for address in ("tcp://127.0.0.1:1", "nonsense://x"):
        with pytest.raises(UsageError, match="does not answer"):
            list(evaluation_engines.run_on_dask([], MethodSettings(), address))

"""One session for every network: named in the result, missed aloud, watched, and held to shapes."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from gcar_deploy import Engine
from gcar_deploy.config import ImagingOptions, PredictOptions, RunOptions
from gcar_deploy.errors import CancelledError, ModelError, NumericalError
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.net import KIND as SEGMENTER
from gcar_deploy.imaging.net import MISSING
from gcar_deploy.models import Session
from gcar_deploy.models import session as session_module
from gcar_deploy.models.spec import shipped_model_path
from gcar_deploy.predict.encoding import input_names
from gcar_deploy.predict.kinds import read_predictor
from gcar_deploy.selftest import tiny_case

TINY = Path(__file__).parents[1] / "data" / "tiny.onnx"
HULL = RunOptions(predict=PredictOptions(predictor="none"))


def raw_pair():
    """The self-test's tree as raw pictures of 8 bits: Beer's law, a wavy ground, a little noise."""
    angiograms, grid, _ = tiny_case()
    pair = []
    for seed, one in enumerate(angiograms):
        path = one.pixels * one.intensity.mm_per_count
        noise = np.random.default_rng(seed).normal(0, 1, path.shape)
        row, col = np.indices(path.shape) / path.shape[0]
        ground = 0.12 * np.sin(9 * row) * np.sin(25 * col)
        grey = (
            np.clip(160 * np.exp(-0.15 * path - ground) + noise, 0, 255).round().astype(np.float32)
        )
        pair.append(dataclasses.replace(one, pixels=grey, intensity=Intensity(kind="raw")))
    return pair, grid


@pytest.fixture(scope="module")
def raw():
    return raw_pair()


@pytest.mark.slow
def test_a_raw_pair_names_the_network_that_found_its_vessels(raw):
    summary = Engine(options=HULL, threads=1).reconstruct(*raw).summary()
    assert summary["segmenter"]["name"] == "segmenter"
    manifest = (shipped_model_path("segmenter").parent / "SHA256SUMS").read_text()
    assert f"{summary['segmenter']['sha256']}  segmenter.onnx" in manifest.splitlines()


@pytest.mark.slow
@pytest.mark.parametrize("case", ["path lengths", "masks", "classic", "even ground"])
def test_where_no_network_was_asked_none_is_named(case, raw):
    angiograms, grid = tiny_case()[:2] if case == "path lengths" else raw
    options = HULL
    if case == "masks":
        drawn = [a.pixels * a.intensity.mm_per_count > 0.3 for a in tiny_case()[0]]
        angiograms = [dataclasses.replace(a, mask=m) for a, m in zip(raw[0], drawn, strict=True)]
    if case == "even ground":
        angiograms = [
            dataclasses.replace(
                a,
                pixels=np.rint(200 - 20 * drawn.pixels * drawn.intensity.mm_per_count),
            )
            for a, drawn in zip(raw[0], tiny_case()[0], strict=True)
        ]
    if case == "classic":
        options = dataclasses.replace(HULL, imaging=ImagingOptions(segmenter="classic"))
    result = Engine(options=options, threads=1).reconstruct(angiograms, grid)
    assert result.summary()["segmenter"] is None and result.summary()["reasons"]["/segmenter"]
    assert MISSING not in result.quality.findings


@pytest.mark.slow
def test_a_missing_network_is_never_silent(raw, monkeypatch):
    there = shipped_model_path
    monkeypatch.setattr(
        "gcar_deploy.models.spec.shipped_model_path",
        lambda name: None if name == SEGMENTER.shipped else there(name),
    )
    result = Engine(threads=1).reconstruct(*raw)
    assert result.segmenter is None and result.status == "degraded"
    assert MISSING in result.quality.findings
    # Nobody was to ask it here.
    calibrated = Engine(threads=1).reconstruct(*tiny_case()[:2])
    assert calibrated.status == "ok" and MISSING not in calibrated.quality.findings


def slow(monkeypatch, seconds):
    """Let every inference of the segmenter take at least so long, as a large picture would."""
    run = Session._run

    def late(self, outputs, feed, options=None):
        end = time.monotonic() + seconds
        while self.model.kind == SEGMENTER.name and time.monotonic() < end:
            if getattr(options, "terminate", False):
                raise CancelledError("cancelled while the model ran")
            time.sleep(1e-3)
        return run(self, outputs, feed, options)

    monkeypatch.setattr(Session, "_run", late)


def test_a_running_segmenter_is_cancelled(raw, monkeypatch):
    """Asked from another thread, since inference holds the calling one."""
    monkeypatch.setattr(session_module, "WATCH_S", 1e-3)
    engine = Engine(options=HULL, threads=1)
    engine.reconstruct(*raw)  # the network is loaded
    askers, stage = set(), [""]

    def cancel():
        if stage[0] == "vessels":
            askers.add(threading.current_thread().name)
        return "gcar-watch" in askers

    with pytest.raises(CancelledError, match="by the caller"):
        engine.reconstruct(*raw, cancel=cancel, on_progress=lambda s, _: stage.__setitem__(0, s))
    assert stage[0] == "vessels"
    assert not any(t.name == "gcar-watch" for t in threading.enumerate())


def test_what_the_question_raises_is_raised_to_the_caller(raw, monkeypatch, capfd):
    """In the other thread it would be printed, and forgotten."""
    monkeypatch.setattr(session_module, "WATCH_S", 1e-3)
    engine = Engine(options=HULL, threads=1)
    engine.reconstruct(*raw)

    def cancel():
        if threading.current_thread().name == "gcar-watch":
            raise ConnectionError("the host is gone")
        return False

    with pytest.raises(ConnectionError, match="the host is gone"):
        engine.reconstruct(*raw, cancel=cancel)
    assert capfd.readouterr().err == ""


@pytest.mark.slow
def test_the_deadline_reaches_a_running_segmenter(raw, monkeypatch):
    engine = Engine(options=HULL, threads=1)
    engine.reconstruct(*raw)
    slow(monkeypatch, 20.0)
    start = time.monotonic()
    with pytest.raises(CancelledError, match=r"deadline of 0\.5 s"):
        engine.reconstruct(*raw, deadline_s=0.5)
    assert time.monotonic() - start < 5.0


class _Runtime:
    """Answers with what it was given."""

    def __init__(self, *answers):
        self.answers = list(answers)

    def run(self, outputs, feed, options):
        return self.answers


def session(*answers):
    untested = dataclasses.replace(read_predictor(TINY), golden=None)
    return Session(untested, input_names(), runtime=_Runtime(*answers))


def test_answers_are_held_to_shape_and_to_finite_numbers():
    good, more = np.zeros((2, 5)), np.full(3, np.nan)
    assert session(good, more).run({}, [(2, 5)]) == [good]  # only the first is asked for
    with pytest.raises(NumericalError, match=r"returned \(2, 5\) values, not \(5, 2\)"):
        session(good).run({}, [(5, 2)])
    for wrong in (np.nan, np.inf):
        bad = good.copy()
        bad[1, 4] = wrong
        with pytest.raises(NumericalError, match="tiny returned values that are not finite"):
            session(bad).run({}, [(2, 5)])


def test_memory_that_runs_out_is_no_fault_of_the_model(monkeypatch):
    class Full:
        def __init__(self, *args, **kwargs):
            pass

        def run(self, *args):
            raise RuntimeError("Failed to allocate memory for requested buffer of size 9")

    full = session()
    full._given = Full()
    with pytest.raises(RuntimeError, match="Failed to allocate"):
        full.run({}, [(1, 5)])

    def opened(*args, **kwargs):
        raise MemoryError("bad allocation")

    monkeypatch.setattr(session_module.ort, "InferenceSession", opened)
    with pytest.raises(MemoryError):
        Session(dataclasses.replace(read_predictor(TINY), golden=None), input_names())


def test_inputs_are_the_graphs_own():
    with pytest.raises(ModelError, match="has other inputs than this version gives"):
        Session(read_predictor(TINY), ["picture"])
    with pytest.raises(ModelError, match="model tiny fails: "):
        Session(read_predictor(TINY), input_names()).run({}, [(1, 5)])


def test_a_pinned_model_opens_while_the_caller_goes_on(monkeypatch):
    asked, open_ = threading.Event(), session_module._open

    def late(*args):
        assert asked.wait(20.0)
        return open_(*args)

    monkeypatch.setattr(session_module, "_open", late)
    pinned = dataclasses.replace(read_predictor(TINY), pinned=True)
    opening = Session(pinned, input_names())  # would wait for ever
    asked.set()
    assert opening.check_golden() < 1e-3


def test_a_pinned_model_that_does_not_open_says_so_when_it_is_run():
    broken = dataclasses.replace(read_predictor(TINY), pinned=True, data=b"no graph")
    opening = Session(broken, input_names())
    with pytest.raises(ModelError, match=r"^model tiny does not load"):
        opening.run({}, [(1, 5)])
    with pytest.raises(ModelError, match="model tiny does not load"):
        Session(dataclasses.replace(broken, pinned=False, golden=None), input_names())


def test_a_folder_for_a_model_is_one_sentence():
    with pytest.raises(ModelError, match=r"model file \.: is not a regular file"):
        read_predictor(Path("."))


@pytest.mark.parametrize(("told", "kept"), [(None, None), ("true", "true")])
def test_the_runtime_reports_nothing_and_the_environment_stays(told, kept, tmp_path):
    """A process of its own, with an empty home: it is as it was after a model ran."""
    environment = {k: v for k, v in os.environ.items() if k != "ORT_DISABLE_TELEMETRY"}
    environment["HOME"] = environment["XDG_CACHE_HOME"] = str(tmp_path)
    if told is not None:
        environment["ORT_DISABLE_TELEMETRY"] = told
    code = (
        "import os\nfrom gcar_deploy import Engine\nEngine(threads=1).warmup()\n"
        "print(os.environ.get('ORT_DISABLE_TELEMETRY'))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == str(kept)
    assert not list(tmp_path.iterdir())

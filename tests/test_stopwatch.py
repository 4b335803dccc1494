"""Deadlines and cancelling on a clock that the test turns."""

from __future__ import annotations

import types

import pytest

from gcar_deploy import Engine, RunOptions, stopwatch
from gcar_deploy.config import PredictOptions
from gcar_deploy.errors import CancelledError
from gcar_deploy.selftest import tiny_case
from gcar_deploy.stopwatch import Stopwatch


@pytest.fixture
def clock(monkeypatch):
    """Seconds that pass only when the test says so."""
    now = types.SimpleNamespace(s=100.0)
    monkeypatch.setattr(stopwatch, "time", types.SimpleNamespace(perf_counter=lambda: now.s))
    return now


def test_leaving_keeps_its_reserve_and_used_time_counts(clock):
    watch = Stopwatch((("a", 1.0),), deadline_s=10.0, used_s=2.0)
    stop = watch.leaving(3.0)
    assert watch.elapsed_s == 2.0 and not stop()
    clock.s += 4.9
    assert not stop() and not watch.late
    clock.s += 0.2
    assert stop() and not watch.late
    watch.require(2.8)
    with pytest.raises(CancelledError, match="leaves no time"):
        watch.require(3.0)
    clock.s += 3.0
    assert watch.late
    with pytest.raises(CancelledError, match="passed"):
        watch.require(0.0)


def test_without_a_deadline_there_is_all_the_time(clock):
    watch = Stopwatch((("a", 1.0),))
    clock.s += 1e9
    assert not watch.leaving(1e9)() and watch.question is None
    watch.require(1e9)


def test_asking_after_cancel_raises(clock):
    wishes = iter((False, True, True))
    watch = Stopwatch((("a", 1.0),), cancel=lambda: next(wishes))
    stop = watch.leaving(1.0)
    assert watch.question is not None and not stop()
    with pytest.raises(CancelledError, match="by the caller"):
        stop()


@pytest.mark.parametrize(
    ("deadline_s", "refiner", "words"),
    [(100.0, "tube", None), (2.0, "none", "no time to refine"), (1.5, None, "leaves no time")],
)
def test_what_is_done_with_the_time_that_is_left(clock, deadline_s, refiner, words):
    """One second has passed before the refinement; the shares of it say what still fits."""
    angiograms, grid, _ = tiny_case()
    engine = Engine(options=RunOptions(predict=PredictOptions(predictor="none")))

    def on_progress(stage, _):
        if stage == "refine" and clock.s < 101.0:
            clock.s = 101.0

    def call():
        return engine.reconstruct(angiograms, grid, deadline_s=deadline_s, on_progress=on_progress)

    if refiner is None:
        with pytest.raises(CancelledError, match=words):
            call()
        return
    result = call()
    assert result.refiner == refiner
    if words is not None:
        assert any(words in finding for finding in result.quality.findings)

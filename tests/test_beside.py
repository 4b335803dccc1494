"""Work beside other work: allowed only where asked for, and with the same outcome."""

import threading
import time

import numpy as np
import pytest

from gcar_deploy import reconstruct as composition
from gcar_deploy.beside import allowed_threads, side_by_side, started
from gcar_deploy.config import PredictOptions, RunOptions
from gcar_deploy.data.demo_case import demo_case
from gcar_deploy.engine import Engine
from gcar_deploy.selftest import tiny_case
from gcar_export.studies.hard_raw import raw_pair


def met():
    """Two works that end only if they run at the same time."""
    barrier = threading.Barrier(2, timeout=5)
    return [lambda k=k: (barrier.wait(), k)[1] for k in range(2)]


def test_two_threads_run_two_works_at_once_and_keep_their_order():
    with allowed_threads(2):
        assert side_by_side(met()) == [0, 1]
        first, second = met()
        wait = started(first)
        assert (second(), wait()) == (1, 0)


def test_without_leave_all_runs_in_the_calling_thread():
    def ran_in():
        return {*side_by_side([threading.get_ident] * 3), started(threading.get_ident)()}

    assert ran_in() == {threading.get_ident()}
    with allowed_threads(1):
        assert ran_in() == {threading.get_ident()}


def test_leave_ends_with_its_block_and_is_not_passed_on_to_threads():
    with allowed_threads(4):
        inner = side_by_side([lambda: side_by_side([threading.get_ident] * 2) for _ in range(2)])
    assert all(a == b for a, b in inner)
    assert set(side_by_side([threading.get_ident] * 2)) == {threading.get_ident()}


@pytest.mark.parametrize("count", [1, 2])
def test_what_a_work_raises_comes_through(count):
    def fails():
        raise ValueError("no")

    with allowed_threads(count):
        with pytest.raises(ValueError, match="no"):
            side_by_side([int, fails])
        with pytest.raises(ValueError, match="no"):
            started(fails)()


def test_no_work_goes_on_after_a_reconstruction_that_failed(monkeypatch):
    events = []

    def voxels(*args):
        time.sleep(0.3)
        events.append("voxels")

    def judged(*args, **kwargs):
        raise ZeroDivisionError

    monkeypatch.setattr(composition, "refined_volume", voxels)
    monkeypatch.setattr(composition, "judge", judged)
    options = RunOptions(predict=PredictOptions(predictor="none"))
    with pytest.raises(ZeroDivisionError):
        Engine(options=options, threads=2).reconstruct(*tiny_case()[:2])
    assert events == ["voxels"]


@pytest.mark.req("REQ-33")
@pytest.mark.slow
def test_a_reconstruction_is_the_same_on_one_thread_and_on_three():
    case = demo_case()
    one, three = (Engine(threads=n).reconstruct(case.pictures, case.geometry) for n in (1, 3))
    assert np.array_equal(one.volume, three.volume)
    for a, b in zip(one.tree.branches, three.tree.branches, strict=True):
        assert np.array_equal(a.points_mm, b.points_mm)
        assert np.array_equal(a.sigma_mm, b.sigma_mm)
        assert np.array_equal(a.radius_mm, b.radius_mm)


@pytest.mark.slow
def test_raw_pictures_are_read_the_same_one_after_the_other_and_at_once():
    pair = raw_pair(81_030, 1)
    one, two = (Engine(threads=n).reconstruct(pair.angiograms, pair.grid) for n in (1, 2))
    for a, b in zip(one.views, two.views, strict=True):
        assert a.view_id == b.view_id and a.by_network and b.by_network
        np.testing.assert_array_equal(a.mask, b.mask)
        np.testing.assert_array_equal(a.path_mm, b.path_mm)
    np.testing.assert_array_equal(one.tree.points(), two.tree.points())

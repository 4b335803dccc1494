"""A case on the desk: its pictures are those of its files and its order as they are now."""

from __future__ import annotations

import dataclasses
import hashlib
import os

import cv2
import numpy as np
import pytest

from gcar_deploy.config import PredictOptions, RunOptions
from gcar_deploy.engine import Engine
from gcar_deploy.errors import GcarError
from gcar_deploy.inputs.order import load_order
from gcar_deploy.workbench.desk import Desk
from tests.hard.phantoms import GRID, carm, paths, straight


@pytest.fixture
def desk(tmp_path):
    return Desk(tmp_path / "cases")


def test_a_run_that_was_replaced_is_read_anew(desk, tmp_path):
    path = tmp_path / "run.tif"
    case = desk.demo()
    case.order = dataclasses.replace(case.order, views=(path, path))
    for second, (count, grey) in enumerate(((3, 9), (3, 77), (5, 77))):
        pages = [np.full((32, 32), grey, np.uint8) + k for k in range(count)]
        new = tmp_path / "new.tif"
        cv2.imwritemulti(str(new), pages)
        os.utime(new, (second, second))  # clocks of files may be coarse
        new.replace(path)
        assert len(case.run_of(1)) == count and case.bare(1)[0, 0] == grey + count // 2
    path.unlink()
    with pytest.raises(GcarError):
        case.run_of(1)


def test_the_order_says_which_pictures_were_drawn_on(desk):
    case = desk.demo()
    assert "drawn_on" not in case.order.to_dict()
    case.correct({"ostia": [[[200, 200], [200, 200]]]})
    digests = [hashlib.sha256(path.read_bytes()).hexdigest() for path in case.ready_order.views]
    assert load_order(case.order_file).drawn_on == dict(enumerate(digests, start=1))
    case.correct({"ostia": None})
    assert "drawn_on" not in case.order.to_dict()


def test_a_request_gets_its_own_pictures_whatever_others_read_meanwhile(desk, monkeypatch):
    case = desk.demo()

    def other(found):
        case._read = "another order", ((), ["of another order"])

    monkeypatch.setattr(case, "_keep_pairs", other)
    assert len(case.angiograms()) == 2


@pytest.mark.slow
def test_what_was_found_is_shown_on_the_pixels_of_the_picture(desk):
    case = desk.demo()
    long = {"rows": 256, "columns": 128, "pixel_spacing_mm": (0.49, 0.98), "sdd_mm": 1299.0}
    pictures = paths(straight(radius=2.0), [carm(-30, -20, **long), carm(45, 25, **long)])
    engine = Engine(options=RunOptions(predict=PredictOptions(predictor="none")))
    result = engine.reconstruct(pictures, GRID, on_step=case.take_step)
    for shown, view in zip(case.vessels, result.views, strict=True):
        assert shown.carm.rows == 256 and shown.mask.shape == (256, 128)
        np.testing.assert_array_equal(shown.mask, view.mask)

"""A view that was taken for moved is named beside the result."""

from __future__ import annotations

import dataclasses

import pytest

from gcar_deploy.engine import Engine
from tests.hard.phantoms import GRID, PAIR, paths, seven


@pytest.fixture(scope="module")
def engine():
    return Engine(threads=1)


@pytest.mark.slow
def test_a_moved_patient_is_said_beside_the_result(engine):
    shown = [PAIR[0], PAIR[1].moved((0.0, 3.0, 3.0))]
    pictures = [
        dataclasses.replace(picture, carm=carm)
        for picture, carm in zip(paths(seven(), shown), PAIR, strict=True)
    ]
    notes = engine.reconstruct(pictures, GRID).notes
    assert [note for note in notes if "moved by" in note and "view " in note]
    assert not engine.reconstruct(paths(seven()), GRID).notes

"""Every hard case ends in its class, all numbers finite, and no ``ok`` is far beyond its bound."""

from __future__ import annotations

import numpy as np
import pytest

from gcar_deploy.engine import Engine
from tests.hard.cases import FAMILIES
from tests.hard.phantoms import GRID, distances, engine_without_model, everything_finite, outcome

CASES = [
    pytest.param(*case, *([GRID] if len(case) == 4 else []), id=f"{family}: {case[0]}")
    for family, make in FAMILIES.items()
    for case in make()
]
#: what the shipped predictor meets as well: families that end in ``ok``, and those that tempt it
WITH_MODEL = ("2 ", "3 ", "4 ", "5 ", "8 ", "9 ", "12 ", "13 ", "15 ", "23 ")
#: one variant of each family keeps the quick part honest
QUICK = [case for k, case in enumerate(CASES) if k % 12 == 0]


def check(found, allowed, truth):
    assert found.kind in allowed, found.sentence
    if found.result is None:
        return
    assert everything_finite(found.result)
    assert found.result.volume.min() >= 0 and found.result.volume.max() <= 1
    if found.kind != "ok" or truth is None:
        return
    error, sigma = distances(found.result.tree, truth)
    bound = 1.96 * np.sqrt(np.mean(sigma**2))
    assert np.sqrt(np.mean(error**2)) <= 3 * bound


def test_there_are_six_variants_of_every_family():
    for family, make in FAMILIES.items():
        cases = list(make())
        assert len(cases) == len({case[0] for case in cases}) == 6, family


@pytest.fixture(scope="module")
def bare():
    return engine_without_model()


@pytest.fixture(scope="module")
def shipped():
    engine = Engine(threads=1)
    if engine.model is None:
        pytest.skip("no model is installed")
    return engine


@pytest.mark.parametrize(("name", "make", "allowed", "truth", "grid"), QUICK)
def test_hard_case_of_each_kind(bare, name, make, allowed, truth, grid):
    check(outcome(make, bare, grid), allowed, truth)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "make", "allowed", "truth", "grid"), CASES)
def test_hard_case_without_a_model(bare, name, make, allowed, truth, grid):
    check(outcome(make, bare, grid), allowed, truth)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "make", "allowed", "truth", "grid"),
    [case for case in CASES if str(case.id).startswith(WITH_MODEL)],
)
def test_hard_case_with_the_shipped_predictor(shipped, name, make, allowed, truth, grid):
    check(outcome(make, shipped, grid), allowed, truth)

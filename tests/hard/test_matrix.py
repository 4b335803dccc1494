"""Every hard case ends in its class, all numbers finite, and an ``ok`` within its stated sigma."""

from __future__ import annotations

import numpy as np
import pytest

from gcar_deploy.engine import Engine
from tests.hard.cases import FAMILIES, TREE
from tests.hard.phantoms import (
    DONE,
    GRID,
    NOT_OK,
    PAIR,
    distances,
    engine_without_model,
    everything_finite,
    outcome,
    paths,
    told,
)

ARGUMENTS = ("make", "allowed", "truth", "grid")


def cases():
    """One parameter set per case."""
    out = []
    for family, make in FAMILIES.items():
        for name, *case in make():
            values = case if len(case) == len(ARGUMENTS) else (*case, GRID)
            out.append(pytest.param(*values, id=f"{family}: {name}"))
    return out


CASES = cases()
#: the quick part takes one of each family: the first that has a truth, or the first
QUICK = [
    min(
        (case for case in CASES if str(case.id).startswith(f"{family}: ")),
        key=lambda case: case.values[2] is None,
    )
    for family in FAMILIES
]


def check(found, allowed, truth):
    assert found.kind in allowed, found.sentence
    if found.result is None:
        return
    assert everything_finite(found.result)
    assert found.result.volume.min() >= 0 and found.result.volume.max() <= 1
    if found.kind == "ok":
        error, sigma = distances(found.result.tree, truth)
        bound = 1.96 * np.sqrt(np.mean(sigma**2))
        assert np.sqrt(np.mean(error**2)) <= bound


def test_six_variants_of_every_family_and_each_has_a_class_or_a_truth():
    for family, make in FAMILIES.items():
        made = list(make())
        assert len(made) == len({case[0] for case in made}) == 6, family
        for name, _, allowed, truth, *_ in made:
            assert ("ok" in allowed) == (truth is not None) or allowed <= NOT_OK, name
            assert allowed == DONE or allowed <= NOT_OK or allowed == {"error 4"}, name
    assert len(QUICK) == len(FAMILIES) == 19


@pytest.fixture(scope="module")
def bare():
    return engine_without_model()


@pytest.fixture(scope="module")
def shipped():
    engine = Engine(threads=1)
    if engine.model is None:
        pytest.skip("no model is installed")
    return engine


@pytest.mark.parametrize(ARGUMENTS, QUICK)
def test_hard_case_of_each_family(shipped, make, allowed, truth, grid):
    check(outcome(make, shipped, grid), allowed, truth)


@pytest.mark.slow
@pytest.mark.parametrize(ARGUMENTS, [case for case in CASES if case not in QUICK])
def test_hard_case(shipped, make, allowed, truth, grid):
    check(outcome(make, shipped, grid), allowed, truth)


def test_swapped_pictures_are_asked_for_by_name(bare):
    """Seven branches the wrong way round; other doubts would make the case degraded as well."""
    found = outcome(lambda: told(paths(TREE), PAIR[::-1]), bare)
    assert any("are the pictures swapped?" in text for text in found.result.quality.findings)


@pytest.mark.slow
@pytest.mark.parametrize(ARGUMENTS, CASES)
def test_without_a_model_nothing_is_ok(bare, make, allowed, truth, grid):
    """Depth from thinning alone is told as such: done means degraded."""
    check(outcome(make, bare, grid), {"degraded"} if allowed == DONE else allowed, truth)

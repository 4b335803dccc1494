"""Parts of a tree that hang on nothing."""

import numpy as np
import pytest

from gcar_deploy.tree.edit import with_branch
from gcar_deploy.tree.tree import empty_tree
from gcar_deploy.tubes.topology import _hanging, loose_mm
from tests.tree.shapes import fork


def _with_part(length_mm):
    base = fork()
    away = base.points().max(axis=0) + 40.0
    line = away + np.linspace(0.0, length_mm, 12)[:, None] * np.array([0.0, 0.0, 1.0])
    return base, with_branch(base, line, 0.8, 1.0, 0.5)


def test_what_hangs_on_nothing_is_measured_and_given_up():
    base, tree = _with_part(20.0)
    assert loose_mm(base) == 0.0
    assert loose_mm(tree) == pytest.approx(20.0)
    left = _hanging(tree)
    assert left.length_mm == pytest.approx(base.length_mm)
    assert len(left.branches) == len(base.branches)


def test_a_short_part_stays():
    _, tree = _with_part(5.0)
    assert _hanging(tree).length_mm == pytest.approx(tree.length_mm)


def test_no_tree_has_no_part():
    assert loose_mm(empty_tree()) == 0.0

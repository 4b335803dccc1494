"""Chains that meet in joints: the solver against dense matrices, however branches meet."""

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import TubeOptions
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.arrow import plan_of
from gcar_deploy.tubes.model import tubes_of
from gcar_deploy.tubes.prior import make_prior
from tests.tree.shapes import branch, fork

OPTIONS = TubeOptions()


def line(start, end, count):
    """(count, 3) from ``start`` to ``end`` with a bow in between."""
    t = np.linspace(0, 1, count)[:, None]
    bow = np.array([0.0, 3.0, 1.0]) * np.sin(np.pi * t)
    return np.asarray(start) + t * (np.asarray(end) - np.asarray(start)) + bow


def joined(*pieces):
    """Tree of (start node, end node, points) over nodes on a helix."""
    a = np.arange(6)
    nodes = np.stack([20 * np.cos(a), 20 * np.sin(a), 8.0 * a], axis=1)
    branches = [
        dataclasses.replace(
            branch(line(nodes[i], nodes[j], count), np.linspace(1.5, 1.0, count)), start=i, end=j
        )
        for i, j, count in pieces
    ]
    return Tree(nodes_mm=nodes, branches=tuple(branches))


TREES = {
    "one branch": joined((0, 1, 12)),
    "fork": fork(),
    "in a row, and one apart": joined((0, 1, 9), (1, 2, 7), (3, 4, 5)),
    "three at a joint, two points each": joined((0, 1, 2), (1, 2, 2), (1, 3, 2)),
    "a ring": joined((0, 1, 8), (1, 0, 9)),
    "a loop on one joint": joined((0, 0, 12), (0, 1, 6)),
}


def filled(tree, seed=0):
    """Hessian of a prior and of random positive blocks, and its dense twin."""
    tubes = tubes_of(tree)
    prior = make_prior(tubes, np.ones(len(tubes.log_radius)), OPTIONS)
    half = np.random.default_rng(seed).normal(size=(len(tubes.first), 8, 8))
    blocks = half @ np.swapaxes(half, 1, 2)
    dense = (prior.A.T @ prior.A).toarray()
    offset = 3 * len(tubes.positions_mm)
    for s, block in enumerate(blocks):
        a, b = tubes.first[s], tubes.second[s]
        at = np.concatenate(
            [
                3 * tubes.owner[a] + np.arange(3),
                3 * tubes.owner[b] + np.arange(3),
                [offset + a, offset + b],
            ]
        )
        np.add.at(dense, (at[:, None], at[None, :]), block)
    return tubes, prior.added(blocks), dense


@pytest.mark.parametrize("name", TREES)
def test_matrix_and_solution_are_those_of_the_dense_twin(name):
    _, arrow, dense = filled(TREES[name])
    assert np.allclose(arrow.dense(), dense, atol=1e-9 * np.abs(dense).max())
    right = np.random.default_rng(1).normal(size=len(dense))
    # Nodes that no branch ends on have no equation.
    used = np.diagonal(dense) > 0
    expected = np.linalg.solve(dense[np.ix_(used, used)], right[used])
    found = arrow.factorised().solve(right)[used]
    assert np.abs(found - expected).max() < 1e-9 * np.abs(expected).max()


def test_damping_grows_the_diagonal_alone():
    _, arrow, dense = filled(TREES["fork"])
    damped = arrow.damped(0.5, 0.25).dense() - dense
    assert np.allclose(damped, np.diag(0.5 * np.diagonal(dense) + 0.25))


def test_what_is_not_positive_definite_has_no_factor():
    _, arrow, _ = filled(TREES["fork"])
    for worse in (-1.0, np.nan):
        data = arrow.data.copy()
        data[0] = worse
        assert dataclasses.replace(arrow, data=data).factorised() is None


def test_numbers_grow_with_the_points_not_their_square():
    short, long = (plan_of(tubes_of(joined((0, 1, n), (1, 2, n), (1, 3, n)))) for n in (50, 500))
    assert long.border == short.border
    assert long.size < 11 * short.size

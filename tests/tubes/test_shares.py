"""Shares of a convex quadratic against scipy's bounded least squares, an independent solver."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from gcar_deploy.tubes.shares import best_shares


def value(gram, pull, shares):
    return 0.5 * shares @ gram @ shares - pull @ shares


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(1, 30),
    rows=st.integers(1, 40),
    twins=st.booleans(),
)
def test_as_good_as_bounded_least_squares(seed, count, rows, twins):
    rng = np.random.default_rng(seed)
    pictures = rng.exponential(size=(rows, count)) * (rng.random((rows, count)) < 0.4)
    if twins and count > 1:  # two pieces with the same pictures: a flat direction
        pictures[:, 1] = pictures[:, 0]
    data = pictures @ rng.uniform(-0.3, 1.3, count) + rng.normal(0, 0.1, rows)
    gram, pull = pictures.T @ pictures, pictures.T @ data
    found = best_shares(gram, pull, rng.random(count))
    best = lsq_linear(pictures, data, bounds=(0, 1), tol=1e-14, max_iter=1000).x
    assert ((found >= 0) & (found <= 1)).all()
    size = 1.0 + float(data @ data)
    assert value(gram, pull, found) <= value(gram, pull, best) + 1e-8 * size


def test_it_does_not_matter_where_one_begins():
    rng = np.random.default_rng(3)
    pictures = rng.exponential(size=(60, 25)) * (rng.random((60, 25)) < 0.3)
    pull = pictures.T @ (pictures @ rng.uniform(-0.3, 1.3, 25))
    gram = pictures.T @ pictures
    first = best_shares(gram, pull, np.zeros(25))
    np.testing.assert_allclose(best_shares(gram, pull, np.ones(25)), first, atol=1e-9)


def test_pieces_that_no_picture_shows_follow_their_price():
    np.testing.assert_array_equal(
        best_shares(np.zeros((2, 2)), np.array([1.0, -1.0]), np.full(2, 0.5)), [1.0, 0.0]
    )


def test_a_vessel_that_two_pieces_explain_is_shared():
    gram, pull = np.full((2, 2), 1000.0), np.full(2, 1000.0)
    assert best_shares(gram, pull, np.array([0.9, 0.9])).sum() == pytest.approx(1.0, abs=1e-6)

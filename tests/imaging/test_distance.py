"""Distances against SciPy's, which works in whole numbers, at several numbers of threads."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from gcar_deploy.imaging.distance import exact_distance


@pytest.fixture
def own_threads():
    before = cv2.getNumThreads()
    yield
    cv2.setNumThreads(before)


def test_every_number_of_threads_gives_the_nearest_float(own_threads):
    """OpenCV itself is off by a last digit, elsewhere with one thread than with two."""
    inside = np.random.default_rng(7).random((611, 437)) > 2e-4
    expected = np.sqrt(np.rint(distance_transform_edt(inside) ** 2)).astype(np.float32)
    for threads in (1, 2, 3, 8):
        cv2.setNumThreads(threads)
        assert np.array_equal(exact_distance(inside), expected)


def test_nothing_and_everything():
    assert not exact_distance(np.zeros((4, 5), bool)).any()
    assert np.all(exact_distance(np.ones((4, 5), bool)) > 1e6)

"""What is read off a matrix as it is loaded: skew, and few digits."""

import json

import numpy as np
import pytest

from gcar_deploy.errors import GeometryError
from gcar_deploy.geometry.scene import parse_scene
from tests.geometry.test_scene import FIRST, SCENE, changed, matrix_view


def skewed(P, share):
    """The matrix, its rows of pixels leaning by so much against the columns."""
    P = np.array(P)
    d = P[2, :3]
    P[1, :3] += share * (P[0, :3] - (P[0, :3] @ d) * d)
    return P.tolist()


def test_what_cannot_be_read_off_a_matrix_is_refused_at_once():
    carm = parse_scene(json.dumps(SCENE)).views[0].carm
    for share, fine in ((9e-4, True), (1.1e-3, False)):
        matrix = skewed(carm.world2pixel, share)
        for data in (matrix_view(projection_matrix=matrix)[1],
                     changed((*FIRST, "projection_matrix"), matrix)):  # fmt: skip
            if fine:
                parse_scene(json.dumps(data))
                continue
            with pytest.raises(GeometryError, match=r"g\.json: view 1: projection_matrix has sk"):
                parse_scene(json.dumps(data), "g.json")


def test_a_matrix_written_to_five_digits_is_read():
    carm = parse_scene(json.dumps(SCENE)).views[0].carm
    matrix = [[float(f"{x:.5g}") for x in row] for row in carm.world2pixel]
    X = np.array([[10.0, 20, -30]])
    for data in (matrix_view(projection_matrix=matrix)[1],
                 changed((*FIRST, "projection_matrix"), matrix)):  # fmt: skip
        other = parse_scene(json.dumps(data)).views[0].carm
        np.testing.assert_allclose(other.project(X)[0], carm.project(X)[0], atol=0.05)

"""Foreshortening of straight tubes has a closed form: 1 - sine of the angle to the beam."""

import numpy as np
import pytest

from gcar_deploy.tree.foreshortening import foreshortening
from gcar_deploy.tree.tree import empty_tree
from tests.geometry.test_epipolar import view
from tests.tree.shapes import tube


@pytest.mark.parametrize("angle", [0, 20, 60, 90])
def test_a_tube_at_an_angle_to_the_beam(angle):
    carm = view(20, 10)
    u, _, d = carm.axes
    along = np.cos(np.radians(angle)) * d + np.sin(np.radians(angle)) * u
    # Short, so that the beams are nearly parallel over it.
    found = foreshortening(tube(length=2.0, axis=along), carm)
    assert found == pytest.approx(1 - np.sin(np.radians(angle)), abs=2e-3)


def test_no_tree():
    assert foreshortening(empty_tree(), view(0)) is None

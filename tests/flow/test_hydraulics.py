"""Closed forms of a vessel against quadrature and against the formulae as printed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from gcar_deploy.flow.hydraulics import expansion_loss, expansions, piece_resistance
from tests.flow.trees import MU, RHO


def test_a_straight_pipe_is_poiseuille():
    found = piece_resistance(np.full(2, 1.5), np.array([40.0]), MU)
    assert found[0] == pytest.approx(8 * MU * 0.04 / (np.pi * 0.0015**4), rel=1e-12)


@pytest.mark.parametrize("ends", [(1.8, 1.1), (0.6, 1.4), (1.0, 1.0001)])
def test_taper_is_the_integral(ends):
    a, b = (1e-3 * r for r in ends)
    whole, _ = quad(lambda t: 8 * MU / np.pi * 0.03 / (a + t * (b - a)) ** 4, 0, 1)
    found = piece_resistance(np.array(ends), np.array([30.0]), MU)
    assert found[0] == pytest.approx(whole, rel=1e-9)


def test_more_points_on_the_same_cone_change_nothing():
    t = np.linspace(0, 1, 50)
    many = piece_resistance(2.0 - t, np.full(49, 30.0 / 49), MU).sum()
    assert many == pytest.approx(piece_resistance(np.array([2.0, 1.0]), np.array([30.0]), MU)[0])


def test_the_loss_is_young_and_tsai():
    """b = 1.52 rho / (2 A0^2) (A0 / As - 1)^2, as printed."""
    A0, As = np.pi * 0.0015**2, np.pi * 0.0006**2
    printed = 1.52 * RHO / (2 * A0**2) * (A0 / As - 1) ** 2
    assert expansion_loss(0.6, 1.5, RHO) == pytest.approx(printed, rel=1e-12)
    assert expansion_loss(1.5, 0.6, RHO) == 0.0


def test_each_narrowing_is_found_once_with_the_width_behind_it():
    s = np.linspace(0, 100, 401)
    radius = 1.5 - 0.9 * np.exp(-(((s - 30) / 4) ** 2)) - 0.6 * np.exp(-(((s - 70) / 4) ** 2))
    found = expansions(radius)
    assert [s[e.throat] for e in found] == pytest.approx([30, 70], abs=0.3)
    assert radius[[e.behind for e in found]] == pytest.approx([1.5, 1.5], abs=0.01)
    assert 30 < s[found[0].behind] < 70


def test_taper_and_ripples_are_no_narrowing():
    s = np.linspace(0, 100, 401)
    assert expansions(2.0 - 0.01 * s) == ()
    assert expansions(1.5 + 0.05 * np.sin(s)) == ()
    # What ends narrow has lost nothing yet.
    assert expansions(np.array([1.5, 1.4, 0.7, 0.6])) == ()

"""Closed forms of the two-view bound."""

import numpy as np
import pytest

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import triangulate
from gcar_deploy.geometry.observability import (
    RELATIVE_CUTOFF,
    curve_information,
    point_sigmas,
    worst_across,
)


def view(a, b=0.0, sod=765.0, sdd=1200.0, **kw):
    return CArm(
        primary_angle_deg=a,
        secondary_angle_deg=b,
        sod_mm=sod,
        sdd_mm=sdd,
        rows=512,
        columns=512,
        pixel_spacing_mm=(0.46, 0.46),
        **kw,
    )


def rmse_two_views(theta_deg):
    """The bound for two parallel beams, in units of the noise: sqrt(1/2 + 2 / sin^2 theta)."""
    return np.sqrt(0.5 + 2.0 / np.sin(np.deg2rad(theta_deg)) ** 2)


def curve_sigmas(carms, points_mm, tangents):
    """(n,) worst standard deviation across a vessel for 1 px of noise, mm."""
    return worst_across(sum(curve_information(carm, points_mm, tangents) for carm in carms))


def far(a):
    """Almost parallel beams, for the closed form."""
    return CArm(
        primary_angle_deg=a,
        secondary_angle_deg=0,
        sod_mm=5000,
        sdd_mm=8000,
        rows=512,
        columns=512,
        pixel_spacing_mm=(0.46, 0.46),
    )


@pytest.mark.parametrize("theta", [10, 20, 30, 45, 60, 90, 120, 150])
def test_rmse_of_the_isocentre_is_the_closed_form(theta):
    pair = [far(0), far(theta)]
    sigma, _ = point_sigmas(pair, np.zeros((1, 3)), sigma_px=1.0)
    s = pair[0].pixel_at_isocenter_mm
    assert np.sqrt((sigma**2).sum()) / s == pytest.approx(rmse_two_views(theta), rel=1e-6)
    # The worst axis: s / sqrt(1 - |cos theta|).
    worst = 1 / np.sqrt(1 - abs(np.cos(np.deg2rad(theta))))
    assert sigma.max() / s == pytest.approx(worst, rel=1e-6)


@pytest.mark.parametrize(
    ("theta", "expected"),
    [(90, 1.58), (60, 1.78), (45, 2.12), (30, 2.92), (20, 4.20), (10, 8.17), (5, 16.2), (1, 81)],
)
def test_table_of_bounds(theta, expected):
    assert rmse_two_views(theta) == pytest.approx(expected, rel=7e-3)


def test_opposite_views_know_nothing_on_the_axis_but_something_beside_it():
    pair = [view(0), view(180)]
    sigma, _ = point_sigmas(pair, np.array([[0.0, 0, 0], [50.0, 0, 0]]))
    assert not np.isfinite(sigma[0]).all() or sigma[0].max() > 1e4
    assert np.isfinite(sigma[1]).all()


def test_monte_carlo_agrees_with_the_bound():
    pair, rng = [view(-30, -20), view(45, 25)], np.random.default_rng(0)
    X = rng.uniform(-40, 40, (400, 3))
    noisy = [c.project(X)[0] + rng.normal(size=(400, 2)) for c in pair]
    error = triangulate(pair, noisy)[0] - X
    sigma, _ = point_sigmas(pair, X)
    ratio = np.sqrt(np.mean(np.sum(error**2, 1)) / np.mean(np.sum(sigma**2, 1)))
    assert 0.93 < ratio < 1.1


def test_vessel_in_the_epipolar_plane_and_along_the_beam():
    pair = [view(0), view(90)]
    X = np.zeros((3, 3))
    along_z, in_plane, down_beam = np.array([[0.0, 0, 1], [0.6, 0.8, 0], [0.0, -1, 0]])
    sigma = curve_sigmas(pair, X, np.stack([along_z, in_plane, down_beam]))
    s = pair[0].pixel_at_isocenter_mm
    assert sigma[0] == pytest.approx(s, rel=1e-6)
    assert np.isinf(sigma[1]) and np.isinf(sigma[2])


def test_the_worse_direction_is_an_eigenvalue():
    """Two measurements across each of 200 vessels; of 20 vessels the same one twice."""
    rng = np.random.default_rng(4)
    T = rng.normal(size=(200, 3))
    m = np.cross(T, rng.normal(size=(2, 200, 3)))
    m[1, :20] = m[0, :20]
    m[1, 20:40] = m[0, 20:40] + 0.1 * m[1, 20:40]
    information = np.einsum("vni,vnj->nij", m, m)
    found = worst_across(information)
    _, low, high = np.linalg.eigvalsh(information).T
    assert np.isinf(found[:20]).all() and np.isfinite(found).sum() > 160
    seen = low > RELATIVE_CUTOFF * high
    np.testing.assert_array_equal(np.isfinite(found), seen)
    np.testing.assert_allclose(found[seen], low[seen] ** -0.5, rtol=1e-6)


def test_curve_bound_is_the_closed_form():
    """sigma = s / sqrt(1 - |m1.m2|) for parallel beams."""
    rng = np.random.default_rng(2)
    pair = [far(0), far(60)]
    T = rng.normal(size=(50, 3))
    T /= np.linalg.norm(T, axis=1, keepdims=True)
    m = [np.cross(c.axes[2], T) for c in pair]
    m = [x / np.linalg.norm(x, axis=1, keepdims=True) for x in m]
    expected = 1 / np.sqrt(1 - np.abs(np.sum(m[0] * m[1], axis=1)))
    sigma = curve_sigmas(pair, np.zeros((50, 3)), T) / pair[0].pixel_at_isocenter_mm
    seen = np.isfinite(sigma)  # a view along the vessel is dropped
    assert seen.mean() > 0.9
    np.testing.assert_allclose(sigma[seen], expected[seen], rtol=1e-3)


def test_no_finite_bound_without_a_second_direction():
    """Two equal views know nothing of the depth; a vessel down both beams is not seen at all."""
    pair = [view(0), view(0)]
    sigma, axes = point_sigmas(pair, np.zeros((1, 3)))
    assert np.isinf(sigma[0, -1]) and abs(axes[0, -1] @ pair[0].axes[2]) == pytest.approx(1)
    assert np.isinf(curve_sigmas(pair, np.zeros((1, 3)), np.array([[0.0, -1, 0]]))).all()


@pytest.mark.parametrize(("theta", "median", "share"), [(90, 1.27, 0.09), (60, 1.57, 0.12)])
def test_random_tangents(theta, median, share):
    """Median of the sigma across the vessel, and the share above 5 s, for random directions."""
    T = np.random.default_rng(4).normal(size=(20000, 3))
    T /= np.linalg.norm(T, axis=1, keepdims=True)
    pair = [far(0), far(theta)]
    sigma = curve_sigmas(pair, np.zeros((len(T), 3)), T) / pair[0].pixel_at_isocenter_mm
    assert np.median(sigma) == pytest.approx(median, rel=0.03)
    assert np.mean(sigma > 5) == pytest.approx(share, abs=0.02)

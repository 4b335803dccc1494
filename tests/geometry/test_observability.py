"""Closed forms of the two-view bound, and the published sensitivities."""

import numpy as np
import pytest

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import (
    epipolar_lines,
    fundamental_matrix,
    plane_angles,
    triangulate,
)
from gcar_deploy.geometry.observability import (
    Observability,
    classes,
    curve_sigmas,
    geometry_sigmas,
    point_sigmas,
    rmse_two_views,
    silent_errors,
)

CORNERS = 50.0 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


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
    assert classes(sigma, s).tolist() == [
        Observability.GOOD,
        Observability.NONE,
        Observability.NONE,
    ]


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


def residual_and_error(told, true):
    pixels = [c.project(CORNERS)[0] for c in true]
    X, _ = triangulate(told, pixels)
    rms = np.sqrt(np.mean(np.sum((X - CORNERS) ** 2, axis=1)))
    s = told[0].pixel_at_isocenter_mm
    gap = [np.sum((c.project(X)[0] - p) ** 2, axis=1) for c, p in zip(told, pixels, strict=True)]
    return rms, s * np.sqrt(np.mean(gap))


@pytest.mark.parametrize(("theta", "rms"), [(90, 0.51), (60, 0.59), (30, 1.02)])
def test_a_degree_of_primary_angle_is_silent(theta, rms):
    told = [view(0), view(theta)]
    error, residual = residual_and_error(told, [told[0], told[1].turned(1.0)])
    # The table was drawn for random points; corners of the same cube lie further out.
    assert 0.8 * rms < error < 2.2 * rms
    assert residual < 0.05


@pytest.mark.parametrize("theta", [90, 60, 30])
def test_motion_along_the_rotation_axis_shows_and_in_plane_does_not(theta):
    told = [view(0), view(theta)]
    _, along = residual_and_error(told, [told[0], told[1].moved((0, 0, 5.0))])
    across, hidden = residual_and_error(told, [told[0], told[1].moved(5.0 * told[1].axes[0])])
    assert along > 1.5
    assert hidden < 0.2 * along and across > 3


def test_silent_errors_are_said():
    sentences = silent_errors([view(0), view(60)])
    assert len(sentences) == 2
    assert all("unseen in the pictures" in s and "mm at 60 deg" in s for s in sentences)


def test_geometry_prior_grows_as_views_close_up():
    X = np.zeros((1, 3))
    wide, close = (geometry_sigmas([view(0), view(t)], X)[0] for t in (90, 20))
    assert 0.5 < wide < close


def test_epipolar_lines_go_through_the_point():
    pair, rng = [view(-30, -20), view(45, 25)], np.random.default_rng(1)
    X = rng.uniform(-50, 50, (60, 3))
    (a, _), (b, _) = pair[0].project(X), pair[1].project(X)
    lines = epipolar_lines(*pair, a)
    assert np.abs(np.einsum("ij,ij->i", lines, np.column_stack([b, np.ones(60)]))).max() < 1e-8
    F = fundamental_matrix(*pair)
    assert abs(np.linalg.det(F)) < 1e-9
    np.testing.assert_allclose(
        plane_angles(*pair, pair[0], a), plane_angles(*pair, pair[1], b), atol=1e-12
    )

"""Vessel mass over epipolar planes: equal for one tree, whatever the views."""

import numpy as np
import pytest

from gcar_deploy.errors import GeometryError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.consistency import (
    HALF_BINS,
    disagreement,
    mass_profiles,
    match_rate,
    mismatch,
    uncovered_mm,
    vessel_mass,
)
from gcar_deploy.geometry.epipolar import plane_angles, plane_normal

SIZE = 256


def view(a, b, **kw):
    return CArm(
        primary_angle_deg=a,
        secondary_angle_deg=b,
        sod_mm=765,
        sdd_mm=1100,
        rows=SIZE,
        columns=SIZE,
        pixel_spacing_mm=(0.8, 0.8),
        **kw,
    )


PAIR = (view(-30, -20), view(45, 25))


def blobs(seed):
    return np.random.default_rng(seed).normal(scale=20, size=(25, 3))


def picture(carm, points):
    """Path length of equal balls, as small Gaussian spots of equal mass in mm^2 of the patient."""
    rows, cols = np.mgrid[:SIZE, :SIZE]
    out = np.zeros((SIZE, SIZE), np.float32)
    pixels, depth = carm.project(points)
    for (col, row), z in zip(pixels, depth, strict=True):
        width = 1.2 * carm.focal_px[0] / z
        out += np.exp(-0.5 * ((cols - col) ** 2 + (rows - row) ** 2) / width**2)
    out[out < 1e-4] = 0
    return out


def masses(first, second):
    return [vessel_mass(c, picture(c, p)) for c, p in zip(PAIR, (first, second), strict=True)]


def test_one_tree_agrees_and_two_do_not():
    same = disagreement(*masses(blobs(0), blobs(0)), PAIR[1], sigma_mm=0.5)
    other = disagreement(*masses(blobs(0), blobs(1)), PAIR[1], sigma_mm=0.5)
    assert same < 0.002 and other > 0.3


def test_depth_does_not_change_what_a_vessel_counts_for():
    """Balls near to one source and far from the other: only the exact weights make them equal."""
    towards = PAIR[0].axes[2]
    points = np.random.default_rng(5).normal(scale=8, size=(12, 3)) + 60 * towards
    first, second = (vessel_mass(c, picture(c, points), calibrated=True) for c in PAIR)
    a, b = mass_profiles(first, second, PAIR[1], 1.0)
    assert a.sum() == pytest.approx(b.sum(), rel=5e-3)
    assert mismatch(first, second, PAIR[1], 1.0) < 0.004
    plain = [float(m.path.sum() / m.carm.focal_px[0] ** 2) for m in (first, second)]
    assert abs(plain[0] / plain[1] - 1) > 0.05  # solid angle alone would not do


def test_an_angle_error_shows_in_exact_profiles():
    """A degree in the angle between the views leaves every point its rays, but not its mass."""
    points = blobs(2)
    first, second = (vessel_mass(c, picture(c, points), calibrated=True) for c in PAIR)
    told = [mismatch(first, second, PAIR[1].turned(d), 1.0) for d in (-1, 0, 1)]
    assert told[1] < 0.004 and min(told[0], told[2]) > 3 * told[1]


def test_profiles_are_shares_of_the_mass():
    a, b = mass_profiles(*masses(blobs(0), blobs(0)), PAIR[1], 0.5)
    assert a.shape == (2 * HALF_BINS + 1,) and a.min() >= 0
    assert a.sum() == pytest.approx(1, abs=1e-6) and b.sum() == pytest.approx(1, abs=1e-6)
    assert np.corrcoef(a, b)[0, 1] > 0.98


def test_scale_of_the_picture_does_not_matter():
    image = picture(PAIR[1], blobs(0))
    fixed = masses(blobs(0), blobs(0))[0]
    values = [disagreement(fixed, vessel_mass(PAIR[1], k * image), PAIR[1], 0.5) for k in (1, 700)]
    assert values[0] == pytest.approx(values[1], abs=1e-5)


def test_only_motion_across_the_planes_shows():
    """A patient who moved between the runs: along the normal it shows and is found again."""
    normal = plane_normal(*PAIR)
    within = np.cross(normal, PAIR[1].axes[2])
    across = masses(blobs(0), blobs(0) + 4 * normal)
    along = masses(blobs(0), blobs(0) + 4 * within)
    still = disagreement(*masses(blobs(0), blobs(0)), PAIR[1], 0.5)
    assert disagreement(*across, PAIR[1], 0.5) > still + 0.15
    assert disagreement(*along, PAIR[1], 0.5) < still + 0.02
    steps = np.arange(-8, 8.1, 1.0)
    values = [disagreement(*across, PAIR[1].moved(s * normal), 0.5) for s in steps]
    assert steps[int(np.argmin(values))] == 4.0
    assert min(values) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0.0, 2.0, -3.5])
def test_uncovered_length_is_twice_the_motion_of_one_bar_whatever_stands_behind_it(shift):
    """Of a bar moved along itself each end leaves ``shift`` mm that one view alone covers."""
    normal = plane_normal(*PAIR)
    steps = np.linspace(-20, 20, 161)[:, None]
    bar = steps * normal
    behind = bar[40:120] + 9 * PAIR[0].axes[2]  # hidden in the first view, beside it in the second
    both = np.concatenate([bar, behind])
    fixed, moving = masses(both, both + shift * normal)
    assert uncovered_mm(fixed, moving, PAIR[1]) == pytest.approx(2 * abs(shift), abs=0.75)
    assert uncovered_mm(fixed, moving, PAIR[1].moved(shift * normal)) <= 0.75


def test_no_vessel_is_none():
    assert vessel_mass(PAIR[0], np.zeros((SIZE, SIZE), np.float32)) is None


@pytest.mark.parametrize("b", [(0, 0), (180, 0)], ids=["same source", "face to face"])
def test_views_without_epipolar_planes_are_refused(b):
    first, second = view(0, 0), view(*b)
    with pytest.raises(GeometryError, match=r"epipolar planes|face each other"):
        plane_angles(first, second, first, np.zeros((1, 2)))


def test_match_rate_is_one_for_one_set_of_points_and_the_share_for_half_of_it():
    rng = np.random.default_rng(3)
    points = rng.uniform(-40, 40, (400, 3))
    a, b = (v.project(points)[0] for v in PAIR)
    assert match_rate(*PAIR, a, b, 0.05) == 1.0
    normal = plane_normal(*PAIR)
    upper = points @ normal > 0
    # Half of the planes hold no partner any more.
    assert match_rate(*PAIR, a, b[upper], 0.05) == pytest.approx(upper.mean(), abs=0.03)
    assert match_rate(*PAIR, a, b[:0], 0.05) is None

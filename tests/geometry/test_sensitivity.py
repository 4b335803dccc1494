"""What wrong geometry does to points, and what it betrays in the pictures.

Points fill a cube evenly, SOD 765, SDD 1200; the pair stands at +- theta / 2 and the last view (or
every view) is really elsewhere than told. Residuals are per coordinate, mm at the isocentre.
"""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import plane_normal, triangulate
from gcar_deploy.geometry.observability import silent_errors

SIDE = (np.arange(14) + 0.5) / 14 * 100 - 50
CUBE = np.stack(np.meshgrid(SIDE, SIDE, SIDE), -1).reshape(-1, 3)
PITCH = 0.46


def view(a, b=0.0, **kw):
    return CArm(
        primary_angle_deg=a,
        secondary_angle_deg=b,
        sod_mm=765.0,
        sdd_mm=1200.0,
        rows=512,
        columns=512,
        pixel_spacing_mm=(PITCH, PITCH),
        **kw,
    )


def effect(told, pixels, points):
    """Error of the points after and before the best rigid motion, and residual, rms in mm."""
    X, _ = triangulate(told, pixels)
    a, b = X - X.mean(0), points - points.mean(0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    turn = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    gaps = [c.project(X)[0] - p for c, p in zip(told, pixels, strict=True)]
    scale = told[0].pixel_at_isocenter_mm

    def rms(d):
        return np.sqrt(np.mean(np.sum(d**2, axis=1)))

    return rms(X - points), rms(a @ turn - b), scale * np.sqrt(np.mean(np.square(gaps)))


def last(change):
    return lambda pair: [pair[0], change(pair[1])]


def both(change):
    return lambda pair: [change(c) for c in pair]


def replaced(**kw):
    return lambda c: dataclasses.replace(c, **kw)


#: error of the geometry -> per separation: error, error after a rigid motion, residual, mm
ROWS = {
    "primary 1 deg": (
        last(lambda c: c.turned(1.0)),
        {90: (0.51, 0.36, 0.01), 60: (0.59, 0.46, 0.01), 30: (1.02, 0.94, 0.01)},
    ),
    "primary 5 deg": (
        last(lambda c: c.turned(5.0)),
        {90: (2.54, 1.79, 0.05), 60: (2.94, 2.29, 0.04), 30: (5.09, 4.71, 0.04)},
    ),
    "secondary 1 deg": (
        last(lambda c: c.turned(0.0, 1.0)),
        {90: (0.25, 0.18, 0.18), 60: (0.25, 0.18, 0.18), 30: (0.26, 0.18, 0.18)},
    ),
    "secondary 5 deg": (
        last(lambda c: c.turned(0.0, 5.0)),
        {90: (1.27, 0.90, 0.89), 60: (1.27, 0.90, 0.89), 30: (1.27, 0.90, 0.89)},
    ),
    "5 mm along the rotation axis": (
        last(lambda c: c.moved((0, 0, 5.0))),
        {90: (2.51, None, 1.77), 60: (2.50, None, 1.77), 30: (2.50, None, 1.77)},
    ),
    "5 mm in the plane": (
        last(lambda c: c.moved((5.0, 0, 0))),
        {90: (3.53, 0.23, 0.00), 60: (4.98, 0.32, 0.00), 30: (9.56, 0.62, 0.00)},
    ),
    "10 mm off the isocentre, both": (
        both(lambda c: c.moved((10.0, 0, 0))),
        {90: (10, 0, 0), 60: (10, 0, 0), 30: (10, 0, 0)},
    ),
    "SDD 3 %": (
        last(replaced(sdd_mm=1236.0)),
        {90: (0.96, 0.96, 0.31), 60: (1.09, 1.03, 0.31), 30: (1.79, 1.44, 0.31)},
    ),
    "SOD 30 mm, both": (
        both(replaced(sod_mm=795.0)),
        {90: (1.89, 1.89, 0.0), 60: (1.89, 1.89, 0.0), 30: (1.89, 1.89, 0.0)},
    ),
    "pixel spacing 3 %, both": (
        both(replaced(pixel_spacing_mm=(PITCH / 1.03,) * 2)),
        {90: (1.50, 1.50, 0.02), 60: (1.50, 1.50, 0.02), 30: (1.50, 1.50, 0.02)},
    ),
}


@pytest.mark.parametrize("name", ROWS)
@pytest.mark.parametrize("theta", [90, 60, 30])
def test_sensitivity_table(name, theta):
    change, expected = ROWS[name]
    told = [view(-theta / 2), view(theta / 2)]
    pixels = [c.project(CUBE)[0] for c in change(told)]
    for found, value in zip(effect(told, pixels, CUBE), expected[theta], strict=True):
        if value is not None:
            # The table's rounding, and that it was drawn from finitely many points.
            assert found == pytest.approx(value, abs=0.02, rel=0.015)


def flipped_lr(pixels):
    return np.column_stack([511 - pixels[:, 0], pixels[:, 1]])


def flipped_ud(pixels):
    return np.column_stack([pixels[:, 0], 511 - pixels[:, 1]])


def same(told):
    return told


#: mistake -> (pictures as read, geometry as told, error, residual); two views 60 deg apart
MISTAKES = {
    "both flipped left-right": (lambda p: [flipped_lr(x) for x in p], same, 64, 2.9),
    "both flipped upside down": (lambda p: [flipped_ud(x) for x in p], same, 46, 2.8),
    "both turned by 180 deg": (lambda p: [flipped_lr(flipped_ud(x)) for x in p], same, 80, 0.5),
    "cranial for caudal": (
        same,
        both(lambda c: dataclasses.replace(c, secondary_angle_deg=-c.secondary_angle_deg)),
        4.1,
        2.8,
    ),
    "LAO for RAO": (
        same,
        both(lambda c: dataclasses.replace(c, primary_angle_deg=-c.primary_angle_deg)),
        45.7,
        2.9,
    ),
    "centre off by 2 px": (same, both(replaced(principal_point_px=(257.5, 255.5))), 0.7, 0.02),
    "aspect 1.1 ignored": (same, both(replaced(pixel_spacing_mm=(1.1 * PITCH, PITCH))), 2.3, 0.14),
    "transposed": (lambda p: [x[:, ::-1] for x in p], same, 55, 8.0),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_orientation_mistakes(name):
    """Some leave hardly a residual: no picture can replace a statement of the orientation."""
    read, tell, error, residual = MISTAKES[name]
    true, points = [view(0), view(60, 10)], 0.8 * CUBE
    found = effect(tell(true), read([c.project(points)[0] for c in true]), points)
    assert found[0] == pytest.approx(error, rel=0.03, abs=0.05)
    assert found[2] == pytest.approx(residual, rel=0.05, abs=0.03)


def test_silent_errors_are_said_with_their_effect():
    sentences = silent_errors([view(-30), view(30)])
    for start, effect_mm in (
        ("1 deg in the angle between", "0.6"),
        ("a patient 5 mm off", "5.8"),
        ("30 mm in the source distance", "1.9"),
        ("3 % in the pixel spacing", "1.5"),
    ):
        (one,) = [s for s in sentences if s.startswith(start)]
        assert f"by {effect_mm} mm at 60 deg, unseen in the pictures" in one


@pytest.mark.parametrize(
    "pair", [(view(-30, -20), view(45, 25)), (view(0), view(60)), (view(-90), view(180, 90))]
)
def test_what_is_called_silent_is_silent_at_any_angle(pair):
    """Turn or move the last view within the plane of the beams, as the sentences say."""
    said = silent_errors(pair)
    normal = plane_normal(*pair)
    P, turn = pair[1].world2pixel, Rotation.from_rotvec(np.deg2rad(1) * normal).as_matrix()
    swung = CArm.from_matrix(np.column_stack([P[:, :3] @ turn, P[:, 3]]), rows=512, columns=512)
    for start, last_view in (
        ("1 deg", swung),
        ("a patient", pair[1].moved(5 * np.cross(normal, pair[1].axes[2]))),
    ):
        pixels = [pair[0].project(CUBE)[0], last_view.project(CUBE)[0]]
        error, _, residual = effect(pair, pixels, CUBE)
        (sentence,) = [s for s in said if s.startswith(start)]
        assert f"by {error:.1f} mm" in sentence
        assert residual < 0.05 * error


@pytest.mark.parametrize("digits", [5, 16])
def test_a_matrix_beside_angles_changes_nothing_of_what_is_silent(digits):
    """Also where it is a little skewed, and where the table has moved along the beam."""
    pair = [view(-30), view(30, isocenter_offset_mm=(-250.0, 433.0, 0.0))]
    beside = []
    for carm in pair:
        P = np.array(carm.world2pixel)
        P[1, :3] += 2e-4 * (P[0, :3] - (P[0, :3] @ P[2, :3]) * P[2, :3])
        beside.append(replaced(projection_matrix=[[float(f"{x:.{digits}g}") for x in row]
                                                  for row in P])(carm))  # fmt: skip
    assert silent_errors(beside) == silent_errors(pair)


def test_a_third_view_sees_motion_in_the_plane():
    sentences = silent_errors([view(0), view(45), view(90)])
    assert not any(s.startswith(("1 deg", "a patient")) for s in sentences)
    assert any("source distance" in s for s in sentences)

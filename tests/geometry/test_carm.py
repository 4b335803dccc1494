"""CArm against golden vectors, closed forms, and its own inverse."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gcar_deploy.errors import GeometryError
from gcar_deploy.geometry.carm import CArm, separation_deg

GOLDEN = json.loads((Path(__file__).parents[1] / "data" / "projections.json").read_text())["cases"]
CORNERS = 50.0 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


def made(view):
    return CArm(**{k: tuple(v) if isinstance(v, list) else v for k, v in view.items()})


@pytest.mark.parametrize("case", GOLDEN, ids=range(len(GOLDEN)))
@pytest.mark.req("REQ-01")
def test_golden_projections(case):
    points = np.array(case["points_lps_mm"])
    pixels, depth = made(case["view"]).project(points)
    np.testing.assert_allclose(pixels, case["pixels_col_row"], atol=1e-4)
    np.testing.assert_allclose(depth, case["depth_mm"], atol=1e-4)


@pytest.mark.parametrize("case", GOLDEN, ids=range(len(GOLDEN)))
def test_matrix_alone_is_the_same_view(case):
    carm = made(case["view"])
    other = CArm.from_matrix(case["projection_matrix"], rows=carm.rows, columns=carm.columns)
    points = np.array(case["points_lps_mm"])
    np.testing.assert_allclose(other.project(points)[0], carm.project(points)[0], atol=1e-4)
    assert other.primary_angle_deg == pytest.approx(carm.primary_angle_deg, abs=1e-6)
    assert other.secondary_angle_deg == pytest.approx(carm.secondary_angle_deg, abs=1e-6)
    np.testing.assert_allclose(other.source_mm, carm.source_mm, atol=1e-5)


@pytest.mark.req("REQ-01")
def test_contract_example():
    carm = CArm(
        primary_angle_deg=30,
        secondary_angle_deg=25,
        sod_mm=750,
        sdd_mm=1050,
        rows=512,
        columns=512,
        pixel_spacing_mm=(0.2, 0.2),
    )
    pixels, depth = carm.project(np.array([[10.0, -20.0, 30.0]]))
    np.testing.assert_allclose(pixels[0], (246.516, 136.431), atol=5e-4)
    assert depth[0] == pytest.approx(782.908, abs=5e-4)


BASE = {
    "sod_mm": 765.0,
    "sdd_mm": 1100.0,
    "rows": 480,
    "columns": 512,
    "pixel_spacing_mm": (0.38, 0.4),
}
arms = st.builds(
    lambda a, b, g, c, r, x, y, z: CArm(
        primary_angle_deg=a,
        secondary_angle_deg=b,
        detector_rotation_deg=g,
        principal_point_px=(c, r),
        isocenter_offset_mm=(x, y, z),
        **BASE,
    ),
    st.floats(-170, 170),
    st.floats(-80, 80),
    st.floats(-90, 90),
    st.floats(200, 300),
    st.floats(200, 300),
    st.floats(-10, 10),
    st.floats(-10, 10),
    st.floats(-10, 10),
)
points = st.lists(st.tuples(*[st.floats(-70, 70)] * 3), min_size=1, max_size=5).map(np.array)


@settings(max_examples=60, deadline=None)
@given(arms, points)
def test_backproject_undoes_project_and_rays_hit(carm, X):
    pixels, depth = carm.project(X)
    np.testing.assert_allclose(carm.backproject(pixels, depth), X, atol=1e-8)
    rays = carm.rays(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, atol=1e-12)
    miss = np.cross(rays, X - carm.source_mm)
    assert np.abs(miss).max() < 1e-8
    assert (np.einsum("ij,ij->i", rays, X - carm.source_mm) > 0).all()


@settings(max_examples=60, deadline=None)
@given(arms, points)
def test_jacobian_against_central_differences(carm, X):
    J, h = carm.jacobian(X), 1e-3
    for k in range(3):
        step = h * np.eye(3)[k]
        slope = (carm.project(X + step)[0] - carm.project(X - step)[0]) / (2 * h)
        np.testing.assert_allclose(J[:, :, k], slope, atol=1e-7)


@settings(max_examples=40, deadline=None)
@given(arms, st.floats(-60, 60))
def test_pixels_to_a_mm_are_the_jacobians_on_the_central_ray(carm, ahead):
    place = carm.source_mm + (carm.sod_mm + ahead) * carm.axes[2]
    (J,), (_, depth) = carm.jacobian(place[None]), carm.project(place[None])
    area = math.sqrt(np.linalg.det(J @ J.T))
    assert carm.px_per_mm(depth) ** 2 == pytest.approx(area, rel=1e-9)


@settings(max_examples=40, deadline=None)
@given(arms, points, st.tuples(*[st.floats(-8, 8)] * 3))
def test_moved_view_is_a_moved_patient(carm, X, offset):
    np.testing.assert_allclose(
        carm.moved(offset).project(X)[0], carm.project(X + np.array(offset))[0], atol=1e-8
    )


@settings(max_examples=40, deadline=None)
@given(arms, points)
def test_resized_keeps_the_field(carm, X):
    small = carm.resized(carm.rows // 4, carm.columns // 4)
    a, b = carm.project(X)[0], small.project(X)[0]
    np.testing.assert_allclose((a + 0.5) / 4 - 0.5, b, atol=1e-8)
    assert small.pixel_at_isocenter_mm == pytest.approx(4 * carm.pixel_at_isocenter_mm)


@settings(max_examples=40, deadline=None)
@given(arms)
def test_repr_evaluates_back_and_axes_are_left_handed(carm):
    assert eval(repr(carm)) == carm  # noqa: S307 - the point of the test
    R = carm.axes
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(-1)


@settings(max_examples=30, deadline=None)
@given(arms, points)
def test_matrix_round_trip(carm, X):
    other = CArm.from_matrix(carm.world2pixel, rows=carm.rows, columns=carm.columns)
    np.testing.assert_allclose(other.project(X)[0], carm.project(X)[0], atol=1e-6)
    rebuilt = dataclasses.replace(other, projection_matrix=None)
    np.testing.assert_allclose(rebuilt.project(X)[0], carm.project(X)[0], atol=1e-6)


def wrong_order(carm):
    """Rotations in the other order: secondary about the patient's axis first."""
    a, b = np.deg2rad([carm.primary_angle_deg, carm.secondary_angle_deg])
    d = np.array([np.sin(a), -np.cos(a) * np.cos(b), np.cos(a) * np.sin(b)])
    u = np.array([np.cos(a), np.sin(a) * np.cos(b), -np.sin(a) * np.sin(b)])
    v = np.array([0.0, -np.sin(b), -np.cos(b)])
    R = np.stack([u, v, d])
    K = np.array(
        [
            [carm.focal_px[0], 0, carm.principal_point[0]],
            [0, carm.focal_px[1], carm.principal_point[1]],
            [0, 0, 1],
        ]
    )
    return K @ np.column_stack([R, [0, 0, carm.sod_mm]])


@pytest.mark.req("REQ-01")
def test_chirality_at_oblique_angles():
    """Wrong order, wrong signs and mirrors all move points by many pixels at oblique angles."""
    carm = CArm(primary_angle_deg=30, secondary_angle_deg=25, **BASE)
    true = carm.project(CORNERS)[0]

    def apart(pixels):
        return np.sqrt(np.mean(np.sum((pixels - true) ** 2, axis=1)))

    homogeneous = np.column_stack([CORNERS, np.ones(8)]) @ wrong_order(carm).T
    assert apart(homogeneous[:, :2] / homogeneous[:, 2:]) > 5
    for change in (
        {"primary_angle_deg": -30},
        {"secondary_angle_deg": -25},
        {"primary_angle_deg": 25, "secondary_angle_deg": 30},
    ):
        assert apart(dataclasses.replace(carm, **change).project(CORNERS)[0]) > 5
    mirrored = true.copy()
    mirrored[:, 0] = carm.columns - 1 - mirrored[:, 0]
    assert apart(mirrored) > 50
    # An un-mirrored landmark: patient left is on the right of a frontal picture, head is up.
    frontal = CArm(primary_angle_deg=0, secondary_angle_deg=0, **BASE)
    centre, left, head = frontal.project(np.array([[0.0, 0, 0], [10, 0, 0], [0, 0, 10]]))[0]
    assert left[0] > centre[0] and head[1] < centre[1]
    # LAO turns the detector to the patient's left, cranial to the head.
    assert dataclasses.replace(frontal, primary_angle_deg=30).axes[2][0] > 0
    assert dataclasses.replace(frontal, secondary_angle_deg=30).axes[2][2] > 0


def test_right_handed_matrix_is_refused():
    P = np.array(CArm(primary_angle_deg=30, secondary_angle_deg=25, **BASE).world2pixel)
    P[0] = 511 * P[2] - P[0]
    with pytest.raises(GeometryError, match="mirror image"):
        CArm.from_matrix(P, rows=480, columns=512)


def test_matrix_beside_angles_must_agree():
    carm = CArm(primary_angle_deg=30, secondary_angle_deg=25, **BASE)
    dataclasses.replace(carm, projection_matrix=carm.world2pixel.tolist())
    with pytest.raises(GeometryError, match="disagrees with the angles"):
        dataclasses.replace(carm, projection_matrix=carm.turned(1.0).world2pixel.tolist())


def test_turning_starts_where_the_matrix_stands():
    """Angles told beside it may be half a pixel off."""
    carm = CArm(
        primary_angle_deg=30, secondary_angle_deg=25, isocenter_offset_mm=(3, 9, -20), **BASE
    )
    true = carm.turned(0.02)
    told = dataclasses.replace(carm, projection_matrix=true.world2pixel.tolist())
    np.testing.assert_allclose(told.turned().project(CORNERS)[0], true.project(CORNERS)[0])
    ahead, other = told.turned(2.0, -1.0, (1.0, 2.0, 3.0)), true.turned(2.0, -1.0, (1.0, 2.0, 3.0))
    np.testing.assert_allclose(ahead.project(CORNERS)[0], other.project(CORNERS)[0])
    assert told.by_angles().projection_matrix is None and carm.by_angles() is carm


def test_numbers_of_other_libraries_are_numbers():
    plain = CArm(primary_angle_deg=30, secondary_angle_deg=25.5, **BASE)
    told = {"rows": np.int64(480), "columns": np.float32(512), "sod_mm": np.float32(765)}
    other = CArm(primary_angle_deg=np.int8(30), secondary_angle_deg=np.float16(25.5),
                 **{**BASE, **told})  # fmt: skip
    assert other == plain and repr(other.columns) == "512" and repr(other.sod_mm) == "765.0"
    for bad in (True, np.True_, "480", None):
        with pytest.raises(GeometryError, match="rows must be a number, got"):
            CArm(primary_angle_deg=30, secondary_angle_deg=25, **{**BASE, "rows": bad})


def test_separation_and_names():
    a = CArm(primary_angle_deg=-30, secondary_angle_deg=-20, **BASE)
    b = CArm(primary_angle_deg=45, secondary_angle_deg=25, **BASE)
    assert separation_deg(a, a) == pytest.approx(0, abs=1e-5)
    cosine = a.axes[2] @ b.axes[2]
    assert separation_deg(a, b) == pytest.approx(np.degrees(np.arccos(cosine)))
    assert a.clinical_name() == "RAO 30 CAU 20" and b.clinical_name() == "LAO 45 CRA 25"
    assert CArm(primary_angle_deg=0, secondary_angle_deg=0, **BASE).clinical_name() == "AP"


@settings(max_examples=40, deadline=None)
@given(arms, points, st.floats(-40, 40))
def test_turning_patient_and_gantry_together_changes_nothing(carm, X, turn):
    """About the long axis the primary angle takes up the patient's turn; no table offset here."""
    carm = dataclasses.replace(carm, isocenter_offset_mm=(0.0, 0.0, 0.0))
    c, s = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))
    Rz = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(
        carm.turned(turn).project(X @ Rz.T)[0], carm.project(X)[0], atol=1e-8
    )


@settings(max_examples=40, deadline=None)
@given(arms, points, st.tuples(*[st.floats(-1, 1)] * 3), st.tuples(*[st.floats(-30, 30)] * 3))
def test_rigid_motion_of_world_and_view_together(carm, X, axis, shift):
    """P' = P [R s]^-1 sees the moved points where P sees the points."""
    M = np.eye(4)
    M[:3, :3], M[:3, 3] = Rotation.from_rotvec(axis).as_matrix(), shift
    moved = CArm.from_matrix(
        carm.world2pixel @ np.linalg.inv(M), rows=carm.rows, columns=carm.columns
    )
    Y = X @ M[:3, :3].T + M[:3, 3]
    np.testing.assert_allclose(moved.project(Y)[0], carm.project(X)[0], atol=1e-6)
    np.testing.assert_allclose(moved.project(Y)[1], carm.project(X)[1], atol=1e-8)


@pytest.mark.parametrize(
    ("start", "step"),
    [((179, 10), (5, 0)), ((-178, 10), (-5, 0)), ((30, 88), (0, 5)), ((30, -88), (2, -5))],
)
def test_turning_over_the_ends_of_the_ranges(start, step):
    """Angles beyond the ranges name the same direction within them."""
    a, b = start[0] + step[0], start[1] + step[1]
    carm = CArm(primary_angle_deg=start[0], secondary_angle_deg=start[1], **BASE).turned(*step)
    a, b = np.deg2rad([a, b])
    R = [
        [np.cos(a), np.sin(a), 0],
        [np.sin(a) * np.sin(b), -np.cos(a) * np.sin(b), -np.cos(b)],
        [np.sin(a) * np.cos(b), -np.cos(a) * np.cos(b), np.sin(b)],
    ]
    np.testing.assert_allclose(carm.axes, R, atol=1e-12)


def test_turned_with_an_offset_is_turned_then_moved():
    carm = CArm(primary_angle_deg=30, secondary_angle_deg=-20, **BASE).moved((1.0, 2.0, 3.0))
    offset = np.array([-4.0, 0.5, 7.0])
    assert carm.turned(2.0, -3.0, offset) == carm.turned(2.0, -3.0).moved(offset)

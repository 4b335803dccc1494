"""Lifting along true rays: against the C-arm itself, for any picture shape."""

import numpy as np
import pytest

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.predict.center_map import (
    DEPTH_PIXELS,
    MAX_PATH_PIXELS,
    blocks,
    decode,
    encode_depth,
    net_picture,
)


def carm(rows=96, columns=96, spacing=(1.6, 1.6), **more):
    return CArm(
        primary_angle_deg=-30, secondary_angle_deg=25, sod_mm=750, sdd_mm=1100, rows=rows,
        columns=columns, pixel_spacing_mm=spacing, **more,
    )  # fmt: skip


def test_points_come_back_through_their_depth():
    view = net_picture(carm(), np.ones((96, 96), np.float32), 64)
    rays = view.rays(2)
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.2, 0.8, size=(32, 32))
    output = np.zeros((4, 32, 32))
    output[0] = depth
    found = decode(output, view, 2)
    assert len(found.points_mm) == 32 * 32
    pixels, _ = view.carm.resized(32, 32).project(found.points_mm)
    np.testing.assert_allclose(pixels, found.cell[:, ::-1], atol=1e-6)
    distance = np.linalg.norm(found.points_mm - view.carm.source_mm, axis=1)
    np.testing.assert_allclose(encode_depth(distance, view), depth.ravel(), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=2), 1)


def test_depth_is_that_of_the_ray_not_of_the_axis():
    """Off the axis the two differ by millimetres: an orthographic depth is wrong."""
    view = net_picture(carm(), np.ones((96, 96), np.float32), 64)
    output = np.full((4, 32, 32), 0.0)
    output[0] = 0.5
    corner = decode(output, view, 2).points_mm[0]
    along_axis = view.carm.axes[2] @ (corner - view.carm.source_mm)
    assert np.linalg.norm(corner - view.carm.source_mm) == pytest.approx(750)
    assert 750 - along_axis > 3


def test_offsets_are_pixels_along_the_axes_of_the_view():
    view = net_picture(carm(), np.ones((96, 96), np.float32), 64)
    output = np.zeros((4, 32, 32))
    output[0] = 0.5
    still = decode(output, view, 2).points_mm
    for k in range(3):
        moved = output.copy()
        moved[k + 1] = 2.0
        np.testing.assert_allclose(
            decode(moved, view, 2).points_mm - still,
            np.tile(2 * view.pixel_mm * view.carm.axes[k], (len(still), 1)),
            atol=1e-9,
        )


@pytest.mark.parametrize(
    ("rows", "columns", "spacing"), [(96, 96, (1.6, 1.6)), (60, 96, (1.6, 1.6)), (96, 60, (1, 2))]
)
def test_any_picture_becomes_square_and_keeps_its_rays(rows, columns, spacing):
    c = carm(rows, columns, spacing)
    path = np.zeros((rows, columns), np.float32)
    path[rows // 2, columns // 3] = 5.0
    view = net_picture(c, path, 64)
    edges = view.carm.pixel_spacing_mm
    assert view.path_mm.shape == (64, 64) and abs(edges[0] / edges[1] - 1) < 0.02
    # The bright spot lies on the same ray as before, to half a pixel.
    total = view.path_mm.sum()
    row, col = np.mgrid[:64, :64]
    middle = np.array([[(col * view.path_mm).sum(), (row * view.path_mm).sum()]]) / total
    np.testing.assert_allclose(
        view.carm.rays(middle), c.rays(np.array([[columns // 3, rows // 2]])), atol=1.2e-3
    )


def test_input_is_bounded_whatever_the_picture_holds():
    path = np.full((96, 96), 1e6, np.float32)
    assert net_picture(carm(), path, 64).network_input().max() == 1
    path[:] = 2 * carm().resized(64, 64).pixel_at_isocenter_mm
    np.testing.assert_allclose(
        net_picture(carm(), path, 64).network_input(), 2 / MAX_PATH_PIXELS, rtol=1e-5
    )


def test_an_empty_picture_has_no_centres():
    view = net_picture(carm(), np.zeros((96, 96), np.float32), 64)
    assert len(decode(np.zeros((4, 32, 32)), view, 2).points_mm) == 0


def test_depth_covers_the_cube():
    view = net_picture(carm(), np.ones((96, 96), np.float32), 64)
    half = 0.5 * DEPTH_PIXELS * view.pixel_mm
    ends = encode_depth(np.array([750 - half, 750, 750 + half]), view)
    np.testing.assert_allclose(ends, [0, 0.5, 1], atol=1e-12)


def test_blocks_hold_their_own_pixels():
    picture = np.arange(36).reshape(6, 6)
    np.testing.assert_array_equal(blocks(picture, 3)[1, 0], [18, 19, 20, 24, 25, 26, 30, 31, 32])

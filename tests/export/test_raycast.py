import json

import cv2
import numpy as np
import pytest

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_export.scenes.labels import LabelVolume, read_label
from gcar_export.scenes.raw_pictures import raw_picture
from gcar_export.scenes.raycast import as_label, raycast, silhouette
from tests.conftest import of_data

MOVED_MM, TURNED_DEG = (1.5, -2.0, 3.0), 1.0


def carm(primary=30.0, secondary=25.0, size=96, **more):
    return CArm(
        primary_angle_deg=primary,
        secondary_angle_deg=secondary,
        sod_mm=750,
        sdd_mm=1050,
        rows=size,
        columns=size,
        pixel_spacing_mm=(1.0, 1.0),
        **more,
    )


def ball(center, radius, spacing=0.25, half=12.0):
    shape = (int(2 * half / spacing),) * 3
    grid = Grid(center_mm=tuple(center), size_mm=(2 * half,) * 3, shape=shape)
    axes = [(np.arange(n) + 0.5) * spacing - half for n in shape]
    distance = np.sqrt(sum(a**2 for a in np.meshgrid(*axes, indexing="ij")))
    # a linear ramp one voxel wide: area-averaged to first order
    occupancy = np.clip((radius - distance) / spacing + 0.5, 0, 1).astype(np.float32)
    return LabelVolume(occupancy=occupancy, grid=grid)


@pytest.mark.parametrize("angles", [(0, 0), (30, 25), (-75, -30), (90, 0), (10, 88)])
def test_chords_of_a_ball(angles):
    center, radius = np.array([8.0, -5.0, 11.0]), 9.0
    view = carm(*angles)
    picture = raycast(ball(center, radius), view, step_mm=0.1)
    row, column = np.mgrid[0 : view.rows, 0 : view.columns]
    rays = view.rays(np.column_stack([column.ravel(), row.ravel()]))
    along = (center - view.source_mm) @ rays.T
    off2 = ((center - view.source_mm) ** 2).sum() - along**2
    exact = 2 * np.sqrt(np.maximum(radius**2 - off2, 0)).reshape(picture.shape)
    inside = off2.reshape(picture.shape) < (0.95 * radius) ** 2
    assert inside.sum() > 200
    assert np.abs(picture - exact)[inside].max() < 0.15
    assert picture[off2.reshape(picture.shape) > (radius + 0.5) ** 2].max() == 0
    assert picture.sum() == pytest.approx(exact.sum(), rel=2e-3)


@pytest.mark.parametrize("spacing", [0.5, 1.5])
def test_silhouette_is_as_wide_as_the_vessel_however_coarse_the_label(spacing):
    center, radius = np.array([3.0, -2.0, 4.0]), 9.0
    view = carm(30, 25, size=192)
    row, column = np.mgrid[0 : view.rows, 0 : view.columns]
    rays = view.rays(np.column_stack([column.ravel(), row.ravel()]))
    along = (center - view.source_mm) @ rays.T
    off = np.sqrt(((center - view.source_mm) ** 2).sum() - along**2).reshape(row.shape)
    inside = silhouette(ball(center, radius, spacing), view)
    assert inside[off < radius - 0.1].all()
    assert not inside[off > radius + 0.1].any()


def test_points_land_where_the_camera_says():
    label = ball((12.0, -20.0, 30.0), 2.0, half=4.0)
    view = carm(size=256, principal_point_px=(120.0, 131.0), detector_rotation_deg=20)
    picture = raycast(label, view)
    row, column = np.mgrid[0:256, 0:256]
    found = [(column * picture).sum() / picture.sum(), (row * picture).sum() / picture.sum()]
    expected = view.project(np.array([[12.0, -20.0, 30.0]]))[0][0]
    assert np.allclose(found, expected, atol=0.05)


def test_blocks_skipped_are_really_empty():
    rng = np.random.default_rng(1)
    occupancy = np.zeros((37, 29, 43), np.float32)
    occupancy[tuple(rng.integers(0, (37, 29, 43), (60, 3)).T)] = 1
    grid = Grid(center_mm=(0, 0, 0), size_mm=(18.5, 14.5, 21.5), shape=(37, 29, 43))
    view = carm(size=48)
    picture = raycast(as_label(occupancy, grid), view)
    slow = _by_map_coordinates(occupancy, grid, view)
    assert np.abs(picture - slow).max() < 1e-4


def _by_map_coordinates(occupancy, grid, view, step=0.4):
    from scipy import ndimage

    row, column = np.mgrid[0 : view.rows, 0 : view.columns]
    rays = view.rays(np.column_stack([column.ravel(), row.ravel()]))
    source = view.source_mm
    first = np.linalg.norm(source) - 0.5 * np.linalg.norm(grid.size_mm)
    out = np.zeros(len(rays))
    for j in range(int(np.linalg.norm(grid.size_mm) / step) + 2):
        index = grid.world2index(source + (first + j * step) * rays)
        out += ndimage.map_coordinates(occupancy, index.T, order=1, mode="grid-constant") * step
    return out.reshape(view.rows, view.columns)


def test_empty_and_unseen_volumes_are_dark():
    grid = Grid(center_mm=(0, 0, 0), size_mm=(10, 10, 10), shape=(10, 10, 10))
    assert not raycast(as_label(np.zeros((10, 10, 10)), grid), carm()).any()
    away = ball((0.0, 0.0, 150.0), 3.0)
    assert not raycast(away, carm(0, 0)).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", ["0001", *(pytest.param(c, marks=pytest.mark.slow) for c in ("0401", "0595"))]
)
@pytest.mark.parametrize("protocol", ["P", "C", "M"])
def test_pictures_of_the_ready_cases(case, protocol):
    label = read_label(of_data("imagecas", f"{case}.label.nii.gz"))
    folder = of_data("cases", f"{protocol}_{case}")
    tree = label if protocol == "P" else label.left_right()[0].centred()
    for index, entry in enumerate(json.loads((folder / "geom.json").read_text())["views"]):
        scale = entry.pop("intensity")["mm_per_count"]
        view = CArm(**{k: tuple(v) if isinstance(v, list) else v for k, v in entry.items()})
        seen, margin = tree, 0.0
        if protocol == "M" and index == 1:
            seen, view = tree.moved(MOVED_MM), view.turned(TURNED_DEG)
            margin = float(np.linalg.norm(MOVED_MM))
        picture = cv2.imread(str(folder / f"view{index + 1}.png"), cv2.IMREAD_UNCHANGED)
        # half a count of rounding in the file, and the float32 it was made in
        difference = raycast(seen, view, margin_mm=margin) - picture * scale
        assert np.abs(difference).max() < 0.6 * scale


def test_raw_picture_is_8_bit_with_dark_vessels():
    path = np.zeros((128, 128), np.float32)
    path[20:100, 60:66] = 3.0
    picture = raw_picture(path, np.random.default_rng(0))
    assert picture.dtype == np.uint8
    assert picture.min() == 0 and picture.max() == 255
    beside = picture[30:90, 72:78].mean()
    assert picture[30:90, 62:64].mean() < 0.8 * beside
    again = raw_picture(path, np.random.default_rng(0))
    assert np.array_equal(picture, again)

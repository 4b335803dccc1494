"""The lattice follows the thin vessels, within what the predictor knows."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from gcar_deploy.config import RunOptions
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.models import read_model
from gcar_deploy.predict import resolution as room
from gcar_deploy.predict.kinds import MULTI
from gcar_deploy.predict.resolution import Resolution, resolution
from tests.imaging.phantoms import angiogram, tube_paths

OPTIONS = RunOptions()
FINE = {"spacing_mm": [0.3, 1.5], "path_cells": [0.15, 0.5]}
GRID = Grid(center_mm=(0, 0, 0), size_mm=(120, 120, 120), shape=(120, 120, 120))


def views(radius_mm: float, pixel_mm: float = 0.15, noise_mm: float = 0.0):
    paths = tube_paths(512, radius_mm, pixel_mm, 2)
    if noise_mm:
        noise = np.random.default_rng(7).normal(0, noise_mm, paths.shape)
        paths = np.maximum(paths + noise, 0)
    picture = angiogram(
        np.round(paths * 1000), "path_length", mm_per_count=0.001, pixel_mm=pixel_mm
    )
    return [extract_vessels(picture, OPTIONS.imaging)] * 2


@pytest.mark.slow
@pytest.mark.parametrize("radius_mm", [0.25, 0.35, 1.5])
def test_a_predictor_of_coarse_cells_keeps_the_cells_asked_for(radius_mm: float) -> None:
    shipped = read_model(MULTI.path, (MULTI,)).spec if MULTI.path else {"spacing_mm": [0.85, 1.5]}
    if shipped["spacing_mm"][0] < OPTIONS.predict.min_cell_mm:
        shipped = {"spacing_mm": [0.85, 1.5]}
    for spec in (None, {}, {"spacing_mm": "fine"}, shipped):
        found = resolution(views(radius_mm), GRID, OPTIONS, spec)
        assert found == Resolution(1.0, 1.0, OPTIONS.candidates.min_path_cells)
        fine = dataclasses.replace(GRID, shape=(480, 480, 480))
        assert resolution(views(radius_mm), fine, OPTIONS, spec).cell_mm == 0.85


@pytest.mark.parametrize("radius_mm", [0.25, 0.3, 0.4])
def test_thin_vessels_get_cells_of_their_width(radius_mm: float) -> None:
    found = resolution(views(radius_mm), GRID, OPTIONS, FINE)
    # narrower than the vessel, but no narrower than its radius
    assert radius_mm < found.cell_mm < 2 * radius_mm
    # less than the mean path of the vessel on a pixel of that size: it is found
    assert 0.15 <= found.min_path_cells < np.pi * radius_mm**2 / found.cell_mm**2


@pytest.mark.parametrize("radius_mm", [0.3, 0.4])
def test_noise_that_widens_shadows_does_not_coarsen_the_cells(radius_mm: float) -> None:
    clean, noisy = (views(radius_mm, noise_mm=level) for level in (0.0, 0.15))
    assert noisy[0].mask.sum() > 1.4 * clean[0].mask.sum()
    cells = [resolution(seen, GRID, OPTIONS, FINE).cell_mm for seen in (clean, noisy)]
    assert cells[1] == pytest.approx(cells[0], rel=0.2)


def test_noise_that_outweighs_the_paths_tells_no_width() -> None:
    """Sums below 0 have no root: the shadow's own width counts."""
    clean = views(0.4)
    dark = [dataclasses.replace(one, path_mm=one.path_mm - 9.0, noise_mm=0.1) for one in clean]
    with np.errstate(invalid="raise"):
        assert resolution(dark, GRID, OPTIONS, FINE) == resolution(clean, GRID, OPTIONS, FINE)


def test_where_only_coarser_cells_are_known_the_threshold_falls() -> None:
    known = {"spacing_mm": [0.6, 1.5], "path_cells": [0.15, 0.5]}
    found = resolution(views(0.25), GRID, OPTIONS, known)
    whole = np.pi * 0.25**2 / 0.6**2  # of the vessel on such a pixel, cells
    assert found.cell_mm == 0.6 and 0.3 * whole < found.min_path_cells < 0.7 * whole


def test_thick_vessels_and_coarse_pixels_cost_what_they_did() -> None:
    for seen in (views(1.2), views(0.3, 1.0)):
        found = resolution(seen, GRID, OPTIONS, FINE)
        assert found.cell_mm == 1.0
    assert resolution(views(1.2), GRID, OPTIONS, FINE).min_path_cells == 0.5
    known = resolution(views(0.25), GRID, OPTIONS, {"spacing_mm": [0.6, 1.5]})
    assert known.cell_mm == 0.6 and known.min_path_cells == 0.5


@pytest.mark.parametrize("known", [FINE, None])
@pytest.mark.parametrize("radius_mm", [0.4, 1.2])
def test_without_a_volume_the_field_of_the_pictures_sets_no_cells(radius_mm: float, known) -> None:
    fields = [dataclasses.replace(GRID, size_mm=(edge,) * 3, bounds=False)
              for edge in (109.0, 126.7, 129.2, 200.0)]  # fmt: skip
    found = {resolution(views(radius_mm), field, OPTIONS, known) for field in fields}
    assert len(found) == 1
    asked = dataclasses.replace(fields[-1], bounds=True)
    assert resolution(views(1.2), asked, OPTIONS, known).cell_mm > 1.4
    assert resolution(views(1.2, 1.3), fields[0], OPTIONS, known).cell_mm == pytest.approx(1.3)


def test_too_many_points_make_coarser_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    start = resolution(views(0.25), GRID, OPTIONS, FINE)
    assert start.coarser(room.MOST_POINTS) is None
    steps = [start]
    while (coarser := steps[-1].coarser(room.MOST_POINTS + 1)) is not None:
        steps.append(coarser)
    assert steps[-1].cell_mm == 1.0 and 3 < len(steps) < 10
    assert all(b.cell_mm > a.cell_mm for a, b in itertools.pairwise(steps))

"""How fine a lattice a scene wants: as fine as its thin vessels, as far as the predictor knows it.

Cells a little narrower than the thin vessels; finer ones cost more and tell little more. Thick
vessels, and predictors that were trained on coarse cells alone, keep the cells of the volume asked
for, or the usual ones.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from gcar_deploy.config import RunOptions
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.types import Array, Scalars

#: cells where nobody names a volume, and pixels are no wider, mm
USUAL_CELL_MM = 1.0
#: a vessel is thin whose radius so large a share of the lines does not reach
THIN_SHARE = 0.15
#: cells are so many times the thin vessels' radius wide. Chosen on three generated thin trees
#: (91 .. 93 of ``gcar_export.evaluate.thin_protocol``, none of the protocol's own)
CELL_RADII = 1.4
#: a point is kept from this share of the thin vessels' own path on
PATH_SHARE = 0.5
#: paths are summed over so wide a square, mm; steps along a line are so long on average, pixels
SECTION_MM, STEP_PX = 4.0, 1.13
#: a hull with more points (some 10 s of prediction on one core) is laid on cells wider by
#: ``COARSER``
MOST_POINTS = 100_000
COARSER = 1.2


@dataclasses.dataclass(frozen=True)
class Resolution:
    """Cells of a lattice, and what vessel is on it.

    Attributes
    ----------
    cell_mm : edge of a cell
    coarsest_mm : edge that it may grow to where the hull has too many points
    min_path_cells : see ``CandidateOptions``
    """

    cell_mm: float
    coarsest_mm: float
    min_path_cells: float

    def coarser(self, points: int) -> Resolution | None:
        """Return the next coarser one where a hull has too many points; None where it may stay."""
        if points <= MOST_POINTS or self.cell_mm >= self.coarsest_mm:
            return None
        cell = min(self.cell_mm * COARSER, self.coarsest_mm)
        return dataclasses.replace(self, cell_mm=cell)


def resolution(
    views: Sequence[VesselImage], grid: Grid, options: RunOptions, spec: Mapping[str, Any] | None
) -> Resolution:
    """Choose the cells for a scene.

    Parameters
    ----------
    views : V vessel images
    grid : Grid that is asked for
    options : RunOptions
    spec : of the predictor; its ``spacing_mm`` (least, most) are the cells that it knows, its
        ``path_cells`` the thresholds of the hull, by default the one of ``options`` alone
    """
    o, usual = options.predict, options.candidates.min_path_cells
    pixel = max(view.carm.pixel_at_isocenter_mm for view in views)
    # Where nobody named a volume its size is that of the pictures: a border would change the cells.
    wanted = np.mean(grid.spacing_mm) if grid.bounds else max(USUAL_CELL_MM, pixel)
    own = float(np.clip(wanted, o.min_cell_mm, o.max_cell_mm))
    least = max(_least(spec, "spacing_mm", o.min_cell_mm), o.thin_cell_mm)
    if least >= o.min_cell_mm:
        return Resolution(own, own, usual)
    thin = _thin_radius_mm(views)
    cell = float(np.clip(CELL_RADII * thin, min(max(least, pixel), own), own))
    path = PATH_SHARE * np.pi * (thin / cell) ** 2
    low = min(_least(spec, "path_cells", usual), usual)
    return Resolution(cell, own, float(np.clip(path, low, usual)))


def _least(spec: Mapping[str, Any] | None, key: str, otherwise: float) -> float:
    """Least of a (least, most) pair of the spec; the other value where it says none."""
    pair = None if spec is None else spec.get(key)
    if not isinstance(pair, (list, tuple)) or len(pair) != 2:
        return otherwise
    return float(pair[0])


def _thin_radius_mm(views: Sequence[VesselImage]) -> float:
    """Radius that ``THIN_SHARE`` of the pictures' lines does not reach, mm; infinite without any.

    Counted in mm of line at the isocentre.
    """
    found: list[Scalars] = []
    weight: list[Scalars] = []
    for view in views:
        pixel = view.carm.pixel_at_isocenter_mm
        # To the centre of the first pixel outside, half a pixel too far; from that of one inside,
        # which lies a quarter off the axis.
        depth = cv2.distanceTransform(view.mask.astype(np.uint8), cv2.DIST_L2, 5) - 0.25
        radius = depth[view.skeleton].astype(np.float64) * pixel
        if view.noise_mm:
            # Noise widens a shadow, but leaves the sum of its paths.
            radius = np.minimum(radius, _by_section(view)[view.skeleton])
        found.append(radius)
        weight.append(np.full(len(radius), pixel))
    radii, lengths = np.concatenate(found), np.concatenate(weight)
    if not len(radii):
        return np.inf
    order = np.argsort(radii, kind="stable")
    part = np.cumsum(lengths[order])
    return float(radii[order][np.searchsorted(part, THIN_SHARE * part[-1])])


def _by_section(view: VesselImage) -> Array:
    """(rows, cols) radius, mm, by the paths about each pixel: their sum is length times section."""
    pixel = view.carm.pixel_at_isocenter_mm
    box = (2 * round(0.5 * SECTION_MM / pixel) + 1,) * 2
    mass, line = (
        cv2.boxFilter(picture.astype(np.float32), -1, box, normalize=False)
        for picture in (view.path_mm, view.skeleton)
    )
    section = mass * pixel / np.maximum(line * STEP_PX, 1.0)
    # Where noise outweighs the paths their sum tells nothing.
    return np.sqrt(np.where(section > 0, section, np.inf) / np.pi)

"""Where starting points say that the centreline is.

A cell of vessel lies up to a radius beside its centreline, and the predictor tells by how much
(``CenterPoints.offset_mm``). Moved by that, all cells of a section fall on one place: vessels that
touch or run beside each other come apart, and the line stands where the predictor sees it.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.gaussians.centers import CenterPoints

#: a vessel thinner than this counts as so thick where cells are judged, in training as here: it
#: must fill some cell
THINNEST_CELLS = 0.7


def line_votes(centers: CenterPoints) -> CenterPoints:
    """Return the points moved onto the centreline that each tells of; as they are without one."""
    if centers.offset_mm is None:
        return centers
    moved = centers.points_mm + np.nan_to_num(centers.offset_mm)
    return dataclasses.replace(centers, points_mm=moved, offset_mm=None)


def as_line_density(votes: CenterPoints, cell_mm: float, smooth_cells: float) -> CenterPoints:
    """Weigh votes so that a line smoothed over cells peaks at its mean confidence, however thick.

    A point of confidence c stands for ``c h^3`` of vessel, which is ``c h^3 / (pi r^2)`` of line.
    Smoothed by a Gaussian of sigma s, a mm of line per mm peaks at ``1 / (2 pi s^2)``.

    Parameters
    ----------
    votes : CenterPoints on their centrelines, ``radius_mm`` finite
    cell_mm : edge of the cells that they are counted on
    smooth_cells : sigma of the smoothing to come, those cells
    """
    h = votes.spacing_mm
    section = np.pi * np.maximum(votes.radius_mm, THINNEST_CELLS * h) ** 2
    line = votes.confidence * h**3 / section
    weight = line / cell_mm * 2 * np.pi * smooth_cells**2
    return dataclasses.replace(votes, confidence=weight, spacing_mm=cell_mm)

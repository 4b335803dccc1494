"""Several lattices over one scene: the predictor asked on lattices shifted against each other.

Where a thin vessel falls between the points of one lattice decides more of the evidence than it
should. A second lattice, half a cell off along each axis (together they are body-centred cubic),
sees what falls between the points of the first; the mean of both is sampled at the first.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import map_coordinates

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.predict.hull import Candidates
from gcar_deploy.types import Array, Scalars

#: cells by which each lattice is shifted; the second fills the gaps of the first, and so on
SHIFTS = ((0.0, 0.0, 0.0), (0.5, 0.5, 0.5), (0.25, 0.5, 0.75), (0.75, 0.0, 0.25))

#: after the first lattice only what lies near points of at least this confidence is asked again
ASKED_AGAIN = 0.15


def shifted_lattice(lattice: Grid, number: int) -> Grid:
    """Return ``lattice`` moved by its share of a cell (``SHIFTS``)."""
    x, y, z = np.asarray(lattice.center_mm) + np.asarray(SHIFTS[number]) * lattice.spacing_mm
    return dataclasses.replace(lattice, center_mm=(float(x), float(y), float(z)))


def near_evidence(first: Candidates, confidence: Scalars, number: int) -> Array:
    """Find the points of a later lattice within 1.5 cells (per axis) of what the first believed.

    Parameters
    ----------
    first : Candidates (n) of lattice 0
    confidence : (n,) what the predictor said of them
    number : of the later lattice

    Returns
    -------
    (m, 3) int64, unique, within the lattice
    """
    believed = first.index[confidence >= ASKED_AGAIN]
    if not len(believed):
        return believed
    low = believed.min(axis=0) - 2
    marked = np.zeros(believed.max(axis=0) + 3 - low, bool)
    marked[tuple((believed - low).T)] = True
    for axis, shift in enumerate(SHIFTS[number]):
        # Nothing is marked near the faces, so that nothing comes round.
        steps = range(math.ceil(-shift - 1.5), math.floor(-shift + 1.5) + 1)
        marked = np.logical_or.reduce([np.roll(marked, step, axis) for step in steps])
    outer = [slice(max(-a, 0), n - a) for a, n in zip(low, first.lattice.shape, strict=True)]
    inner = np.zeros_like(marked)
    inner[tuple(outer)] = marked[tuple(outer)]
    at = np.unravel_index(np.flatnonzero(inner), inner.shape)
    return np.stack(at, axis=1) + low


def mean_evidence(
    first: CenterPoints, others: Sequence[tuple[Candidates, CenterPoints]]
) -> CenterPoints:
    """Average the confidences of ``first`` with those of other lattices at its points.

    Parameters
    ----------
    first : CenterPoints (n), as the predictor gave them
    others : per further number its candidates and what the predictor said of them, in their order

    Returns
    -------
    CenterPoints
        ``first`` with the mean confidence; what is no candidate of a number counts 0 there. Of a
        number without any candidate the predictor cannot be asked: ``find_centers`` leaves it out.
    """
    confidence = first.confidence.copy()
    for candidates, told in others:
        confidence += _sampled(candidates, told.confidence, first)
    return dataclasses.replace(first, confidence=confidence / (1 + len(others)))


def _sampled(candidates: Candidates, values: Scalars, at: CenterPoints) -> Scalars:
    """(n,) trilinear ``values`` of ``candidates`` at other points."""
    if not len(candidates):
        return np.zeros(len(at.points_mm))
    low = candidates.index.min(axis=0)
    dense = np.zeros(candidates.index.max(axis=0) - low + 1, np.float32)
    dense[tuple((candidates.index - low).T)] = values
    place = candidates.lattice.world2index(at.points_mm) - low
    out: Scalars = map_coordinates(dense, place.T, order=1, mode="constant", output=np.float64)
    return out

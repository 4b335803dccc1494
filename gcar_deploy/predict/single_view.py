"""Merge what single views predict: each places its own vessels, the hull says where they agree.

A view's centre lies somewhere along its ray, some ten cells off (monocular depth is a guess); a
hull point is a place where the rays of all views meet. So each hull point is believed as far as
every view's predicted depth speaks for it,

    start_i = 1/2 prod_views 1 / (1 + ((t_i - t_view) / scale)^2)^2

with t_i its distance from the view's source and t_view the predicted one of its cell, and the
paths of all rays are then shared out from there (``thin_hull``), which keeps what is believed
beforehand as far as the pictures allow.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.predict.center_map import ViewCenters
from gcar_deploy.predict.encoding import Encoded
from gcar_deploy.predict.hull import Candidates
from gcar_deploy.predict.thinning import thin_hull
from gcar_deploy.types import Points, Scalars

#: a depth off by so many pixel edges of the network's picture counts a quarter; the shipped model
#: is off by some 9 (median, generated scenes)
DEPTH_SCALE_PIXELS = 8.0


def merge_views(
    views: Sequence[ViewCenters],
    candidates: Candidates,
    encoded: Encoded,
) -> CenterPoints:
    """Turn the centres of single views into confidences of the hull's points.

    Parameters
    ----------
    views : ViewCenters, one per view, as ``SingleViewPredictor.predict`` returns them
    candidates : Candidates (n points), the hull of the same views
    encoded : Encoded, from ``encode`` with the same candidates

    Returns
    -------
    CenterPoints for all n points, no radius; ``source = "single"``.
    """
    start = np.full(len(candidates), 0.5)
    for view in views:
        start *= agreement(view, candidates.points_mm)
    merged = thin_hull(candidates, encoded, start)
    return dataclasses.replace(merged, source="single")


def agreement(view: ViewCenters, points_mm: Points) -> Scalars:
    """How far a view's predicted depths speak for points, (n,), 0 .. 1; 1 where it says nothing.

    A point is compared with the predicted centre of the cell that it projects to, or of the
    nearest cell that has one.
    """
    if not len(view.cell):
        return np.ones(len(points_mm))
    picture, m = view.picture, len(view.picture.path_mm) // view.alpha
    distance = np.zeros((m, m))
    source = picture.carm.source_mm
    distance[tuple(view.cell.T)] = np.linalg.norm(view.points_mm - source, axis=1)
    empty = np.ones((m, m), bool)
    empty[tuple(view.cell.T)] = False
    nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    pixels, _ = picture.carm.project(points_mm)
    cell = np.clip(np.rint((pixels + 0.5) / view.alpha - 0.5), 0, m - 1).astype(np.int64)
    row, col = nearest[:, cell[:, 1], cell[:, 0]]
    wrong = np.linalg.norm(points_mm - source, axis=1) - distance[row, col]
    off = wrong / (DEPTH_SCALE_PIXELS * picture.pixel_mm)
    out: Scalars = (1.0 + off**2) ** -2
    return out

"""Centres where a monocular predictor without any error would place them: what depth is worth."""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.predict.center_map import OUTPUTS, decode, net_picture
from gcar_deploy.predict.view_centers import placed_centers
from gcar_deploy.types import Image
from gcar_export.scenes.label_trees import capsules_of
from gcar_export.scenes.protocols import Case
from gcar_export.scenes.render import path_and_depth

#: picture and cells of the shipped predictor, pixels
PIXELS, ALPHA = 128, 2


def true_depth_centers(case: Case, path_mm: list[Image]) -> CenterPoints:
    """Lift the cells of all views to the true depth of the vessel that they show.

    Of vessels behind one another a cell shows the one with the longest stretch, as in training.

    Parameters
    ----------
    case : Case
    path_mm : its pictures (rows, columns), mm of vessel along each pixel's ray
    """
    from gcar_export.training.paper_dataset import targets

    tree = capsules_of(case.label)
    views = []
    for carm, path in zip(case.scene_carms, path_mm, strict=True):
        picture = net_picture(carm, path, PIXELS)
        made, ray_mm = path_and_depth(picture.carm, tree.starts, tree.ends, tree.radii)
        depth, known = targets(picture, made, ray_mm, ALPHA)
        answer = np.zeros((OUTPUTS, *depth.shape))
        answer[0] = depth
        found = decode(answer, picture, ALPHA)
        there = known[tuple(found.cell.T)]
        views.append(
            dataclasses.replace(
                found, points_mm=found.points_mm[there], ray_mm=found.ray_mm[there],
                cell=found.cell[there],
            )
        )  # fmt: skip
    return placed_centers(views)

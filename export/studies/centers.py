"""Predicted centres of one examination, as the runtime finds them, and how good they are."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.config import RunOptions
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.measure.metrics import skeleton
from gcar_deploy.predict.center_map import DEPTH_PIXELS, encode_depth
from gcar_deploy.predict.center_predictor import Predictor, SingleViewPredictor
from gcar_deploy.predict.centers import Seen, seen_by_all
from gcar_deploy.predict.decision import decide
from gcar_deploy.tree.line_votes import line_votes
from gcar_deploy.types import Points, Volume
from gcar_export.scenes.capsules import Capsules
from gcar_export.scenes.render import path_and_depth
from gcar_export.training.paper_dataset import targets


def pose(angiograms: Sequence[Angiogram], grid: Grid) -> Seen:
    """Find vessels and hull as ``reconstruct`` does, without correcting poses."""
    options = RunOptions()
    views = [extract_vessels(a, options.imaging) for a in angiograms]
    return seen_by_all(views, grid, options)


def predicted(predictor: Predictor, posed: Seen) -> Points:
    """Predicted centres, (n, 3) mm LPS.

    ``multi``: hull points decided to be vessel, moved by their offset to the centreline.
    ``paper``: what each view says on its own, lifted along its rays, all views together.
    """
    if isinstance(predictor, SingleViewPredictor):
        alone = predictor.predict([(v.carm, v.path_mm) for v in posed.views])
        return np.concatenate([view.points_mm for view in alone])
    error = max(view.path_error for view in posed.views)
    found = decide(predictor.predict(posed.hull, posed.encoded), posed.encoded, error)
    return line_votes(found).points_mm[found.confidence >= 0.5]


def depth_error_px(predictor: SingleViewPredictor, posed: Seen, tree: Capsules) -> float:
    """Median error of the depths that single views predict, pixel edges at the isocentre.

    Parameters
    ----------
    predictor : SingleViewPredictor
    posed : Seen, the views that it is asked for
    tree : Capsules of the true tree, in the scene's frame
    """
    wrong = []
    for view in predictor.predict([(v.carm, v.path_mm) for v in posed.views]):
        path, ray_mm = path_and_depth(view.picture.carm, tree.starts, tree.ends, tree.radii)
        depth, known = targets(view.picture, path, ray_mm, view.alpha)
        there = known[tuple(view.cell.T)]
        off = encode_depth(view.ray_mm, view.picture) - depth[tuple(view.cell.T)]
        wrong.append(np.abs(off[there]) * DEPTH_PIXELS)
    return float(np.median(np.concatenate(wrong)))


@dataclasses.dataclass(frozen=True, eq=False)
class Truth:
    """True vessel voxels and centreline of a volume, mm LPS."""

    vessel: Points
    centerline: Points

    @staticmethod
    def of(volume: Volume, grid: Grid) -> Truth:
        """Take the voxels at least half full, and their skeleton."""
        mask = volume >= 0.5
        line = skeleton(mask, grid.spacing_mm)
        return Truth(grid.index2world(np.argwhere(mask)), grid.index2world(line.index))

    @functools.cached_property
    def _vessel_tree(self) -> cKDTree:
        return cKDTree(self.vessel)

    def scores(self, centers: Points, reach_mm: float) -> tuple[float, float]:
        """Share of centres near the vessel, and of the centreline near a centre; NaN without."""
        if not len(centers) or not len(self.centerline):
            return float("nan"), 0.0 if len(self.centerline) else float("nan")
        precision = (self._vessel_tree.query(centers)[0] <= reach_mm).mean()
        recall = (cKDTree(centers).query(self.centerline)[0] <= reach_mm).mean()
        return float(precision), float(recall)

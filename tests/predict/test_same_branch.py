"""This vessel is that vessel: a mark decides what two pictures leave open."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import PredictOptions, RunOptions
from gcar_deploy.engine import Engine
from gcar_deploy.geometry.epipolar import triangulate
from tests.hard.phantoms import GRID, bars, carm, paths

VIEWS = (carm(-40), carm(45))


@pytest.mark.parametrize("exchanged", [False, True])
def test_parallel_bars_stand_where_the_mark_says(exchanged):
    """Bars and their ghosts explain both pictures alike; either comes out as it is marked."""
    truth = bars(2)
    middles = [b.points_mm[len(b) // 2] for b in truth.branches]
    other = [b.points_mm[len(b) // 3] for b in truth.branches]
    seen = [carm.project(np.array(p))[0] for carm, p in zip(VIEWS, (middles, other), strict=True)]
    a, b = seen[0][0], seen[1][1 if exchanged else 0]
    marks = ((tuple(a.tolist()), tuple(b.tolist())),)
    options = RunOptions(predict=PredictOptions(predictor="none"), same_branch=marks)
    found = Engine(options=options, threads=1).reconstruct(paths(truth, VIEWS), GRID)
    wanted = []
    for k in range(2):
        # Where bar k of the first picture and its partner of the second meet, plane by plane.
        line, partner = (truth.branches[j].points_mm for j in (k, k ^ exchanged))
        heights = [p[:, 2] for p in (line, partner)]
        inside = line[np.abs(heights[0]) < 15]
        same = np.stack([np.interp(inside[:, 2], heights[1], c) for c in partner.T], axis=1)
        rays = [VIEWS[0].project(inside)[0], VIEWS[1].project(same)[0]]
        wanted.append(triangulate(VIEWS, rays)[0])
    points = found.tree.points()
    for line in wanted:
        gap = np.linalg.norm(points[:, None] - line, axis=-1).min(axis=0)
        assert np.median(gap) < 1.5, (exchanged, gap)
    all_ = np.concatenate(wanted)
    inside = points[np.abs(points[:, 2]) < 10]
    assert np.percentile(np.linalg.norm(inside[:, None] - all_, axis=-1).min(axis=1), 90) < 3


def test_a_mark_on_no_vessel_says_nothing():
    from gcar_deploy.imaging.extract import extract_vessels
    from gcar_deploy.predict.centers import seen_by_all

    pictures = paths(bars(2), VIEWS)
    options = RunOptions()
    views = [extract_vessels(picture, options.imaging) for picture in pictures]
    whole = len(seen_by_all(views, GRID, options).hull)
    seen = [view.carm.project(bars(2).branches[0].points_mm[20:21])[0][0] for view in views]
    for mark, less in (
        (((2.0, 2.0), tuple(seen[1])), False), ((tuple(seen[0]), None), False),
        ((tuple(seen[0]), tuple(seen[1])), True),
    ):  # fmt: skip
        marked = dataclasses.replace(options, same_branch=(mark,))
        assert (len(seen_by_all(views, GRID, marked).hull) < whole) is less

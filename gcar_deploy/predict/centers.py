"""From views to the points that are vessel: the hull of all views, and what it is thinned by."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import cv2
import numpy as np

from gcar_deploy.config import CandidateOptions, RunOptions
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.search_space import search_spaces
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.resample import sampled_path
from gcar_deploy.predict.center_predictor import CenterPredictor, Predictor, SingleViewPredictor
from gcar_deploy.predict.decision import decide
from gcar_deploy.predict.encoding import Encoded, encode
from gcar_deploy.predict.hull import Candidates, cubic_lattice, visual_hull
from gcar_deploy.predict.lattices import mean_evidence, near_evidence, shifted_lattice
from gcar_deploy.predict.resolution import Resolution, resolution
from gcar_deploy.predict.same_branch import without_ghosts
from gcar_deploy.predict.thinning import thin_hull
from gcar_deploy.predict.view_centers import known_views, placed_centers
from gcar_deploy.stopwatch import Stopwatch
from gcar_deploy.tree.centerline import build_tree
from gcar_deploy.tree.tree import Tree, empty_tree
from gcar_deploy.types import Array, Image

#: of a picture's lines so many mm must be without any point in the cube, and get one beside it
BESIDE_MM = 4.0
#: a point is on a line within so many cells
COVERED_CELLS = 1.5
_THINNED = "no model was used: depth was decided by thinning the visual hull"
_ALONE = "depth was guessed by a model that sees one view at a time: it is off by a centimetre"
_STRANGE = "no view has a direction that the model was trained on"


@dataclasses.dataclass(frozen=True, eq=False)
class Seen:
    """What all views see as vessel.

    Attributes
    ----------
    views : V vessel images as they are placed
    sampled : per view C-arm, path_mm as finely as the lattice, and whether paths are true mm
    hull : n lattice points, possibly none
    encoded : what each view shows at and around them
    candidates : what makes a point one of the hull
    """

    views: tuple[VesselImage, ...]
    sampled: tuple[tuple[CArm, Image, bool], ...]
    hull: Candidates
    encoded: Encoded
    candidates: CandidateOptions


@dataclasses.dataclass(frozen=True, eq=False)
class Evidence:
    """What the predictor of all views said of every point of the hull, before any decision.

    Attributes
    ----------
    points : n CenterPoints
    ray : (V, n) int64, ray of each point
    weight : (V, n) float32, path length of the ray in the point's cell
    """

    points: CenterPoints
    ray: Array
    weight: Array


@dataclasses.dataclass(frozen=True, eq=False)
class Centers:
    """Which points are vessel.

    Attributes
    ----------
    points : CenterPoints with decided confidences
    evidence : Evidence; None where no predictor saw all views at once
    findings : reasons for ``degraded``
    """

    points: CenterPoints
    evidence: Evidence | None = None
    findings: tuple[str, ...] = ()


def seen_by_all(
    views: Sequence[VesselImage],
    grid: Grid,
    options: RunOptions,
    predictor: Predictor | None = None,
) -> Seen:
    """Find the points of a lattice over ``grid`` that all views see as vessel.

    Where nobody asked for that grid the lattice is over a cube of the usual size. If that leaves
    lines of a picture without any point, which points beside it explain, it is over a larger one:
    not always, since most of what lies out there is ghosts. The lattice is as fine as the vessels
    want it and the predictor knows it (``resolution``).
    """
    spec = predictor.model.spec if isinstance(predictor, CenterPredictor) else None
    wanted = resolution(views, grid, options, spec)
    usual, *wider = search_spaces(grid, wanted.cell_mm)
    found = _hull_in(usual, views, wanted, options.candidates)
    for space in wider:
        left = [_missed_mm(view, found.hull) for view in views]
        if max(left) <= BESIDE_MM:
            break
        more = _hull_in(space, views, wanted, options.candidates)
        now = (_missed_mm(view, more.hull) for view in views)
        if max(a - b for a, b in zip(left, now, strict=True)) > BESIDE_MM:
            found = more
    hull = without_ghosts(found.hull, views, options.same_branch)
    sampled = tuple((*p, v.calibrated) for p, v in zip(found.paths, views, strict=True))
    return Seen(tuple(views), sampled, hull, encode(hull, sampled), found.candidates)


def _missed_mm(view: VesselImage, hull: Candidates) -> float:
    """Length of a picture's lines on which no candidate falls, mm at the isocentre."""
    rows, columns = view.mask.shape
    pixels = np.rint(view.carm.project(hull.points_mm)[0])
    inside = ((pixels >= 0) & (pixels < (columns, rows))).all(axis=1)
    column, row = pixels[inside].astype(np.int64).T
    near = np.zeros((rows, columns), np.uint8)
    near[row, column] = 1
    pixel = view.carm.pixel_at_isocenter_mm
    reach = 2 * round(COVERED_CELLS * float(hull.lattice.spacing_mm[0]) / pixel) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    return float(np.count_nonzero(view.skeleton & (cv2.dilate(near, disc) == 0))) * pixel


@dataclasses.dataclass(frozen=True, eq=False)
class _Found:
    """A hull, the pictures as finely as its lattice, and what makes a point one of it."""

    hull: Candidates
    paths: list[tuple[CArm, Image]]
    candidates: CandidateOptions


def _hull_in(
    space: Grid, views: Sequence[VesselImage], wanted: Resolution, options: CandidateOptions
) -> _Found:
    """Find the hull in a space, in coarser cells where it would have too many points."""
    finer: Resolution | None = wanted
    while finer is not None:
        chosen = dataclasses.replace(options, min_path_cells=finer.min_path_cells)
        paths = [sampled_path(view, finer.cell_mm) for view in views]
        hull = visual_hull(paths, cubic_lattice(space, finer.cell_mm), chosen)
        finer = finer.coarser(len(hull))
    return _Found(hull, paths, chosen)


def find_centers(
    seen: Seen, predictor: Predictor | None, options: RunOptions, watch: Stopwatch
) -> Centers:
    """Decide which points of the hull are vessel.

    Parameters
    ----------
    seen : Seen
    predictor : of either kind, or None to thin the hull instead
    options : RunOptions
    watch : Stopwatch, asked while the model runs

    Raises
    ------
    CancelledError
        Cancelled or late.
    """
    if predictor is None:
        thinned = thin_hull(seen.hull, seen.encoded)
        return Centers(thinned, findings=(_THINNED,))
    stop = watch.question
    if isinstance(predictor, SingleViewPredictor):
        return _placed(seen, predictor, stop)
    predicted = predictor.predict(seen.hull, seen.encoded, stop)
    others = []
    for number in range(1, options.predict.lattices):
        lattice = shifted_lattice(seen.hull.lattice, number)
        near = near_evidence(seen.hull, predicted.confidence, number)
        paths = [(carm, path) for carm, path, _ in seen.sampled]
        other = visual_hull(paths, lattice, seen.candidates, near)
        if len(other):
            others.append((other, predictor.predict(other, encode(other, seen.sampled), stop)))
    predicted = mean_evidence(predicted, others)
    error = max(view.path_error for view in seen.views)
    decided = decide(predicted, seen.encoded, error)
    return Centers(decided, Evidence(predicted, seen.encoded.ray, seen.encoded.weight))


def _placed(seen: Seen, predictor: SingleViewPredictor, stop: Callable[[], bool] | None) -> Centers:
    """Centres of the views that the model was trained for; the others take part later."""
    carms = [view.carm for view in seen.views]
    known = known_views(carms, predictor.directions_deg)
    used = [seen.views[k] for k in known] or seen.views
    alone = predictor.predict([(view.carm, view.path_mm) for view in used], stop)
    return Centers(placed_centers(alone), findings=(_ALONE,) if known else (_ALONE, _STRANGE))


def quick_tree(
    views: Sequence[VesselImage],
    grid: Grid,
    predictor: Predictor | None,
    options: RunOptions,
    watch: Stopwatch,
) -> Tree:
    """Make a tree that is good enough to say where the views stand; possibly empty."""
    seen = seen_by_all(views, grid, options, predictor)
    watch.check()
    if len(seen.hull) == 0:
        return empty_tree()
    if isinstance(predictor, SingleViewPredictor):
        predictor = None  # centres a centimetre off say nothing of millimetres between the runs
    once = dataclasses.replace(options, predict=dataclasses.replace(options.predict, lattices=1))
    return build_tree(find_centers(seen, predictor, once, watch).points, len(views))

"""Generated examinations: a tree as a patient may have it, and the views that it is seen from."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import median_filter

from gcar_deploy.config import CandidateOptions
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.predict.hull import visual_hull
from gcar_export.scenes.capsules import Capsules, LabelTree
from gcar_export.scenes.free_tubes import free_tubes
from gcar_export.scenes.gantry import (
    PAPER_VIEWS,
    USUAL_SPREAD_DEG,
    USUAL_VIEWS,
    Field,
    clinical_views,
    focused,
    paper_views,
    random_rotation,
    turned_to_usual,
)
from gcar_export.scenes.render import path_lengths
from gcar_export.scenes.trees import TreeStyle, random_tree, rough_style, thin_style

#: scenes with more candidates are drawn smaller: they cost more than they teach
MAX_POINTS = 30_000
#: of the lattice that covers a paper scene, cells
PAPER_SHAPE = 128
#: range of cells, mm, by kind of lattice
PAPER_CELLS_MM = (1.25, 1.5)
CLINICAL_CELLS_MM = (0.8, 1.25)
FINE_CELLS_MM = (0.3, 0.85)
#: how often a tree is cut down to what ``MAX_POINTS`` allow
SHRINKS = 6
REGIMES = ("paper", "clinical", "fine")


@dataclasses.dataclass(frozen=True)
class SceneOptions:
    """Shares of what is drawn; probabilities unless named otherwise."""

    #: of the paper's set-up, and of a fine lattice on part of a tree; the rest is clinical
    paper_share: float = 0.25
    fine_share: float = 0.35
    #: exact, noisy, uncertain, mask (``PATH_ERRORS``)
    inputs: tuple[float, float, float, float] = (0.35, 0.15, 0.15, 0.35)
    #: masks and uncertain paths with a segmentation's errors
    spoilt_share: float = 0.6
    #: trees with thin vessels on clinical lattices (always on fine ones), and of rough walls and
    #: bends among the rest
    thin_share: float = 0.3
    rough_share: float = 0.5
    #: trees turned as a whole, any way or by up to 40 degrees, and mirrored
    turned_share: float = 0.4
    mirrored_share: float = 0.1
    oval_share: float = 0.2
    anywhere_share: float = 0.15
    misplaced_share: float = 0.2
    more_views_share: float = 0.12
    #: scenes drawn from users' label volumes where some are given
    label_share: float = 0.5
    #: of the others, tubes that are no coronary tree; none among the usual views
    free_share: float = 0.25


@dataclasses.dataclass(frozen=True, eq=False)
class Examination:
    """A tree and the C-arm views that it is seen from.

    Attributes
    ----------
    tree : Capsules
    carms : views at the pixels of the pictures
    h : float, the lattice's cell, mm
    middle_mm, radius_mm : the ball that holds the tree
    regime : of ``REGIMES``
    thin : whether the tree has vessels that need a low threshold
    """

    tree: Capsules
    carms: list[CArm]
    h: float
    middle_mm: np.ndarray
    radius_mm: float
    regime: str
    thin: bool


def examination(
    rng: np.random.Generator,
    options: SceneOptions,
    labels: Sequence[LabelTree] = (),
    usual: bool = False,
) -> Examination | None:
    """Draw a tree and its views; None where the tree does not fit into the paper's cube.

    With ``usual`` the views are two of those that are taken in practice, give or take some
    degrees, of a tree as it lies in the patient; otherwise they are from anywhere.
    """
    fine = options.fine_share
    regime = str(rng.choice(REGIMES, p=[options.paper_share, 1 - options.paper_share - fine, fine]))
    paper = regime == "paper"
    thin = regime == "fine" or (not paper and rng.random() < options.thin_share)
    if labels and rng.random() < options.label_share:
        tree = _label_tree(rng, labels, paper)
    elif not usual and rng.random() < options.free_share:
        tree = free_tubes(rng, rng.uniform(0.22, 0.5) if thin else 0.5)
    else:
        tree = _generated(rng, _style(rng, options, thin), paper)
    if not usual:
        tree = _turned(rng, tree, options)
    n = int(rng.integers(3, 7)) if rng.random() < options.more_views_share else 2
    if paper:
        h = rng.uniform(*PAPER_CELLS_MM)
        if tree.reach_mm > 0.5 * h * PAPER_SHAPE - 2:
            return None
        carms = paper_views(rng, n, h)
        if usual:
            carms = turned_to_usual(rng, carms[:2], PAPER_VIEWS, 0.0)
        return Examination(tree, carms, h, np.zeros(3), 0.5 * h * PAPER_SHAPE, regime, thin)
    if usual:
        return _as_usual(rng, tree, n)
    low, high = FINE_CELLS_MM if regime == "fine" else CLINICAL_CELLS_MM
    h = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    carms = _views(rng, n, h, options)
    if regime == "fine":
        tree = _part(rng, tree, h * rng.uniform(50, 140), True)
    for _ in range(SHRINKS):
        field = _field(tree)
        seen = [focused(carm, field) for carm in carms]
        many = _points(tree, seen, field, h)
        if many < 0.75 * MAX_POINTS:
            return Examination(tree, seen, h, field.middle_mm, field.radius_mm, regime, thin)
        tree = _part(rng, tree, 0.9 * field.radius_mm * (0.75 * MAX_POINTS / many) ** 0.4, False)
    return None


def _as_usual(rng: np.random.Generator, tree: Capsules, n: int) -> Examination:
    """Two of the usual views of a tree, with the whole field on ``NET_PIXELS`` pixels."""
    h = rng.uniform(0.85, 1.25)
    carms = clinical_views(rng, n, h * rng.uniform(1.05, 1.2))
    which = [USUAL_VIEWS[k] for k in rng.permutation(len(USUAL_VIEWS))[:2]]
    carms = turned_to_usual(rng, carms[:2], which, USUAL_SPREAD_DEG)
    return Examination(tree, carms, h, np.zeros(3), 0.5 * h * PAPER_SHAPE, "clinical", False)


def _views(rng: np.random.Generator, n: int, h: float, options: SceneOptions) -> list[CArm]:
    """Clinical views; detectors are finer than the lattice, mostly."""
    pixel = float(np.exp(rng.uniform(np.log(0.13), np.log(min(1.2 * h, 0.55)))))
    if rng.random() < 0.1:
        pixel = h * rng.uniform(0.9, 1.25)
    carms = clinical_views(rng, n, pixel, rng.random() < options.anywhere_share)
    if rng.random() < 0.1:
        which = [USUAL_VIEWS[k] for k in rng.permutation(len(USUAL_VIEWS))[:2]]
        carms = turned_to_usual(rng, carms[:2], which, USUAL_SPREAD_DEG)
    return carms


def _field(tree: Capsules) -> Field:
    ends = np.concatenate([tree.starts, tree.ends])
    middle = 0.5 * (ends.min(axis=0) + ends.max(axis=0))
    return Field(middle, float(np.linalg.norm(ends - middle, axis=1).max()) + 4.0)


def _points(tree: Capsules, carms: Sequence[CArm], field: Field, h: float) -> int:
    """Count the hull's points, from pictures as coarse as the lattice."""
    views = []
    for carm in carms:
        n = max(round(carm.rows * min(carm.pixel_at_isocenter_mm / h, 1.0)), 8)
        small = carm.resized(n, n)
        views.append((small, path_lengths(small, tree.starts, tree.ends, tree.radii)))
    return len(
        visual_hull(views, lattice_of(field.middle_mm, field.radius_mm, h), CandidateOptions())
    )


def lattice_of(middle_mm: np.ndarray, radius_mm: float, h: float) -> Grid:
    """Cover a ball with cells of ``h`` mm."""
    edge = max(int(2 * radius_mm / h), 8)
    x, y, z = middle_mm.tolist()
    return Grid(center_mm=(x, y, z), size_mm=(h * edge,) * 3, shape=(edge,) * 3)


def _style(rng: np.random.Generator, options: SceneOptions, thin: bool) -> TreeStyle:
    if thin:
        return thin_style(rng)
    return rough_style(rng) if rng.random() < options.rough_share else TreeStyle()


def _generated(rng: np.random.Generator, style: TreeStyle, paper: bool) -> Capsules:
    tree = random_tree(rng, style)
    if not paper and rng.random() < 0.8:
        tree = tree.sides("left" if rng.random() < 0.65 else "right")
    return Capsules(*tree.segments())


def _label_tree(rng: np.random.Generator, labels: Sequence[LabelTree], paper: bool) -> Capsules:
    label = labels[int(rng.integers(len(labels)))]
    if paper or not label.sides or rng.random() > 0.8:
        return label.whole
    return label.sides[int(rng.integers(len(label.sides)))]


def _turned(rng: np.random.Generator, tree: Capsules, options: SceneOptions) -> Capsules:
    if rng.random() < options.turned_share:
        tree = tree.turned(random_rotation(rng, None if rng.random() < 0.6 else 40.0))
    if rng.random() < options.mirrored_share:
        tree = tree.turned(np.diag([-1.0, 1.0, 1.0]))
    return tree


def _part(rng: np.random.Generator, tree: Capsules, reach: float, alone: bool) -> Capsules:
    """Take a ball out of a tree, round some vessel; ``alone``: at times without thick vessels."""
    centre = tree.starts[int(rng.integers(len(tree.starts)))]
    near = np.linalg.norm(0.5 * (tree.starts + tree.ends) - centre, axis=1) < reach
    if alone and rng.random() < 0.4:
        # Smoothed along the vessel, or a rough wall would break it up.
        thinner = near & (median_filter(tree.radii, 21, mode="nearest") < rng.uniform(0.7, 1.2))
        near = thinner if thinner.sum() > 8 else near
    return tree.kept(near)

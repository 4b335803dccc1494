"""Ghosts: figures by closed forms, what the model makes of them, what is said and stated."""

import dataclasses
import types

import numpy as np
import pytest

from gcar_deploy.config import QualityOptions
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.quality import ghosts
from gcar_deploy.quality.ghost_figures import FIGURES, STRETCH_MM, ghost_figures, stretches_of
from gcar_deploy.quality.ghosts import (
    PROBABLE,
    GhostModel,
    check_ghosts,
    find_ghosts,
    shipped_model,
)
from gcar_deploy.quality.shown import Shown
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes import footprint, tubes_of
from tests.hard.phantoms import bars, carm, straight

CARMS = (carm(-45), carm(45))


def picture(tree, view, kind="path_length"):
    """What a view shows of a tree, exactly."""
    path = footprint(tubes_of(tree), view, 1.0).image((view.rows, view.columns))
    return VesselImage(
        view_id="1", carm=view, path_mm=path.astype(np.float32), path_error=0.0, mask=path > 0.1,
        skeleton=path > 0.1, valid=np.ones(path.shape, bool), kind=kind,
    )  # fmt: skip


def cells(tree, confidence):
    """One cell per point of the tree, each on rays of its own."""
    points = tree.points()
    told = CenterPoints(
        points_mm=points, confidence=np.broadcast_to(confidence, len(points)).astype(float),
        radius_mm=np.full(len(points), np.nan), spacing_mm=1.0, source="multi",
    )  # fmt: skip
    own = np.tile(np.arange(len(points)), (2, 1))
    return types.SimpleNamespace(points=told, ray=own, weight=np.ones(own.shape))


def figures(tree, shown, evidence=None):
    views = [picture(shown, view) for view in CARMS]
    stretches = stretches_of(tree)
    told = evidence or cells(tree, 0.5)
    found = ghost_figures(Shown(tree, views, told), told, stretches)
    return dict(zip(FIGURES, found.T, strict=True)), stretches


def test_stretches_cover_every_branch_evenly():
    tree = bars(2)
    stretches = stretches_of(tree)
    assert stretches.length_mm.max() <= STRETCH_MM
    for number, branch in enumerate(tree.branches):
        own = stretches.branch == number
        assert stretches.length_mm[own].sum() == pytest.approx(branch.length_mm)
    assert len(stretches.point) == len(tree.points())
    assert len(stretches.segment) == len(tubes_of(tree).first)
    assert (np.diff(stretches.point) >= 0).all()
    assert (stretches.branch[stretches.point] == tree.branch_index()).all()


def test_a_vessel_alone_explains_all_of_its_rays():
    told, _ = figures(straight(), straight())
    assert told["branch_seen_least"] == pytest.approx(1.0, abs=1e-3)
    assert told["branch_alone_least"] == pytest.approx(1.0)
    assert told["branch_elsewhere_least"] == pytest.approx(0.0)
    assert told["branch_network"] == pytest.approx(0.0)  # log odds of a half
    assert (told["loose_ends"] == 2).all() and told["apart"] == pytest.approx(0.0)
    assert (told["exact"] == 1).all() and (told["mask"] == 0).all()


def crossed():
    """Two upright bars, and the ghost at the place where their rays cross."""
    true = bars(2)
    first, second = (branch.points_mm for branch in true.branches)
    axes = [view.axes[2][:2] for view in CARMS]
    # On the ray of the first bar in view 1 and of the second in view 2.
    step = np.linalg.solve(np.stack([axes[0], -axes[1]], axis=1), (second - first)[0, :2])
    ghost = dataclasses.replace(
        true.branches[0], points_mm=first + np.append(step[0] * axes[0], 0.0), start=4, end=5
    )
    nodes = np.concatenate([true.nodes_mm, ghost.points_mm[[0, -1]]])
    return true, Tree(nodes_mm=nodes, branches=(*true.branches, ghost))


def test_the_rays_of_a_ghost_are_explained_without_it():
    true, with_ghost = crossed()
    told, stretches = figures(with_ghost, true)
    ghost = stretches.branch == 2
    assert told["branch_alone_least"][ghost].max() < 0.2
    assert told["branch_seen_least"][ghost].max() < 0.2
    assert told["seen_most"][ghost].max() < 0.2
    assert (told["apart"] > 0.6).all()  # three bars of one length, none joined


def test_evidence_at_another_depth_of_the_same_rays():
    tree = straight()
    points = tree.points()
    away = np.concatenate([points, points + 15.0 * CARMS[0].axes[2]])
    n = len(points)
    told = CenterPoints(
        points_mm=away, confidence=np.repeat([0.6, 0.2], n),
        radius_mm=np.full(2 * n, np.nan), spacing_mm=1.0, source="multi",
    )  # fmt: skip
    one, both = np.arange(2 * n), np.tile(np.arange(n), 2)
    evidence = types.SimpleNamespace(
        points=told, ray=np.stack([both, one]), weight=np.ones((2, 2 * n))
    )
    found, _ = figures(tree, tree, evidence)
    # View 1 sees both places on one ray, a quarter of it elsewhere; view 2 keeps them apart.
    assert found["elsewhere_most"] == pytest.approx(0.25)
    assert found["branch_elsewhere_least"] == pytest.approx(0.0)
    assert found["unclaimed_least"] == pytest.approx(0.0)


def by_network():
    """A model that goes by the predictor's confidence alone: 1 less it."""
    weight = np.zeros(len(FIGURES))
    weight[FIGURES.index("branch_network")] = -1.0
    return GhostModel(np.zeros(len(FIGURES)), np.ones(len(FIGURES)), weight, 0.0)


def test_probabilities_go_to_points_branches_tree_and_places(monkeypatch):
    monkeypatch.setattr(ghosts, "shipped_model", by_network)
    tree = bars(2)
    confidence = np.where(tree.branch_index() == 0, 0.9, 0.2)
    views = [picture(tree, view) for view in CARMS]
    found = find_ghosts(Shown(tree, views, cells(tree, confidence)))
    assert found.branches == pytest.approx([0.1, 0.8])
    assert [len(told) for told in found.points] == [len(branch) for branch in tree.branches]
    assert found.points[1] == pytest.approx(np.full(len(tree.branches[1]), 0.8))
    assert found.share == pytest.approx(0.45)
    (ghost,) = found.probable
    assert (ghost.branch, ghost.start_mm) == (1, 0.0) and ghost.probability >= PROBABLE
    assert ghost.end_mm == pytest.approx(tree.branches[1].length_mm)
    (said,) = check_ghosts(found, QualityOptions())
    assert "45%" in said and "branch 2" in said
    usual = dataclasses.replace(QualityOptions(), good_ghost_share=0.46)
    assert check_ghosts(found, usual) == [] and check_ghosts(None, QualityOptions()) == []


def test_one_figure_far_from_all_that_was_fitted_does_not_decide_alone():
    """Evidence of the predictor that lies elsewhere: at 3 and at 30 standard deviations."""
    model = shipped_model()
    sure = model.mean - 1.5 * np.sign(model.weight) * model.sd
    unclaimed = FIGURES.index("unclaimed_least")
    told = []
    for far in (3.0, 30.0):
        figures = sure.copy()
        figures[unclaimed] = model.mean[unclaimed] + far * model.sd[unclaimed]
        told.append(float(model.probability(figures[None])[0]))
    assert told[0] == told[1] < 0.1


def test_nothing_is_stated_without_evidence_or_of_three_views():
    tree = straight()
    views = [picture(tree, view) for view in CARMS]
    assert find_ghosts(Shown(tree, views, None)) is None
    assert find_ghosts(Shown(tree, [*views, views[0]], cells(tree, 0.5))) is None


def test_the_shipped_model_prefers_what_is_believed_and_seen():
    """Signs that a wrong fit would turn: what the predictor believes is no ghost."""
    weight = dict(zip(FIGURES, shipped_model().weight, strict=True))
    assert weight["branch_network"] < 0 and weight["branch_seen_least"] < 0
    assert weight["branch_elsewhere_least"] > 0
    assert (shipped_model().sd > 0).all()

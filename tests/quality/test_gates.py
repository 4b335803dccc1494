"""Gates: where ok ends and degraded begins, and what is refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import ImagingOptions, QualityOptions
from gcar_deploy.errors import RefusedError
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.pose.agreement import check_consistency, check_order, with_hint
from gcar_deploy.quality.gates import (
    assess,
    best_separation,
    check_candidates,
    check_poses,
    check_tree,
    check_views,
    view_quality,
)
from gcar_deploy.selftest import tiny_case
from gcar_deploy.tree.tree import Tree, empty_tree

OPTIONS = QualityOptions()


@pytest.fixture(scope="module")
def case():
    angiograms, _, tree = tiny_case()
    return angiograms, [extract_vessels(a, ImagingOptions()) for a in angiograms], tree


def turned(angiogram, primary):
    carm = dataclasses.replace(angiogram.carm, primary_angle_deg=primary, secondary_angle_deg=0.0)
    return dataclasses.replace(angiogram, carm=carm)


@pytest.mark.parametrize(
    ("second", "outcome"),
    [(3, "refused"), (4.9, "refused"), (5.1, "degraded"), (24, "degraded"), (26, "ok"),
     (90, "ok"), (154, "ok"), (156, "degraded"), (174.5, "degraded"), (175.5, "refused"),
     (180, "refused")],
)  # fmt: skip
@pytest.mark.req("REQ-13")
def test_separation(case, second, outcome):
    pair = [turned(case[0][0], 0.0), turned(case[0][1], second)]
    if outcome == "refused":
        with pytest.raises(RefusedError, match="deg apart"):
            check_views(pair, OPTIONS)
    else:
        assert bool(check_views(pair, OPTIONS)) == (outcome == "degraded")


def test_one_good_pair_among_many_views_is_enough(case):
    first = case[0][0]
    views = [turned(first, a) for a in (0.0, 1.0, 60.0)]
    assert best_separation([v.carm for v in views]) == pytest.approx(60.0)
    assert check_views(views, OPTIONS) == []


def test_the_same_picture_twice(case):
    pair = [dataclasses.replace(a, sha256="0" * 64) for a in case[0]]
    with pytest.raises(RefusedError, match="same picture"):
        check_views(pair, OPTIONS)


@pytest.mark.req("REQ-13")
def test_contradiction(case):
    views = case[1]
    assert check_consistency(views, [0.0, OPTIONS.good_disagreement], OPTIONS) == []
    between = (OPTIONS.good_disagreement + OPTIONS.max_disagreement) / 2
    assert len(check_consistency(views, [0.0, between], OPTIONS)) == 1
    with pytest.raises(RefusedError, match="contradict"):
        check_consistency(views, [0.0, OPTIONS.max_disagreement + 0.01], OPTIONS)


RAW, EXACT = False, True
#: (calibrated, disagreement, with the pictures exchanged) -> what is said of their order
ORDERS = [
    (RAW, 0.12, 0.07, "swapped"), (RAW, 0.12, 0.12, "do not tell"),
    (RAW, 0.12, 0.14, "do not tell"), (RAW, 0.12, 0.15, ""),
    (RAW, 0.4, 0.25, "do not tell"), (RAW, 0.12, None, ""), (RAW, 0.0, 0.0, ""),
    (EXACT, 0.14, 0.001, "swapped"), (EXACT, 0.001, 0.0001, ""), (EXACT, 0.3, 0.2, "do not tell"),
    (EXACT, 0.07, 0.15, ""),
]  # fmt: skip


@pytest.mark.parametrize(("calibrated", "given", "other", "said"), ORDERS)
def test_pictures_in_the_wrong_order(calibrated, given, other, said):
    findings, hint = check_order(("a", "b"), given, other, calibrated, OPTIONS)
    assert len(findings) == (said != "")
    assert all("views a and b" in text and said in text for text in findings)
    assert hint == (findings[0] if said == "swapped" else "")


@pytest.mark.parametrize(
    ("error", "hint", "said"),
    [("no tree", "swapped?", "no tree. Swapped?"), ("angles?", "swapped?", "angles? Swapped?"),
     ("no tree", "", "no tree")],
)  # fmt: skip
def test_a_hint_joins_a_refusal(error, hint, said):
    with pytest.raises(RefusedError) as refused, with_hint(hint):
        raise RefusedError(error)
    assert str(refused.value) == said


def test_the_true_tree_is_ok_and_covers_everything(case):
    _, views, tree = case
    judged = assess(tree, views, [v.mask for v in views], [], 0.01, OPTIONS)
    assert judged.status == "ok" and not judged.findings
    for view in judged.views:
        assert view.coverage > 0.97 and view.support > 0.97
        assert view.overlap == 1.0 and view.distance_mm < 0.6


def test_a_missing_branch_lowers_coverage_and_a_ghost_lowers_support(case):
    _, views, tree = case
    part = dataclasses.replace(tree, branches=tree.branches[:2])
    judged = assess(part, views, [v.mask for v in views], [], None, OPTIONS)
    assert judged.status == "degraded" and "explained" in judged.sentence
    ghost = dataclasses.replace(
        tree.branches[1], points_mm=tree.branches[1].points_mm + np.array([0.0, 0.0, 12.0])
    )
    more = dataclasses.replace(tree, branches=(*tree.branches, ghost))
    quality = view_quality(more, views[0], views[0].mask, OPTIONS)
    assert quality.coverage > 0.97 and quality.support < 0.9


def test_a_tree_somewhere_else_is_refused(case):
    _, views, tree = case
    shift = np.array([0.0, 0.0, 40.0])
    away = Tree(
        nodes_mm=tree.nodes_mm + shift,
        branches=tuple(
            dataclasses.replace(b, points_mm=b.points_mm + shift) for b in tree.branches
        ),
    )
    with pytest.raises(RefusedError, match="only"):
        assess(away, views, [v.mask for v in views], [], None, OPTIONS)


def test_too_little(case):
    with pytest.raises(RefusedError, match="mm of vessel"):
        check_tree(empty_tree(), OPTIONS)
    lattice = Grid(center_mm=(0, 0, 0), size_mm=(96, 96, 96), shape=(96, 96, 96))
    with pytest.raises(RefusedError, match="points"):
        check_candidates(3, lattice, OPTIONS)
    check_candidates(1000, lattice, OPTIONS)


def test_undefined_figures_are_none(case):
    _, views, _ = case
    quality = view_quality(empty_tree(), views[0], np.zeros_like(views[0].mask), OPTIONS)
    assert quality.coverage is None and quality.support is None and quality.overlap == 0.0


def test_doubtful_views_that_no_tree_explains_contradict(case):
    _, views, tree = case
    part = dataclasses.replace(tree, branches=tree.branches[:2])
    masks = [v.mask for v in views]
    with pytest.raises(RefusedError, match="contradict"):
        assess(part, views, masks, [], OPTIONS.good_disagreement + 0.01, OPTIONS)
    assert assess(part, views, masks, [], OPTIONS.good_disagreement, OPTIONS).status == "degraded"
    assert assess(tree, views, masks, [], OPTIONS.good_disagreement + 0.01, OPTIONS).status == "ok"


def test_a_large_correction_between_the_runs_is_degraded(case):
    views = case[1]
    limit, turn = OPTIONS.good_shift_mm, OPTIONS.good_turn_deg
    assert check_poses(views, [(0.0, 0.0), (limit, turn)], OPTIONS) == []
    for correction in ((limit + 0.1, 0.0), (0.0, turn + 0.1)):
        (finding,) = check_poses(views, [(0.0, 0.0), correction], OPTIONS)
        assert "view 2 had to be moved" in finding


def test_match_rate_and_strict_coverage(case):
    _, views, tree = case
    quality = view_quality(tree, views[0], views[0].mask, OPTIONS, views[1])
    assert quality.match_rate > 0.97 and 0.0 < quality.foreshortening < 0.5
    assert quality.coverage_2px <= quality.coverage
    assert view_quality(tree, views[0], views[0].mask, OPTIONS).match_rate is None

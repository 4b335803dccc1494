"""Status: what the pictures say of a finished tree, and where ok ends."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import ImagingOptions, QualityOptions, RunOptions
from gcar_deploy.errors import RefusedError
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.quality.gravity import Remark
from gcar_deploy.quality.status import (
    assess,
    check_explained,
    judge,
    part_lengths_mm,
    view_quality,
)
from gcar_deploy.tree.tree import Tree, empty_tree
from tests.hard.phantoms import both, paths, straight

OPTIONS = QualityOptions()


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


def test_the_gravest_finding_is_the_sentence(case):
    _, views, tree = case
    part = dataclasses.replace(tree, branches=tree.branches[:2])
    findings = [Remark("a line was left out"), "the views are swapped", "the scale is off"]
    judged = assess(part, views, [v.mask for v in views], findings, None, OPTIONS)
    first, second, *parts, last = judged.findings
    assert (first, second, last) == (findings[1], findings[2], findings[0])
    assert parts and all("explained" in said for said in parts)
    assert judged.sentence == f"The views are swapped (and {len(parts) + 2} more)."


def test_a_branch_at_the_border_is_said_after_all_else(case, monkeypatch):
    _, views, tree = case
    for check, said in (("border", "a border"), ("missing", "a line"), ("scale", "a scale")):
        monkeypatch.setattr(f"gcar_deploy.quality.status.check_{check}", lambda *_, s=said: [s])
    judged = judge(tree, views, [], RunOptions(), disagreement=0.0, evidence=None)
    assert judged.findings == ("a scale", "a line", "a border")


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


def test_no_tree_at_all_is_refused_with_its_reason(case):
    """By the whole judgement: nothing that is asked of a tree may fail for want of one."""
    _, views, _ = case
    with pytest.raises(RefusedError, match="only 0% of the vessels seen, weighed by thickness"):
        judge(empty_tree(), views, [], RunOptions(), disagreement=0.0, evidence=None)


def test_no_share_is_above_one_by_its_last_digit(case):
    """Normalised weights may sum to a digit more, which the schema of a result refuses."""
    _, views, tree = case
    shape = views[0].path_mm.shape
    for seed in range(12):
        paths = np.random.default_rng(seed).uniform(0.5, 3.0, shape).astype(np.float32)
        view = dataclasses.replace(views[0], path_mm=paths)
        quality = view_quality(tree, view, view.mask, dataclasses.replace(OPTIONS, near_px=99.0))
        assert quality.coverage <= 1.0 and quality.coverage_2px <= 1.0
        assert quality.coverage == pytest.approx(1.0, abs=1e-12)


def test_undefined_figures_are_none(case):
    _, views, _ = case
    quality = view_quality(empty_tree(), views[0], np.zeros_like(views[0].mask), OPTIONS)
    assert quality.coverage is None and quality.support is None and quality.overlap == 0.0


def test_doubtful_views_that_no_tree_explains_contradict(case):
    _, views, tree = case
    part = dataclasses.replace(tree, branches=tree.branches[:2])
    masks = [v.mask for v in views]
    with pytest.raises(RefusedError, match=r"contradict.*angles or pixel sizes\?"):
        assess(part, views, masks, [], OPTIONS.good_disagreement + 0.01, OPTIONS)
    assert assess(part, views, masks, [], OPTIONS.good_disagreement, OPTIONS).status == "degraded"
    assert assess(tree, views, masks, [], OPTIONS.good_disagreement + 0.01, OPTIONS).status == "ok"


@pytest.mark.parametrize("kind", ["mask", "raw"])
def test_several_views_that_agree_poorly_may_leave_more_unexplained_than_two(case, kind):
    _, views, tree = case
    one = view_quality(tree, views[0], views[0].mask, OPTIONS)
    doubt = OPTIONS.max_disagreement_mask - 0.1

    def judged(even, count, of=kind):
        seen = [dataclasses.replace(one, coverage=0.95, support=0.95, coverage_even=even)] * count
        return check_explained(seen, doubt, of, OPTIONS)

    assert judged(0.71, 3) == []
    for even, count, of in ((0.71, 2, kind), (0.69, 3, kind), (0.71, 3, "exact")):
        with pytest.raises(RefusedError, match="contradict"):
            judged(even, count, of)


@pytest.mark.parametrize(("cut", "even", "refused"), [
    ([], 0.95, True), (["1"], 0.95, False), (["1"], 0.85, True), (["2"], 0.95, True),
])  # fmt: skip
def test_what_is_cut_off_in_one_view_is_missing_from_the_tree(case, cut, even, refused):
    _, views, tree = case
    one = view_quality(tree, views[0], views[0].mask, OPTIONS)
    seen = [
        dataclasses.replace(one, view_id=name, coverage=0.95, support=0.95, coverage_even=share)
        for name, share in (("1", even), ("2", 0.75))
    ]
    doubt = OPTIONS.good_disagreement + 0.01
    if refused:
        with pytest.raises(RefusedError, match="contradict"):
            check_explained(seen, doubt, "exact", OPTIONS, cut)
    else:
        (said,) = check_explained(seen, doubt, "exact", OPTIONS, cut)
        assert "75%" in said and "view 1" in said and "cut off" in said


def test_match_rate_and_strict_coverage(case):
    _, views, tree = case
    quality = view_quality(tree, views[0], views[0].mask, OPTIONS, views[1])
    assert quality.match_rate > 0.97 and 0.0 < quality.foreshortening < 0.5
    assert quality.coverage_2px <= quality.coverage
    assert view_quality(tree, views[0], views[0].mask, OPTIONS).match_rate is None


@pytest.mark.parametrize("found", [0, 1])
def test_a_thin_vessel_that_is_missed_counts_less_than_a_thick_one(found):
    """Two bars of one length, 2.0 and 1.0 mm: path lengths through the middle are as the radii."""
    thick = straight((1, 0, 0), radius=2.0, middle=(0, 0, 12))
    bars = both(thick, straight((1, 0, 0), radius=1.0, middle=(0, 0, -12)))
    view = extract_vessels(paths(bars)[0], ImagingOptions())
    part = dataclasses.replace(bars, branches=bars.branches[found : found + 1])
    judged = view_quality(part, view, view.mask, OPTIONS)
    assert judged.coverage == pytest.approx((2 / 3, 1 / 3)[found], abs=0.04)
    assert judged.coverage_even == pytest.approx(0.5, abs=0.03)
    pale = dataclasses.replace(view, path_mm=0 * view.path_mm)  # nothing to weigh by
    assert view_quality(part, pale, view.mask, OPTIONS).coverage == pytest.approx(0.5, abs=0.03)


def test_ok_says_what_was_checked_what_was_not_and_how_many_pieces(case):
    _, views, tree = case
    lumen = [v.mask for v in views]
    whole = assess(tree, views, lumen, [], 0.01, OPTIONS).sentence
    assert "explained by one tree." in whole and "Checked:" in whole and "cannot check" in whole
    assert "its size, exchangeable vessels and probable ghosts." in whole
    several = assess(tree, [*views, views[0]], [*lumen, lumen[0]], [], 0.01, OPTIONS).sentence
    assert "its size. Exchangeable vessels and probable ghosts are looked for in two" in several
    first, *others = tree.branches
    ends = np.arange(2) + len(tree.nodes_mm)
    loose = dataclasses.replace(first, start=int(ends[0]), end=int(ends[1]))
    torn = Tree(
        nodes_mm=np.concatenate([tree.nodes_mm, first.points_mm[[0, -1]]]),
        branches=(loose, *others),
    )
    lengths = part_lengths_mm(torn)
    assert len(lengths) > 1 and sum(lengths) == pytest.approx(tree.length_mm)
    assert lengths == tuple(sorted(lengths, reverse=True))
    told = assess(torn, views, lumen, [], 0.01, OPTIONS)
    *longer, shortest = (f"{length:.0f}" for length in lengths)
    said = f"by {len(lengths)} separate pieces of {', '.join(longer)} and {shortest} mm."
    assert told.status == "ok" and said in told.sentence and "one tree" not in told.sentence
    assert part_lengths_mm(empty_tree()) == ()

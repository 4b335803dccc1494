"""Gates: where ok ends and degraded begins, and what is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from gcar_deploy.config import QualityOptions, RunOptions
from gcar_deploy.errors import RefusedError
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.predict.center_predictor import CenterPredictor
from gcar_deploy.predict.kinds import read_predictor
from gcar_deploy.quality.gates import (
    best_separation,
    check_candidates,
    check_consistency,
    check_order,
    check_poses,
    check_tree,
    check_views,
    kind_of,
    with_hint,
)
from gcar_deploy.quality.too_much import MOST_LINE_MM, MOST_ML, check_found, check_length
from gcar_deploy.reconstruct import reconstruct
from gcar_deploy.selftest import tiny_case
from gcar_deploy.tree.tree import empty_tree

OPTIONS = QualityOptions()
TINY_MODEL = Path(__file__).parents[1] / "data" / "tiny.onnx"


def turned(angiogram, primary):
    carm = dataclasses.replace(angiogram.carm, primary_angle_deg=primary, secondary_angle_deg=0.0)
    return dataclasses.replace(angiogram, carm=carm)


def test_a_separation_just_below_the_least_is_not_told_as_that(case):
    pair = [turned(case[0][0], 0.0), turned(case[0][1], 4.996)]
    with pytest.raises(RefusedError, match=r"are 4\.99 deg apart .* at least 5 deg"):
        check_views(pair, OPTIONS)


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


@pytest.mark.parametrize(
    ("primary", "asked"),
    [((np.radians(-25), np.radians(42)), True), ((0.0, np.pi / 2), True), ((0.0, 0.0), False),
     ((2.0, 2.01), False), ((-30.0, -28.0), False), ((0.0, 178.0), False)],
)  # fmt: skip
def test_angles_in_radians_are_asked_about(case, primary, asked):
    pair = [turned(one, angle) for one, angle in zip(case[0], primary, strict=True)]
    with pytest.raises(RefusedError, match="to see depth") as refused:
        check_views(pair, OPTIONS)
    assert ("are the angles in radians?" in str(refused.value)) == asked


def test_one_good_pair_among_many_views_is_enough(case):
    first, second = case[0]
    views = [turned(first, 0.0), turned(first, 1.0), turned(second, 60.0)]
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
    (said,) = check_consistency(views, [0.0, between], OPTIONS)
    assert "of the vessels have no match" in said and "epipolar" not in said
    with pytest.raises(RefusedError, match=r"contradict.*angles or pixel sizes\?"):
        check_consistency(views, [0.0, OPTIONS.max_disagreement + 0.01], OPTIONS)


RAW, EXACT, MASK = "raw", "exact", "mask"
#: (kind of pictures, disagreement, with the pictures exchanged) -> what is said of their order
ORDERS = [
    (RAW, 0.12, 0.07, "swapped"), (RAW, 0.12, 0.12, "do not tell"),
    (RAW, 0.12, 0.14, "do not tell"), (RAW, 0.12, 0.15, ""),
    (RAW, 0.4, 0.25, "do not tell"), (RAW, 0.12, None, ""), (RAW, 0.0, 0.0, ""),
    (EXACT, 0.14, 0.001, "swapped"), (EXACT, 0.001, 0.0001, ""), (EXACT, 0.3, 0.2, "do not tell"),
    (EXACT, 0.07, 0.15, ""), (MASK, 0.17, 0.21, ""), (MASK, 0.17, 0.16, "do not tell"),
    (MASK, 0.17, 0.12, "swapped"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "given", "other", "said"), ORDERS)
def test_pictures_in_the_wrong_order(kind, given, other, said):
    findings, hint = check_order(("a", "b"), given, other, kind, OPTIONS)
    assert len(findings) == (said != "")
    assert all("views a and b" in text and said in text for text in findings)
    assert hint == (findings[0] if said == "swapped" else "")


def test_masks_are_judged_by_gates_of_their_own(case):
    """Right pairs of masks differ by 12-17 % along the epipolar lines, more than raw ones may."""
    exact = case[1]
    masks = [dataclasses.replace(v, kind="mask", path_error=0.2) for v in exact]
    raw = [dataclasses.replace(v, kind="raw", path_error=0.3) for v in exact]
    assert [kind_of(v) for v in (exact, masks, raw)] == [EXACT, MASK, RAW]
    assert kind_of([exact[0], masks[1]]) == MASK and kind_of([masks[0], raw[1]]) == RAW
    assert check_consistency(masks, [0.0, 0.17], OPTIONS) == []
    assert check_consistency(raw, [0.0, 0.17], OPTIONS)
    assert check_consistency(masks, [0.0, OPTIONS.good_disagreement_mask + 0.01], OPTIONS)
    with pytest.raises(RefusedError, match="contradict"):
        check_consistency(masks, [0.0, OPTIONS.max_disagreement_mask + 0.01], OPTIONS)


@pytest.mark.parametrize(
    ("error", "hint", "said"),
    [("no tree", "swapped?", "no tree. Swapped?"), ("angles?", "swapped?", "angles? Swapped?"),
     ("no tree", "", "no tree")],
)  # fmt: skip
def test_a_hint_joins_a_refusal(error, hint, said):
    with pytest.raises(RefusedError) as refused, with_hint(hint):
        raise RefusedError(error)
    assert str(refused.value) == said


def test_too_little(case):
    with pytest.raises(RefusedError, match="mm of vessel"):
        check_tree(empty_tree(), OPTIONS)
    lattice = Grid(center_mm=(0, 0, 0), size_mm=(96, 96, 96), shape=(96, 96, 96))
    with pytest.raises(RefusedError, match="points"):
        check_candidates(3, lattice, OPTIONS)
    check_candidates(1000, lattice, OPTIONS)


def test_a_large_correction_between_the_runs_is_degraded(case):
    views = case[1]
    limit, turn = OPTIONS.good_shift_mm, OPTIONS.good_turn_deg
    still = ((0.0, 0.0, 0.0), 0.0)
    assert check_poses(views, [still, ((0.0, limit, 0.0), turn)], OPTIONS) == []
    for correction in (((0.0, limit + 0.1, 0.0), 0.0), ((0.0, 0.0, 0.0), turn + 0.1)):
        (finding,) = check_poses(views, [still, correction], OPTIONS)
        assert "view 2 had to be moved" in finding


@pytest.mark.parametrize("number", [0, 1])
def test_a_shift_along_a_beam_asks_for_that_views_scale(case, number):
    views = case[1]
    beam = views[number].carm.axes[2]
    aside = np.cross(beam, views[1 - number].carm.axes[2])
    for offset, asks in ((-40 * beam, True), (40 * aside, False), (9 * beam, False)):
        (finding,) = check_poses(views, [(np.zeros(3), 0.0), (offset, 0.0)], OPTIONS)
        assert ("SOD" in finding) == asks
        share = 40 / views[number].carm.sod_mm
        said = f"beam of view {number + 1}, as where"
        assert (said in finding and f"some {share:.0%} off" in finding) == asks
    turned = (np.zeros(3), OPTIONS.good_turn_deg + 1)
    (alone,) = check_poses(views, [(np.zeros(3), 0.0), turned], OPTIONS)
    assert "SOD" not in alone


def filled(view, ml, line_mm, kind="raw"):
    """Return a view with so much vessel, in rows of a comb."""
    pixel = view.carm.pixel_at_isocenter_mm
    row = np.zeros(view.skeleton.shape, bool)
    row[::2] = True
    row &= np.cumsum(row.reshape(-1)).reshape(row.shape) <= line_mm / pixel
    path = np.where(row, ml * 1000 / (row.sum() * pixel**2), 0).astype(np.float32)
    return dataclasses.replace(
        view,
        path_mm=path,
        skeleton=row,
        kind=kind,
        path_error=0.0 if kind == "path_length" else 0.2,
    )


@pytest.mark.req("REQ-13")
def test_more_vessel_than_a_heart_has(case):
    first, second = case[1]
    much, long = 1.2 * MOST_ML, 1.2 * MOST_LINE_MM

    def pair(ml, mm, *kinds):
        return [filled(v, ml, mm, k) for v, k in zip((first, second), kinds, strict=True)]

    with pytest.raises(RefusedError, match=r"any heart has.*view 2: 12 ml, 8.. mm.*give masks"):
        check_found(pair(much, long, "raw", "raw"))
    # Wide arteries are short, thin lines hold little, and what is given was not mistaken here.
    check_found(pair(much, 0.8 * MOST_LINE_MM, "raw", "raw"))
    check_found(pair(0.8 * MOST_ML, long, "raw", "raw"))
    check_found(pair(much, long, "raw", "mask"))
    check_found(pair(much, long, "path_length", "path_length"))
    check_found([filled(first, much, long), filled(second, 3.0, 400.0)])


@pytest.mark.req("REQ-13")
def test_more_tree_than_a_heart_has(case):
    tree, found = case[2], [filled(view, 1.0, 100.0) for view in case[1]]
    check_length(tree, found, OPTIONS)
    less = dataclasses.replace(OPTIONS, max_length_mm=0.9 * tree.length_mm)
    with pytest.raises(RefusedError, match=r"more than any coronary tree has.*give masks"):
        check_length(tree, found, less)
    check_length(tree, case[1], less)  # of true path lengths: nothing was mistaken


def test_a_model_that_finds_nothing_is_named_and_not_the_pictures():
    """As one that was hardly trained: no point of the hull is believed."""

    class Faint:
        def run(self, _names, feed, _options):
            return [np.full((feed["ray"].shape[1], 5), 0.02, np.float32)]

    untrained = dataclasses.replace(read_predictor(TINY_MODEL), golden=None)
    predictor = CenterPredictor(untrained, session=Faint())
    angiograms, grid, _ = tiny_case()
    kind = Intensity(kind="mask")  # exact pictures make up for it
    masks = [
        dataclasses.replace(a, pixels=(a.pixels > 0.1).astype(np.float32), intensity=kind)
        for a in angiograms
    ]
    with pytest.raises(RefusedError, match=r"finds no vessel \(largest confidence 0.02 of 1\)"):
        reconstruct(masks, grid, RunOptions(), predictor=predictor)
    with pytest.raises(RefusedError, match="do the views show one tree"):
        check_tree(empty_tree(), OPTIONS, np.array([0.1, 0.9]))

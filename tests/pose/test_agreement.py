"""Background taken for vessel in one raw picture does not make two views contradict each other."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

from gcar_deploy.config import PoseOptions, RunOptions
from gcar_deploy.errors import CancelledError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.resample import resized
from gcar_deploy.imaging.skeleton import skeletonize
from gcar_deploy.pose import agreement
from gcar_deploy.pose.agreement import agreeing, order_of, other_order, poses_between
from gcar_deploy.pose.partners import GAIN
from gcar_deploy.quality import Remark

render = pytest.importorskip("gcar_export.scenes.render", reason="needs the export extra")
from gcar_export.scenes.trees import random_tree  # noqa: E402

OPTIONS = RunOptions()


def pair(seeds=(4, 4), stranger=False, calibrated=False, angles=((-30, -20), (45, 25))):
    """Two views of the trees ``seeds``; with ``stranger`` a line of twice the mass in view 1.

    ``crossing`` draws a thinner one from border to border through the vessels.
    """
    angiograms, views = [], []
    for k, (a, b) in enumerate(angles):
        carm = CArm(
            primary_angle_deg=a, secondary_angle_deg=b, sod_mm=765, sdd_mm=1100,
            rows=192, columns=192, pixel_spacing_mm=(1.2, 1.2),
        )  # fmt: skip
        tree = random_tree(np.random.default_rng(seeds[k])).sides("left").segments()
        path = render.path_lengths(carm, *tree).astype(np.float32)
        path[path < 0.5] = 0
        mask = path > 0
        label, count = ndimage.label(mask, np.ones((3, 3)))
        mask = label == 1 + np.argmax(ndimage.sum(mask, label, np.arange(1, count + 1)))
        path[~mask] = 0
        if stranger and k == 0:
            columns = np.flatnonzero(mask.any(axis=0))
            at = columns[0] - 12 if columns[0] > 20 else columns[-1] + 8
            if stranger == "crossing":
                path[:, columns.mean().astype(int) - 1 :][:, :3] += path.sum() / (192 * 3)
            else:
                path[4:188, at : at + 3] = 2.0 * path.sum() / (184 * 3)
        views.append(_view(carm, path, calibrated))
        angiograms.append(
            Angiogram(
                view_id=str(k + 1),
                carm=carm,
                pixels=path,
                bit_depth=8,
                intensity=Intensity(kind="raw"),
                sha256="",
            )
        )
    return angiograms, views


def _view(carm, path, calibrated):
    mask = path > 0
    return VesselImage(
        view_id="1", carm=carm, path_mm=path, path_error=0.0 if calibrated else 0.25, mask=mask,
        skeleton=skeletonize(mask), valid=np.ones(mask.shape, bool), kind="raw",
    )  # fmt: skip


def test_a_part_without_counterpart_is_left_out_and_said():
    angiograms, views = pair(stranger=True)
    assert poses_between(views, OPTIONS)[1].after > 0.35
    kept, poses, findings = agreeing(angiograms, views, OPTIONS)
    assert poses[1].after < 0.13
    np.testing.assert_array_equal(kept[0].mask, pair()[1][0].mask)
    assert kept[1] is views[1]
    assert len(findings) == 1 and "no counterpart" in findings[0]
    assert not (kept[0].skeleton & ~kept[0].mask).any()
    assert (kept[0].path_mm[~kept[0].mask] == 0).all()


@pytest.mark.parametrize(("share", "said"), [(0.0, []), (0.005, []), (0.02, ["2%"])])
def test_a_pixel_or_two_that_go_or_come_back_are_no_finding(share, said):
    _, (view, _) = pair()
    edge = np.argwhere(view.mask)[: round(share * view.mask.sum())]
    fewer = view.mask.copy()
    fewer[tuple(edge.T)] = False
    less = dataclasses.replace(view, mask=fewer)
    found = [agreement._changed([now], [given]) for now, given in ((less, view), (view, less))]
    assert [[text.split()[2] for text in texts] for texts in found] == [said, said]


def test_a_line_through_the_tree_without_counterpart_is_left_out_and_said():
    angiograms, views = pair(stranger="crossing")
    before = poses_between(views, OPTIONS)[1].after
    kept, poses, findings = agreeing(angiograms, views, OPTIONS)
    assert before > 0.2 and poses[1].after < 0.12
    assert len(findings) == 1 and "no counterpart" in findings[0]
    tree = pair()[1][0].mask
    assert (kept[0].mask & tree).sum() > 0.93 * tree.sum()
    assert (kept[0].mask & ~tree).sum() < 0.1 * (views[0].mask & ~tree).sum()


def without(view, gone):
    """A view of which a part was taken for a device."""
    mask = view.mask & ~gone
    return dataclasses.replace(
        view, mask=mask, skeleton=skeletonize(mask), kept=lambda: view, catheter=view.mask & gone,
        path_mm=np.where(mask, view.path_mm, np.float32(0)),
    )  # fmt: skip


def lower_half(view):
    """The part of a view below its vessels' middle row."""
    rows = np.arange(view.mask.shape[0])[:, None]
    return np.broadcast_to(rows > np.average(np.flatnonzero(view.mask.any(axis=1))),
                           view.mask.shape)  # fmt: skip


def test_what_was_taken_for_a_device_comes_back_where_the_other_view_shows_it():
    angiograms, (one, two) = pair()
    lost = without(one, lower_half(one))
    assert poses_between([lost, two], OPTIONS)[1].after > 0.12
    kept, poses, findings = agreeing(angiograms, [lost, two], OPTIONS)
    assert poses[1].after < 0.05 and kept[1] is two
    back = kept[0].mask & lost.catheter
    assert back.sum() > 0.6 * lost.catheter.sum()
    assert not (kept[0].catheter & kept[0].mask).any()
    assert (kept[0].path_mm[back] == one.path_mm[back]).all()
    assert len(findings) == 1 and "look like a catheter" in findings[0]
    assert isinstance(findings[0], Remark)
    # Where nobody remembers what it was, the views differ.
    forgotten = dataclasses.replace(lost, kept=None)
    assert agreeing(angiograms, [forgotten, two], OPTIONS)[1][1].after > 0.12


def test_a_device_that_one_view_shows_stays_away_where_a_vessel_comes_back():
    angiograms, (crossed, two) = pair(stranger="crossing")
    tree = pair()[1][0]
    lost = without(crossed, lower_half(crossed) | ~tree.mask)
    kept, poses, _ = agreeing(angiograms, [lost, two], OPTIONS)
    assert poses[1].after < 0.12
    assert (kept[0].mask & tree.mask).sum() > 0.85 * tree.mask.sum()
    assert (kept[0].mask & ~tree.mask).sum() < 0.1 * (crossed.mask & ~tree.mask).sum()


def test_views_that_agree_are_left_as_they_are():
    angiograms, views = pair()
    kept, _, findings = agreeing(angiograms, views, OPTIONS)
    assert findings == [] and all(a is b for a, b in zip(kept, views, strict=True))


def test_two_trees_do_not_agree_by_leaving_parts_out():
    angiograms, views = pair(seeds=(4, 9), stranger=True)
    kept, poses, findings = agreeing(angiograms, views, OPTIONS)
    # Outlines of two trees may agree by chance: register asks where vessels turn and end.
    assert len(findings) == 1 and "widths" in findings[0]
    np.testing.assert_array_equal(kept[0].mask, views[0].mask)
    assert poses[1].after > 0.13


def test_a_mask_given_by_the_user_and_path_lengths_are_never_cut():
    angiograms, views = pair(stranger=True)
    told = [dataclasses.replace(a, mask=v.mask) for a, v in zip(angiograms, views, strict=True)]
    assert agreeing(told, views, OPTIONS)[0][0] is views[0]
    angiograms, views = pair(stranger=True, calibrated=True)
    assert agreeing(angiograms, views, OPTIONS)[0][0] is views[0]


@pytest.mark.parametrize("calibrated", [False, True])
def test_swapped_pictures_agree_better_the_other_way_round(calibrated):
    _, (one, two) = pair(calibrated=calibrated)
    given = [
        dataclasses.replace(one, carm=two.carm, view_id="2"),
        dataclasses.replace(two, carm=one.carm),
    ][::-1]
    findings, hint = order_of(given, poses_between(given, OPTIONS), OPTIONS)
    assert hint and findings == [hint] and "swapped?" in hint
    assert order_of([one, two], poses_between([one, two], OPTIONS), OPTIONS) == ([], "")


def test_pictures_of_two_sizes_have_no_other_order():
    _, (one, two) = pair()
    assert other_order([one, two], OPTIONS) is not None
    assert other_order([one, resized(two, 96, 96)], OPTIONS) is None


@pytest.mark.parametrize("swap", [(0, 1), (0, 2), (1, 2)])
def test_of_three_pictures_the_two_that_are_swapped_are_named(swap):
    views = pair(seeds=(4, 4, 4), angles=((-30, -20), (45, 25), (-30, 25)))[1]
    views = [dataclasses.replace(v, view_id=str(k + 1)) for k, v in enumerate(views)]
    i, j = swap
    given = list(views)
    given[i] = dataclasses.replace(views[j], carm=views[i].carm, view_id=views[i].view_id)
    given[j] = dataclasses.replace(views[i], carm=views[j].carm, view_id=views[j].view_id)
    options = dataclasses.replace(OPTIONS, pose=PoseOptions(enabled=False))
    _, hint = order_of(given, poses_between(given, options), options)
    assert hint.startswith(f"views {i + 1} and {j + 1} agree far better with their pictures")
    assert order_of(views, poses_between(views, options), options) == ([], "")


def test_the_order_of_two_trees_cannot_be_told():
    """No tree explains them either way: nothing is said of swapping in particular."""
    _, views = pair(seeds=(4, 9))
    assert order_of(views, poses_between(views, OPTIONS), OPTIONS)[1] == ""


def by_contrast(factors, seeds=(4, 4)):
    """A pair whose paths are off by a factor that varies along the columns; outlines are right."""
    angiograms, views = pair(seeds=seeds)
    across = np.linspace(-1, 1, 192)[None, :]
    return angiograms, [
        dataclasses.replace(
            v, view_id=str(k + 1), path_mm=(v.path_mm * np.exp(f * across)).astype(np.float32)
        )
        for k, (v, f) in enumerate(zip(views, factors, strict=True))
    ]


def test_where_contrasts_contradict_depth_is_taken_from_widths_and_that_is_said():
    angiograms, views = by_contrast((2.0, -2.0))
    before = poses_between(views, OPTIONS)[1].after
    kept, poses, findings = agreeing(angiograms, views, OPTIONS)
    assert before > OPTIONS.quality.good_disagreement_raw
    assert poses[1].after <= OPTIONS.quality.good_disagreement_mask
    assert [v.kind for v in kept] == ["mask", "mask"] and "widths" in findings[0]
    for new, old in zip(kept, views, strict=True):
        np.testing.assert_array_equal(new.mask, old.mask)
    # A mask that the user drew stays what the contrast says, and so does another tree.
    told = [dataclasses.replace(a, mask=v.mask) for a, v in zip(angiograms, views, strict=True)]
    assert agreeing(told, views, OPTIONS)[0][0] is views[0]


def test_each_view_is_read_as_it_agrees_best():
    angiograms, (one, two) = pair()
    _, (first, _) = pair(seeds=(9, 4))
    _, (_, further) = pair(seeds=(4, 7))
    # What stands first is wrong in one view; of the other the further reading is.
    views = [dataclasses.replace(first, others=(one,)), dataclasses.replace(two, others=(further,))]
    for read in (views, [view.others[0] for view in views]):
        assert poses_between(read, OPTIONS)[1].after > OPTIONS.quality.good_disagreement_raw
    kept, poses, findings = agreeing(angiograms, views, OPTIONS)
    assert kept[0] is one and kept[1] is views[1] and not findings
    assert poses[1].after < OPTIONS.quality.alone_disagreement_raw


def test_a_reading_that_shows_a_part_alone_does_not_stand_for_the_tree():
    """What holds a third of the lines disagrees about a third; whole trees are worth more."""
    angiograms, views = by_contrast((1.0, -1.0))
    starts, ends, radii = random_tree(np.random.default_rng(4)).sides("left").segments()
    thick = radii > np.quantile(radii, 0.75)
    parts = []
    for view, factor in zip(views, (0.6, -0.6), strict=True):
        path = render.path_lengths(view.carm, starts[thick], ends[thick], radii[thick])
        path = np.where(path < 0.5, 0, path * np.exp(factor * np.linspace(-1, 1, 192)))
        parts.append(_view(view.carm, path.astype(np.float32), False))
    before, after = (poses_between(read, OPTIONS)[1].after for read in (views, parts))
    assert before > OPTIONS.quality.alone_disagreement_raw
    assert OPTIONS.quality.alone_ratio * after < before
    tried = [dataclasses.replace(v, others=(p,)) for v, p in zip(views, parts, strict=True)]
    for new, old in zip(agreeing(angiograms, tried, OPTIONS)[0], tried, strict=True):
        assert new is old


def test_who_wants_out_gets_out_between_two_estimates():
    """What lines are left out takes an estimate for each: many, with several views."""
    angiograms, views = pair(stranger=True)
    asked = []

    def check():
        asked.append(len(asked))
        if len(asked) == 2:
            raise CancelledError("cancelled by the caller")

    with pytest.raises(CancelledError):
        agreeing(angiograms, views, OPTIONS, check)
    assert len(asked) == 2


def test_who_wants_out_is_asked_before_every_estimate(monkeypatch):
    """Of readings of one method, and of widths, as well."""
    angiograms, views = by_contrast((2.0, -2.0))
    views = [dataclasses.replace(view, others=(view,)) for view in views]
    asked, made = [], []
    estimate = agreement.estimate_poses

    def counted(*args):
        made.append(len(asked))
        return estimate(*args)

    monkeypatch.setattr(agreement, "estimate_poses", counted)
    assert "widths" in agreeing(angiograms, views, OPTIONS, lambda: asked.append(0))[2][0]
    assert made == list(range(1, len(asked) + 1))


@pytest.mark.parametrize(("share", "taken"), [(GAIN - 0.01, True), (GAIN + 0.01, False)])
def test_widths_have_a_word_where_the_views_agree_far_better_so(share, taken):
    """What the network drew, and how well the views are said to agree with other paths."""
    views = pair()[1]
    drawn = [dataclasses.replace(view, by_network=True) for view in views]

    def estimate(tried):
        same = all((a.path_mm == b.path_mm).all() for a, b in zip(tried, drawn, strict=True))
        after = 0.1 * (1.0 if same else share)
        return tuple(SimpleNamespace(after=after) for _ in tried)

    found, poses = agreement._with_widths(drawn, (True, True), estimate(drawn), estimate)
    assert all((one is view) is not taken for one, view in zip(found, drawn, strict=True))
    assert poses[1].after == pytest.approx(0.1 * (share if taken else 1.0))
    # The filter's view has no widths to believe in, and a mask of the user's none to doubt.
    assert agreement._with_widths(views, (True, True), estimate(views), estimate)[0] is views
    assert agreement._with_widths(drawn, (False, False), estimate(drawn), estimate)[0] is drawn

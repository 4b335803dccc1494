"""Overlays: lines where the geometry puts them, and what is missing in red."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import QualityOptions
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.output import overlay as overlays
from gcar_deploy.output.colors import branch_color
from gcar_deploy.output.overlay import backdrop, grey8, overlay, png_bytes
from gcar_deploy.output.words import LEFT_OUT, explained
from gcar_deploy.quality.status import ViewQuality, unexplained, view_quality
from gcar_deploy.tree.tree import Branch, Tree, empty_tree

RED = (60, 40, 255)
OPTIONS = QualityOptions()
JUDGED = ViewQuality(
    view_id="1", name="RAO 30 CAU 20", coverage=0.5, support=None, distance_mm=None, overlap=None
)


def blank_view(rows=128, columns=96):
    carm = CArm(
        primary_angle_deg=-30.0, secondary_angle_deg=-20.0, sod_mm=750.0, sdd_mm=1050.0, rows=rows,
        columns=columns, pixel_spacing_mm=(1.0, 1.0),
    )  # fmt: skip
    nothing = np.zeros((rows, columns), bool)
    return VesselImage(
        view_id="1", carm=carm, path_mm=np.zeros((rows, columns), np.float32), path_error=0.0,
        mask=nothing, skeleton=nothing, valid=~nothing, kind="path_length",
    )  # fmt: skip


def line_tree(carm):
    """One straight branch seen from pixel (20, 60) to (70, 60), at the isocentre's depth."""
    ends = carm.backproject(np.array([[20.0, 60.0], [70.0, 60.0]]), np.full(2, carm.sod_mm))
    points = ends[0] + np.linspace(0, 1, 60)[:, None] * (ends[1] - ends[0])
    branch = Branch(
        points_mm=points, radius_mm=np.full(60, 1.5), sigma_mm=np.full(60, np.nan),
        confidence=np.ones(60), start=0, end=1,
    )  # fmt: skip
    return Tree(nodes_mm=ends, branches=(branch,))


def picture_of(view, tree, judged=JUDGED):
    pixels = np.zeros((view.carm.rows, view.carm.columns), np.float32)
    return overlay(backdrop(pixels, unexplained(tree, view, OPTIONS)), view, tree, judged)


def test_line_lies_where_the_c_arm_projects_it():
    view = blank_view()
    picture = picture_of(view, line_tree(view.carm))
    zoom = picture.shape[1] // view.carm.columns
    rows, columns = np.nonzero((picture == branch_color(0)).all(axis=2))
    middle = (np.abs(rows / zoom - 60.5) < 1.0) & (columns < 75 * zoom)
    assert columns[middle].min() / zoom == pytest.approx(20.5, abs=0.7)
    assert columns[middle].max() / zoom == pytest.approx(70.5, abs=0.7)


def test_vessel_that_no_branch_explains_is_red():
    view = blank_view()
    skeleton = np.zeros_like(view.mask)
    skeleton[60, 20:71] = True
    skeleton[90, 20:61] = True
    view = dataclasses.replace(view, skeleton=skeleton)
    tree = line_tree(view.carm)
    missing = unexplained(tree, view, OPTIONS)
    assert missing[90, 20:61].all() and not missing[60].any()
    judged = view_quality(tree, view, view.mask, OPTIONS)
    assert judged.coverage == pytest.approx(1 - missing.sum() / skeleton.sum())
    picture = picture_of(view, tree)
    zoom = picture.shape[1] // view.carm.columns
    assert tuple(picture[90 * zoom + zoom // 2, 40 * zoom + zoom // 2]) == RED
    assert unexplained(empty_tree(), view, OPTIONS).sum() == skeleton.sum()


@pytest.mark.parametrize(
    "shape", [(16, 16), (96, 96), (128, 96), (512, 512), (40, 1200), (1200, 40)]
)
def test_wide_enough_to_read_and_never_huge(shape):
    view = blank_view(*shape)
    picture = picture_of(view, empty_tree())
    assert picture.dtype == np.uint8 and picture.shape[2] == 3
    assert picture.shape[0] % shape[0] == 0 and max(picture.shape) <= 4096
    if max(shape) / min(shape) < 5:
        assert picture.shape[1] >= 768
    assert png_bytes(picture).startswith(b"\x89PNG")


def test_names_that_the_font_lacks_or_that_are_too_long():
    view = blank_view()
    judged = dataclasses.replace(JUDGED, view_id="ü" * 300)
    picture = picture_of(view, empty_tree(), judged)
    assert picture.shape[1] >= 768


def test_grey_stretch():
    ramp = np.linspace(100, 4000, 10_000, dtype=np.float32).reshape(100, 100)
    assert grey8(ramp).min() == 0 and grey8(ramp).max() == 255
    assert (grey8(np.full((20, 20), 7, np.float32)) == 0).all()
    lone = np.zeros((64, 64), np.float32)
    lone[3, 3] = 9
    assert grey8(lone)[3, 3] == 255


def test_colours_differ_and_leave_red_alone():
    colors = np.array([branch_color(k) for k in range(8)], float)
    gap = np.abs(colors[:, None] - colors[None]).max(axis=2)[~np.eye(8, dtype=bool)]
    assert gap.min() > 15
    assert np.linalg.norm(colors - RED, axis=1).min() > 90


def test_a_probable_ghost_is_dashed_and_told_in_the_legend():
    view = blank_view()
    tree = line_tree(view.carm)
    behind = backdrop(np.zeros((view.carm.rows, view.carm.columns), np.float32), view.mask)
    ghost = np.where(np.arange(60) < 30, 0.9, 0.1)
    plain, dashed = (overlay(behind, view, tree, JUDGED, told) for told in ((), (ghost,)))
    zoom = plain.shape[1] // view.carm.columns
    row = round(60.5 * zoom)

    def coloured(picture, first, last):
        line = picture[row - 1 : row + 2, round(first * zoom) : round(last * zoom)]
        return (line == branch_color(0)).all(axis=2).any(axis=0)

    assert coloured(plain, 22, 44).all()
    assert 0.3 < coloured(dashed, 22, 44).mean() < 0.7
    assert coloured(dashed, 47, 69).all()  # the other half is whole
    bottom = plain.shape[0] // 2
    assert (plain[bottom:] != dashed[bottom:]).any()


def drawn_texts(monkeypatch):
    """What is written from now on: text -> left, top, right, bottom."""
    told, keep = {}, overlays._text

    def write(canvas, text, at, size, *color):
        told[text] = (at[0], at[1] - round(22 * size), at[0] + overlays._width(text, size), at[1])
        keep(canvas, text, at, size, *color)

    monkeypatch.setattr(overlays, "_text", write)
    return told


def tree_of(carm, *lines):
    """Straight branches between pixels."""
    branches = []
    for line in lines:
        ends = carm.backproject(np.array(line, float), np.full(2, carm.sod_mm))
        points = ends[0] + np.linspace(0, 1, 60)[:, None] * (ends[1] - ends[0])
        flat = np.full(60, 1.5)
        branches.append(Branch(points_mm=points, radius_mm=flat, sigma_mm=flat * np.nan,
                               confidence=flat / 1.5, start=0, end=1))  # fmt: skip
    return Tree(nodes_mm=ends, branches=tuple(branches))


def test_numbers_stand_elsewhere_on_their_branch_where_its_middle_is_taken(monkeypatch):
    """Two that cross in their middles; one that begins beside the words at the top."""
    view, told = blank_view(512, 512), drawn_texts(monkeypatch)
    lines = [[(200, 200), (400, 400)], [(200, 400), (400, 200)], [(20, 24), (500, 24)]]
    picture_of(view, tree_of(view.carm, *lines))
    assert {"1", "2", "3"} <= told.keys()
    places = list(told.values())
    for k, a in enumerate(places):
        for b in places[:k]:
            assert a[0] >= b[2] or b[0] >= a[2] or a[1] >= b[3] or b[1] >= a[3], told
    for number, ((x0, y0), (x1, y1)) in enumerate(lines, start=1):
        zoom = 2
        x, _, _, y = told[str(number)]
        at = np.array([(x - 8) / zoom, (y + 6) / zoom])
        way = np.array([x1 - x0, y1 - y0]) / np.hypot(x1 - x0, y1 - y0)
        away = at - (x0, y0) - way * (way @ (at - (x0, y0)))
        assert np.linalg.norm(away) < 2


@pytest.mark.parametrize("low", [False, True])
def test_the_legend_stands_on_a_dark_plate_where_fewer_branches_lie(monkeypatch, low):
    view, told = blank_view(512, 512), drawn_texts(monkeypatch)
    row = 500 if low else 40
    tree = tree_of(view.carm, [(300, row), (500, row)])
    bright = np.tile(np.linspace(0, 1, 512, dtype=np.float32), (512, 1))
    picture = overlay(backdrop(bright, view.mask), view, tree, JUDGED)
    left, top, _, bottom = told["vessel not explained"]
    assert (bottom < picture.shape[0] / 2) == low
    # Between its lines' marks and words there is the plate alone.
    plate, beside = picture[top:bottom, left - 8 : left - 4], picture[700, left - 8 : left - 4]
    assert plate.mean() < 0.4 * beside.mean()


def test_a_catheter_has_a_colour_and_a_line_in_the_legend():
    view = blank_view()
    tree = line_tree(view.carm)
    device = np.zeros(view.mask.shape, bool)
    device[20:23, 5:30] = True
    pixels = np.zeros(view.mask.shape, np.float32)
    with_it = dataclasses.replace(view, catheter=device)
    picture = overlay(backdrop(pixels, view.mask, device), with_it, tree, JUDGED)
    plain = overlay(backdrop(pixels, view.mask), view, tree, JUDGED)
    zoom = picture.shape[1] // view.carm.columns
    grey = (picture == 200).all(axis=2)
    assert grey[20 * zoom : 23 * zoom, 5 * zoom : 30 * zoom].all()
    assert not (plain[20 * zoom : 23 * zoom, 5 * zoom : 30 * zoom] == 200).all(axis=2).any()
    bottom = plain.shape[0] // 2
    assert (plain[bottom:] != picture[bottom:]).any()


@pytest.mark.parametrize(("left_out", "more"), [
    (0.0, ""), (0.019, ""), (0.118, "; 12% of what looks like vessel was left out"),
])  # fmt: skip
def test_length_weight_and_what_was_left_out_are_said_together(left_out, more):
    said = f"69% of the length of the vessels seen is explained (94% weighed by thickness{more})"
    assert explained(0.94, 0.69, left_out) == said
    assert explained(None, None, 0.0).startswith("- of the vessels")
    assert "vessel without a partner" in LEFT_OUT


def test_the_share_left_out_is_of_all_that_looks_like_vessel():
    view = blank_view()
    mask, device = np.zeros((2, *view.mask.shape), bool)
    mask[60, 20:80], device[60, 75:90] = True, True
    tree = line_tree(view.carm)
    seen = dataclasses.replace(view, mask=mask, skeleton=mask, catheter=device)
    assert view_quality(tree, seen, mask, OPTIONS).left_out == pytest.approx(10 / 70)
    assert view_quality(tree, view, mask, OPTIONS).left_out == 0.0

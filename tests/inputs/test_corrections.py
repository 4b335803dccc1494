"""Corrections of an order: what was drawn, marked and deleted is what the run takes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gcar_deploy.config import RunOptions
from gcar_deploy.data.demo_case import demo_case
from gcar_deploy.engine import Engine
from gcar_deploy.errors import RefusedError, UsageError
from gcar_deploy.inputs.drawn import Drawn, Stroke
from gcar_deploy.inputs.order import Order, parse_order
from gcar_deploy.inputs.pictures import prepare

SQUARE = ((10.0, 10.0), (20.0, 10.0), (20.0, 20.0), (10.0, 20.0))


def test_strokes_are_rasters_and_the_last_one_wins():
    line = Stroke(do="erase", points=((5.0, 15.0), (40.0, 15.0)), width_px=3)
    square = Stroke(do="paint", points=SQUARE)
    erased, painted = Drawn(strokes=(line, square)).marks((50, 60))
    rows, cols = np.nonzero(painted)
    assert (rows.min(), rows.max(), cols.min(), cols.max()) == (10, 20, 10, 20)
    assert not (erased & painted).any() and erased[15, 30] and not erased[15, 15]
    assert set(np.nonzero(erased[:, 30])[0]) == {14, 15, 16}
    erased, painted = Drawn(strokes=(square, line)).marks((50, 60))
    assert erased[15, 15] and painted[11, 15] and not (erased & painted).any()


def test_a_dot_and_a_region():
    erased, _ = Drawn(strokes=(Stroke(do="erase", points=((8.0, 9.0),), width_px=5),)).marks(
        (20, 20)
    )
    assert erased[9, 8] and 9 <= erased.sum() <= 40
    inside = Drawn(region=SQUARE).inside((50, 60))
    assert inside.sum() == 121 and inside[10, 20] and Drawn().inside((5, 5)) is None


def test_a_stroke_outside_the_picture_is_told():
    """One whose points lie outside may still cross the picture."""
    case = demo_case()
    lines = [[[900, 900], [950, 900]], [[-90, 100], [900, 100]], [[30, 30], [40, 30]]]
    drawn = Drawn(strokes=tuple(
        Stroke(do="erase", points=tuple(map(tuple, line)), width_px=4) for line in lines
    ))  # fmt: skip
    _, _, notes = prepare(case.pictures, case.geometry, RunOptions(), drawn={1: drawn})
    assert "view 1: 2 strokes of the user erase vessel" in notes
    assert "view 1: of the user's strokes, 1 outside the picture: without effect" in notes


@pytest.fixture(scope="module")
def engine():
    return Engine(threads=1)


@pytest.fixture(scope="module")
def order():
    case = demo_case()
    return Order(views=case.pictures, geometry=case.geometry)


@pytest.fixture(scope="module")
def plain(engine, order):
    return engine.reconstruct_order(order)


CORRECTED = {
    "edits": {1: (Stroke(do="erase", points=SQUARE),)}, "deleted_mm": ((0.0, 0.0, 0.0),),
    "landmarks": (((200.0, 200.0), (200.0, 200.0)),),
}  # fmt: skip


@pytest.mark.parametrize("key", sorted(CORRECTED))
def test_corrections_are_refused_on_other_pictures_than_they_were_drawn_on(key, engine, order):
    told = dataclasses.replace(order, **{key: CORRECTED[key]}).with_drawn_on()
    assert [len(one) for one in told.drawn_on.values()] == [64, 64]
    first, second = order.views
    with pytest.raises(UsageError, match="view 1: what is drawn or marked was so on another"):
        again(engine, told, views=(second, first))
    # A view that is told stays as it is told, and without a correction nothing is.
    assert dataclasses.replace(told, views=(second, first)).with_drawn_on() == dataclasses.replace(
        told, views=(second, first)
    )
    assert order.with_drawn_on() == order
    freed = dataclasses.replace(told, **{key: {} if key == "edits" else None})
    assert freed.with_drawn_on() == order and not freed.drawn


def test_corrections_of_the_same_pictures_are_taken(engine, order):
    told = dataclasses.replace(order, edits=CORRECTED["edits"]).with_drawn_on()
    assert "view 1: 1 stroke of the user erases vessel" in again(engine, told).notes


def again(engine, order, **change):
    """The corrected order's result, after a way through JSON."""
    return engine.reconstruct_order(parse_order(dataclasses.replace(order, **change).to_dict()))


@pytest.mark.slow
def test_a_deleted_branch_is_gone_and_the_rest_stays(engine, order, plain):
    gone = plain.tree.branches[4]
    place = tuple(round(float(x), 1) for x in gone.points_mm[len(gone) // 2])
    found = again(engine, order, deleted_mm=(place, (500.0, 0.0, 0.0)))
    assert found.tree.length_mm == pytest.approx(plain.tree.length_mm - gone.length_mm, abs=1e-6)
    gap = np.linalg.norm(found.tree.points() - np.array(place), axis=1).min()
    assert gap > 3 and found.volume.sum() < plain.volume.sum() - 20
    assert any("deletion 2: no branch passes" in text for text in found.quality.findings)
    assert not any("deletion 1" in text for text in found.quality.findings)
    assert found.notes == (*plain.notes, "of the user: branches deleted (1)")


@pytest.mark.slow
def test_a_second_deletion_sees_the_tree_that_the_first_left(engine, order, plain):
    """Two branches that met at the fork of a deleted third are one, and go as one."""
    tree = plain.tree
    leaves = [b for b in tree.branches if tree.degrees[b.end] == 1]
    first = leaves[-1]
    a = again(engine, order, deleted_mm=(tuple(first.points_mm[len(first) // 2].tolist()),))
    second = max(a.tree.branches[1:], key=len)
    places = [tuple(b.points_mm[len(b) // 2].tolist()) for b in (first, second)]
    b = again(engine, order, deleted_mm=tuple(places))
    assert b.tree.length_mm == pytest.approx(a.tree.length_mm - second.length_mm, abs=1e-6)


def test_a_tree_of_which_all_is_deleted_is_refused_for_that(engine, order, plain):
    middles = (branch.points_mm[len(branch) // 2] for branch in plain.tree.branches)
    places = tuple(tuple(place.tolist()) for place in middles)
    with pytest.raises(RefusedError, match="every branch was deleted"):
        again(engine, order, deleted_mm=places * 2)


def test_marks_that_contradict_the_pictures_are_findings(engine, order, plain):
    """Points of two vessels as one landmark, an ostium where nothing begins."""
    tree, carms = plain.tree, [view.carm for view in plain.views]
    ends = tree.branches[-1].points_mm[-1], tree.branches[0].points_mm[0]
    mark = tuple(
        tuple(carm.project(end[None])[0][0].tolist()) for carm, end in zip(carms, ends, strict=True)
    )
    free = tree.nodes_mm[tree.degrees == 1]
    far = max(tree.points(), key=lambda point: np.linalg.norm(free - point, axis=1).min())
    ostium = tuple(tuple(carm.project(far[None])[0][0].tolist()) for carm in carms)
    found = again(engine, order, landmarks=(mark,), ostia=(ostium,))
    said = found.quality.findings
    assert found.quality.status == "degraded" and any("the landmarks" in text for text in said)
    assert "ostium 1: no vessel ends within 15 mm of it" in said
    assert not any("inlets" in note for note in found.notes)


def test_paint_is_vessel_as_wide_as_it_is_drawn(engine, order, plain):
    """A side branch that no picture shows, 3 mm wide, drawn in both."""
    carms = [view.carm for view in plain.views]
    own = [carm.project(plain.tree.points())[0] for carm in carms]
    clear, line = -1.0, np.zeros((0, 3))
    start = plain.tree.branches[4].points_mm[len(plain.tree.branches[4]) // 2]
    for way in np.random.default_rng(5).normal(size=(400, 3)):
        new = start + np.arange(31)[:, None] * way / np.linalg.norm(way)
        seen = [carm.project(new)[0] for carm in carms]
        inside = all((p > 30).all() and (p < 480).all() for p in seen)
        apart = min(cKDTree(o).query(p[10:])[0].min() for o, p in zip(own, seen, strict=True))
        length = min(np.linalg.norm(p[-1] - p[0]) for p in seen)
        if inside and length > 70 and apart > clear:
            clear, line = apart, new
    assert clear > 15
    edits = {}
    for k, carm in enumerate(carms, start=1):
        points = tuple(map(tuple, carm.project(line)[0].tolist()))
        width = 3.0 / carm.pixel_at_isocenter_mm
        edits[k] = (Stroke(do="paint", points=points, width_px=width),)
    found = again(engine, order, edits=edits)
    gap, at = cKDTree(found.tree.points()).query(line[8:-4])
    assert np.median(gap) < 0.5 and gap.max() < 2.0
    assert 2 * np.median(found.tree.radii()[at]) == pytest.approx(3.0, abs=0.4)
    assert found.quality.status == plain.quality.status


@pytest.mark.slow
def test_a_marked_ostium_is_where_the_tree_begins(engine, order, plain):
    tip = plain.tree.branches[-1].points_mm[-1]
    marks = tuple(tuple(view.carm.project(tip[None])[0][0].tolist()) for view in plain.views)
    found = again(engine, order, ostia=(marks,))
    assert np.linalg.norm(found.tree.branches[0].points_mm[0] - tip) < 1.0
    said = [note for note in found.notes if note not in plain.notes]
    assert said[0] == "of the user: inlets of an artery (1)"
    # It is the thin end of a vessel, which is not hidden.
    assert len(said) == 2 and said[1].startswith("ostium 1: the vessel is ")
    assert np.linalg.norm(plain.tree.branches[0].points_mm[0] - tip) > 20.0


def test_erased_vessel_is_not_found_and_is_said(engine, order, plain):
    leaf = plain.tree.branches[-1]
    strokes = {}
    for k, view in enumerate(plain.views, start=1):
        line = view.carm.project(leaf.points_mm[5:])[0]
        points = tuple((float(c), float(r)) for c, r in line[::4])
        strokes[k] = (Stroke(do="erase", points=points, width_px=14.0),)
    found = again(engine, order, edits=strokes)
    gap = np.linalg.norm(found.tree.points() - leaf.points_mm[-1], axis=1).min()
    assert gap > 3 and "view 1: 1 stroke of the user erases vessel" in found.notes
    for k, view in enumerate(found.views):
        assert view.path_mm.sum() < plain.views[k].path_mm.sum()


def test_nothing_left_is_refused(engine, order):
    everything = Stroke(
        do="erase", points=((-9.0, -9.0), (999.0, -9.0), (999.0, 999.0), (-9.0, 999.0))
    )
    with pytest.raises(RefusedError, match="no vessel is left in view 1"):
        again(engine, order, edits={1: (everything,)})

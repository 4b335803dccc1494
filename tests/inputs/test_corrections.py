"""Corrections of an order: what was drawn, marked and deleted is what the run takes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.data.demo_case import demo_case
from gcar_deploy.engine import Engine
from gcar_deploy.errors import RefusedError
from gcar_deploy.inputs.drawn import Drawn, Stroke
from gcar_deploy.inputs.order import Order, parse_order

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
    assert any("deleted branch 2: none passes" in text for text in found.quality.findings)
    assert not any("deleted branch 1" in text for text in found.quality.findings)
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


@pytest.mark.slow
def test_a_marked_ostium_is_where_the_tree_begins(engine, order, plain):
    tip = plain.tree.branches[-1].points_mm[-1]
    marks = tuple(tuple(view.carm.project(tip[None])[0][0].tolist()) for view in plain.views)
    found = again(engine, order, ostia=(marks,))
    assert np.linalg.norm(found.tree.branches[0].points_mm[0] - tip) < 1.0
    assert found.notes == (*plain.notes, "of the user: inlets of an artery (1)")
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
    assert gap > 3 and "view 1: 1 strokes of the user erase vessel" in found.notes
    for k, view in enumerate(found.views):
        assert view.path_mm.sum() < plain.views[k].path_mm.sum()


def test_nothing_left_is_refused(engine, order):
    everything = Stroke(
        do="erase", points=((-9.0, -9.0), (999.0, -9.0), (999.0, 999.0), (-9.0, 999.0))
    )
    with pytest.raises(RefusedError, match="no vessel is left in view 1"):
        again(engine, order, edits={1: (everything,)})

"""Gaps of a tree are bridged where every picture shows vessel in them, and nowhere else."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gcar_deploy.config import TubeOptions
from gcar_deploy.engine import Engine
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.fit import TubeFit, _fitted
from gcar_deploy.tubes.gaps import joined_in_pictures
from gcar_deploy.tubes.gauss_newton import Progress
from gcar_deploy.tubes.run import Run
from tests.tree.shapes import branch
from tests.tubes.scenes import seen, two_views

ANGLE = np.linspace(-0.7, 0.7, 141)
#: an arc of 40 mm radius, 56 mm long
LINE = 40.0 * np.stack([np.sin(ANGLE), np.cos(ANGLE) - 0.9, 0.5 * np.sin(ANGLE)], axis=1)
ARC = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(LINE, axis=0), axis=1))])


def vessel(line=LINE, radius=1.5):
    tube = branch(line, np.broadcast_to(radius, len(line)), 0, 1)
    return Tree(nodes_mm=line[[0, -1]], branches=(tube,))


def narrowed(least, length_mm=8.0):
    off = np.clip(2 * np.abs(ARC - ARC[70]) / length_mm, 0, 1)
    return 1.5 - (1.5 - least) * 0.5 * (1 + np.cos(np.pi * off))


def broken(first=60, second=80):
    before, after = LINE[: first + 1], LINE[second:]
    return Tree(
        nodes_mm=np.concatenate([before[[0, -1]], after[[0, -1]]]),
        branches=(
            branch(before, np.full(len(before), 1.5), 0, 1),
            branch(after, np.full(len(after), 1.3), 2, 3),
        ),
    )


def test_vessel_in_every_picture_makes_one_tube():
    views = seen(vessel(radius=narrowed(0.3)), two_views())
    tree = joined_in_pictures(broken(), views)
    (whole,) = tree.branches
    assert whole.length_mm == pytest.approx(ARC[-1], rel=0.01)
    assert cKDTree(LINE).query(whole.points_mm)[0].max() < 0.5
    assert np.diff(whole.arc_mm).max() < 1.0
    assert len(tree.nodes_mm) == 2 and set(tree.degrees) == {1}
    inside = (whole.arc_mm > ARC[61]) & (whole.arc_mm < ARC[79])
    assert inside.any() and (np.abs(whole.radius_mm[inside] - 1.4) <= 0.1 + 1e-9).all()


@pytest.mark.parametrize("blind", [0, 1])
def test_a_break_of_a_thin_lumen_in_one_picture_is_none(blind):
    views = seen(vessel(radius=narrowed(0.3)), two_views())
    columns, rows = np.meshgrid(np.arange(256), np.arange(256))
    ((column, row),) = views[blind].carm.project(LINE[70:71])[0]
    mask = views[blind].mask & (np.hypot(columns - column, rows - row) > 2.0)
    assert mask.sum() < views[blind].mask.sum()
    views[blind] = dataclasses.replace(views[blind], mask=mask)
    assert len(joined_in_pictures(broken(), views).branches) == 1


@pytest.mark.parametrize("blind", [0, 1])
def test_a_gap_in_one_picture_stays_one(blind):
    tree = broken(56, 84)
    whole, gap = seen(vessel(), two_views()), seen(tree, two_views())
    views = [gap[k] if k == blind else whole[k] for k in range(2)]
    assert joined_in_pictures(tree, views) is tree


def test_vessel_beside_the_gap_is_another():
    # Beside it in either picture.
    rays = [view.source_mm / np.linalg.norm(view.source_mm) for view in two_views()]
    other = vessel(LINE + 5.0 * np.cross(*rays) / np.linalg.norm(np.cross(*rays)))
    pictures = [
        dataclasses.replace(a, mask=a.mask | b.mask)
        for a, b in zip(seen(broken(), two_views()), seen(other, two_views()), strict=True)
    ]
    tree = broken()
    assert joined_in_pictures(tree, pictures) is tree


def test_a_lesion_just_behind_a_fork_is_bridged_and_a_scrap_is_not():
    side = LINE[50] + np.linspace(0, 12, 25)[:, None] * [0.0, 0.0, 1.0]
    whole, cut = vessel(radius=narrowed(0.3)), broken()
    pieces = (LINE[:51], LINE[50:61], side, LINE[80:])
    stub = Tree(
        nodes_mm=np.stack([LINE[0], LINE[50], LINE[60], side[-1], LINE[80], LINE[-1]]),
        branches=tuple(
            branch(line, np.full(len(line), 1.4), *ends)
            for line, ends in zip(pieces, ((0, 1), (1, 2), (1, 3), (4, 5)), strict=True)
        ),
    )
    assert stub.branches[1].length_mm < 5.0
    views = seen(whole, two_views())
    assert joined_in_pictures(stub, views) is stub
    assert len(joined_in_pictures(stub, views, fitted=True).part_lengths_mm()) == 1
    scrap = Tree(
        nodes_mm=np.stack([*cut.nodes_mm[:2], LINE[66], LINE[76]]),
        branches=(cut.branches[0], branch(LINE[66:77], np.full(11, 1.4), 2, 3)),
    )
    assert joined_in_pictures(scrap, views, fitted=True) is scrap


def test_ends_that_the_fit_has_turned_are_asked_again():
    """Of the points' tree they point past each other; the pictures turn them."""
    views = seen(vessel(radius=narrowed(0.3)), two_views())
    aside = np.clip((ARC - ARC[52]) / (ARC[60] - ARC[52]), 0, 1)[:, None] * [0.0, 0.0, 3.5]
    start = broken()
    bent = dataclasses.replace(start.branches[0], points_mm=(LINE + aside)[:61])
    start = Tree(
        nodes_mm=np.concatenate([bent.points_mm[[0, -1]], start.nodes_mm[2:]]),
        branches=(bent, start.branches[1]),
    )
    assert joined_in_pictures(start, views) is start
    points = CenterPoints(
        points_mm=start.points(), confidence=np.ones(len(start.points())),
        radius_mm=start.radii(), spacing_mm=1.0, source="multi",
    )  # fmt: skip
    given = TubeFit(tree=start, centers=points, contrast=(1.0, 1.0), progress=Progress())
    found = _fitted(given, views, Run(TubeOptions(), given.progress, None, None))
    assert len(found.tree.part_lengths_mm()) == 1
    assert cKDTree(found.tree.points()).query(LINE)[0].max() < 1.0


def test_ends_far_from_each_other_stay_ends():
    views, near, far = seen(vessel(), two_views()), broken(59, 81), broken(58, 84)
    assert len(joined_in_pictures(near, views).branches) == 1
    assert joined_in_pictures(far, views) is far


def bent(half_deg):
    """Straight for 25 mm on both sides of a bend of 5 mm radius; halves end before and after it."""
    turn = np.radians(np.linspace(-half_deg, half_deg, 41))
    bend = 5.0 * np.stack([np.sin(turn), np.cos(turn), np.zeros(41)], axis=1)
    along = np.linspace(25.0, 0.25, 100)[:, None]
    before = bend[0] - along * [np.cos(turn[-1]), np.sin(turn[-1]), 0.0]
    after = bend[-1] + along[::-1] * [np.cos(turn[-1]), -np.sin(turn[-1]), 0.0]
    halves = tuple(
        branch(line, np.full(len(line), 0.8), 2 * k, 2 * k + 1)
        for k, line in enumerate((before, after))
    )
    nodes = np.stack([before[0], before[-1], after[0], after[-1]])
    return vessel(np.concatenate([before, bend, after]), 0.8), Tree(nodes_mm=nodes, branches=halves)


def test_a_vessel_that_bends_in_its_gap_is_one():
    whole, halves = bent(45)
    (found,) = joined_in_pictures(halves, seen(whole, two_views())).branches
    (line,) = whole.branches
    assert cKDTree(found.points_mm).query(line.points_mm)[0].max() < 1.0


def test_ends_that_point_past_each_other_stay_ends():
    whole, halves = bent(55)
    assert joined_in_pictures(halves, seen(whole, two_views())) is halves


def at_the_border(view):
    """Move a C-arm until its picture ends within the gap."""
    for off in np.arange(0.0, 200.0, 2.0):
        moved = view.moved((-off, 0.0, 0.0))
        inside = ((moved.project(LINE)[0] >= 0) & (moved.project(LINE)[0] < 256)).all(axis=1)
        if inside[60] != inside[80]:
            return moved
    raise AssertionError("no such place")


def test_a_gap_at_the_border_of_a_picture_stays_one():
    views = seen(vessel(), [at_the_border(view) for view in two_views()])
    tree = broken()
    assert joined_in_pictures(tree, views) is tree


@pytest.mark.parametrize("least", [0.2, 0.3])
def test_a_tight_stenosis_of_two_masks_is_found(least):
    truth = vessel(radius=narrowed(least))
    pictures = [
        Angiogram(
            view_id=view.view_id, carm=view.carm, bit_depth=8, sha256=view.view_id,
            pixels=np.float32(255) * (view.path_mm > 0.02),
            intensity=Intensity(kind="mask", polarity="bright"),
        )
        for view in seen(truth, two_views(512, 0.2))
    ]  # fmt: skip
    grid = Grid(center_mm=(0, 0, 0), size_mm=(96, 96, 96), shape=(96, 96, 96))
    result = Engine().reconstruct(pictures, grid)
    (tube,) = result.tree.branches
    assert tube.length_mm > ARC[-1] - 4.0
    (lumen,) = result.measured.lumens
    assert lumen.sections.diameter_mm.min() == pytest.approx(2 * least, abs=0.25)
    assert lumen.stenosis_percent == pytest.approx(100 * (1 - least / 1.5), abs=9.0)

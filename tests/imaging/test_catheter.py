"""Scenes whose catheter is known: it goes, and vessels that reach the border stay."""

from __future__ import annotations

import logging
from unittest import mock

import cv2
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from gcar_deploy.config import ImagingOptions
from gcar_deploy.imaging import catheter, segment
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.imaging.learned import devices, vessel_lines
from gcar_deploy.imaging.linegraph import LineGraph
from gcar_deploy.imaging.pictures import vessel_pictures
from gcar_deploy.imaging.resample import resized
from gcar_deploy.imaging.shaft import shaft
from gcar_deploy.imaging.skeleton import skeletonize
from tests.imaging.phantoms import angiogram, dice, raw_picture

_SIDE, _MM, _FINE = 240, 0.5, 4
_OPTIONS = ImagingOptions()

#: (col, row) px through which a smooth tube runs, and its radius at both ends, mm
_MAIN = ([(78, 70), (110, 62), (150, 85), (165, 130), (150, 180)], 1.9, 1.3)
_SIDE_BRANCH = ([(150, 85), (190, 95), (205, 130)], 1.0, 0.7)
_SECOND_BRANCH = ([(165, 130), (130, 150), (90, 190)], 1.0, 0.7)
_TREE = (_MAIN, _SIDE_BRANCH, _SECOND_BRANCH)
_CATHETERS = {
    "from above": ([(60, -8), (52, 30), (58, 60), (78, 70)], 0.9, 0.9),
    "from the side": ([(-8, 40), (25, 42), (55, 58), (78, 70)], 0.8, 0.8),
    "in a loop": ([(120, -8), (75, 5), (48, 35), (55, 66), (78, 70)], 1.0, 1.0),
}
#: vessels that leave the field: a main one, zoomed in; the tapering end of one; a side branch
#: of one that goes on to both sides
_LEAVING = {
    "zoomed": (([(-8, 60), (60, 66), (120, 80), (160, 130), (170, 190)], 2.0, 1.2), _SIDE_BRANCH),
    "tapering": (([(60, 60), (110, 70), (150, 120), (190, 180), (215, 250)], 1.9, 0.9),),
    "side branch": (
        ([(20, 170), (80, 140), (140, 120), (200, 110), (225, 60)], 1.8, 1.4),
        ([(120, 125), (105, 70), (110, 30), (100, -8)], 0.9, 0.8),
    ),
}


def _tubes(tubes, side=_SIDE):
    """(side, side) mean chord, mm, of tubes in the plane of the detector."""
    path = np.zeros((side * _FINE,) * 2, np.float32)
    for points, first, last in tubes:
        points = np.asarray(points, float)
        t = np.r_[0, np.cumsum(np.hypot(*np.diff(points, axis=0).T))]
        at = np.linspace(0, t[-1], 1000)
        curve = np.rint(CubicSpline(t, points)(at) * _FINE + 0.5 * (_FINE - 1)).astype(int)
        free = np.ones((side * _FINE + 200,) * 2, np.uint8)
        radius = np.zeros(free.shape, np.float32)
        inside = ((curve > -100) & (curve < side * _FINE + 100)).all(axis=1)
        column, row = curve[inside].T + 100
        free[row, column], radius[row, column] = 0, np.linspace(first, last, 1000)[inside]
        gap, label = cv2.distanceTransformWithLabels(
            free, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        table = np.zeros(label.max() + 1, np.float32)
        table[label[free == 0]] = radius[free == 0]
        chord = 2 * np.sqrt(np.clip(table[label] ** 2 - (gap * _MM / _FINE) ** 2, 0, None))
        path = np.maximum(path, chord[100:-100, 100:-100])
    return cv2.resize(path, (side, side), interpolation=cv2.INTER_AREA)


def _found(tubes, seed=0):
    return extract_vessels(angiogram(raw_picture(_tubes(tubes), seed=seed), pixel_mm=_MM), _OPTIONS)


def _kept(tubes, seed=0):
    """Find vessels where nothing is taken for a catheter."""
    with mock.patch.object(segment, "catheters", lambda line, *_: np.zeros_like(line)):
        return _found(tubes, seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", sorted(_CATHETERS))
def test_a_catheter_goes_and_the_vessels_stay(name, seed):
    tube = _CATHETERS[name]
    found, clean = _found((*_TREE, tube), seed=seed), _found(_TREE, seed=seed)
    own = skeletonize(_tubes([tube]) > 0)
    row, column = np.indices(own.shape)
    own &= np.hypot(column - 78, row - 70) * _MM > 5.0  # what is blurred into the ostium
    assert (found.mask & own).sum() < 0.1 * own.sum()
    assert (found.catheter & own).sum() > 0.8 * own.sum()
    assert not (found.catheter & found.mask).any()
    assert found.catheter_mm == pytest.approx(own.sum() * _MM, rel=0.4)
    assert dice(found.mask, clean.mask) > 0.94


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", sorted(_LEAVING))
def test_a_vessel_that_leaves_the_field_stays(name, seed):
    found, kept = _found(_LEAVING[name], seed=seed), _kept(_LEAVING[name], seed)
    assert found.catheter_mm == 0 and not found.catheter.any()
    np.testing.assert_array_equal(found.mask, kept.mask)


def _told(tubes, device):
    """What a network would say of tubes all of which it sees: those of ``device`` are no vessel."""
    path = _tubes(tubes)
    reach, line = vessel_lines(np.where(path > 0.4, np.float32(0.97), np.float32(0.02)))
    other = (_tubes([device]) > 0.4) if device else np.zeros(path.shape, bool)
    return np.where(other & reach, np.float32(0.97), np.float32(0)), reach, line


def _gone(tubes, device):
    picture = -np.log(raw_picture(_tubes(tubes)))
    return devices(*_told(tubes, device), picture, np.zeros(picture.shape, bool))


def test_what_the_network_calls_a_device_goes_and_what_it_feeds_stays():
    (above, shaft, *_), radius, _ = _CATHETERS["from above"]
    tubes, part = (*_TREE, _CATHETERS["from above"]), ([above, shaft], radius, radius)
    gone = _gone(tubes, part)
    own = skeletonize(_tubes([part]) > 0)
    vessel = skeletonize(_tubes(_TREE) > 0)
    row, column = np.indices(gone.shape)
    away = np.hypot(column - 78, row - 70) * _MM > 5.0
    assert (gone & own).sum() > 0.85 * own.sum()
    assert not (gone & vessel & away).any()


def test_the_whole_tree_is_no_device_whatever_the_network_says():
    assert not (_gone([_MAIN], _MAIN) & (_tubes([_MAIN]) > 0.4)).any()


@pytest.mark.parametrize("name", sorted(_LEAVING))
def test_a_vessel_of_the_network_that_leaves_the_field_stays(name):
    assert not _gone(_LEAVING[name], None).any()


def test_a_lead_across_the_field_goes():
    lead = ([(30, -8), (74, 80), (114, 160), (160, 248)], 0.7, 0.7)
    tree = [([(x + 60, y) for x, y in points], a, b) for points, a, b in (_MAIN,)]
    with_lead, clean = _found((*tree, lead)), _found(tree)
    own = skeletonize(_tubes([lead]) > 0)
    assert (with_lead.mask & own).sum() < 0.1 * own.sum()
    assert dice(with_lead.mask, clean.mask) > 0.9


def test_a_catheter_is_seen_before_it_goes():
    tube = _CATHETERS["from above"]
    own = skeletonize(_tubes([tube]) > 0)
    assert (_kept((*_TREE, tube)).mask & own).sum() > 0.85 * own.sum()


def test_most_of_the_line_is_never_taken_away(monkeypatch):
    # a long catheter before one vessel
    scene = [_MAIN, _CATHETERS["in a loop"]]
    assert _found(scene).catheter_mm == 0
    monkeypatch.setattr(catheter, "LARGEST_SHARE", 0.9)
    assert _found(scene).catheter_mm > 35


_OTHER_SCENES = ("in a loop", "zoomed", "side branch")


@pytest.mark.parametrize(
    "scene",
    ["from above", *(pytest.param(s, marks=pytest.mark.slow) for s in _OTHER_SCENES)],
)
def test_turned_and_mirrored_pictures_decide_alike(scene):
    tubes = (*_TREE, _CATHETERS[scene]) if scene in _CATHETERS else _LEAVING[scene]
    picture = raw_picture(_tubes(tubes), ramp=0.0)
    upright = extract_vessels(angiogram(picture, pixel_mm=_MM), _OPTIONS)
    assert (upright.catheter_mm > 0) == (scene in _CATHETERS)
    for mirrored in (False, True):
        for quarter in range(4):
            turned = np.rot90(picture[:, ::-1] if mirrored else picture, quarter)
            found = extract_vessels(angiogram(turned.copy(), pixel_mm=_MM), _OPTIONS)
            back = np.rot90(found.catheter, -quarter)
            back = back[:, ::-1] if mirrored else back
            assert found.catheter_mm == pytest.approx(upright.catheter_mm, abs=4.0)
            if upright.catheter_mm > 0:
                assert dice(back, upright.catheter) > 0.85


def test_it_is_said_and_drawn(caplog, monkeypatch):
    # The command line, where other tests used it, keeps the package's messages to itself.
    monkeypatch.setattr(logging.getLogger("gcar_deploy"), "propagate", True)
    with caplog.at_level(logging.INFO, logger="gcar_deploy"):
        found = _found((*_TREE, _CATHETERS["from above"]))
    assert f"{found.catheter_mm:.0f} mm of line taken for a catheter" in caplog.text
    steps = vessel_pictures(found)["steps.png"]
    colours = steps[found.catheter & ~found.skeleton]
    assert (colours == colours[0]).all() and colours[0, 2] > 2 * colours[0, :2].max()
    assert (steps[found.skeleton] == steps[found.skeleton][0]).all()
    half = resized(found, _SIDE // 2, _SIDE // 2)
    assert half.catheter.sum() == pytest.approx(found.catheter.sum() / 4, rel=0.2)


def test_the_graph_of_a_line():
    line = np.zeros((9, 12), bool)
    line[4, 1:11] = line[2:4, 5] = True  # ten pixels, and two that hang on the fifth
    line[5, 10] = True  # a corner, no fork
    graph = LineGraph(line)
    assert graph.ends(np.ones_like(line)) == [(2, 5), (4, 1), (5, 10)]
    path, spurs = graph.walk((4, 1), spur_px=4, longest_px=99)
    assert path[0] == (4, 1) and path[-1] == (5, 10) and spurs == {(2, 5), (3, 5)}
    stopped, _ = graph.walk((4, 1), spur_px=1, longest_px=99)
    assert stopped[-1] == (4, 5)
    far = graph.distances((4, 1), 100, ())
    assert far[5, 10] == pytest.approx(10) and far[2, 5] == pytest.approx(6)
    assert graph.shortest(far, (2, 5)) == [(4, 1), (4, 2), (4, 3), (4, 4), (4, 5), (3, 5), (2, 5)]
    assert len(graph.branches(far, 5, 6)) == 2


def _course(wriggle=0.0, rows=200):
    """(rows, 100) line from the upper border: a quarter of a wave, and a wriggle on it, pixels."""
    row = np.arange(rows)
    column = 20 + 40 * np.sin(row / 130) + wriggle * np.sin(row / 5)
    return _lines(np.stack([column, row], 1), shape=(200, 100))


@pytest.mark.parametrize(
    ("line", "first", "last", "is_one"),
    [
        (_course, 2.4, 2.4, True),
        (_course, 2.4, 2.0, False),  # tapers
        (_course, 4.0, 4.0, False),  # as wide as the main vessels
        (lambda: _course(wriggle=2.5), 2.4, 2.4, False),
        (lambda: _course(rows=50), 2.4, 2.4, False),  # short
    ],
)
def test_a_shaft_is_long_even_smooth_and_thinner_than_the_main_vessels(line, first, last, is_one):
    line = line()
    graph = LineGraph(line)
    end = graph.ends(line)[0]
    width = np.repeat(np.linspace(first, last, 200, dtype=np.float32)[:, None], 100, axis=1)
    found = shaft(graph, end, width, 5.0, _MM)
    assert len(found) == (line.sum() if is_one else 0)


def test_a_shaft_ends_where_it_widens_or_meets_another_line():
    crossed = _course() | _lines([(2, 120), (98, 124)], shape=(200, 100))
    width = np.full(crossed.shape, 2.4, np.float32)
    width[140:] = 4.0
    for line, last in ((_course(), range(130, 145)), (crossed, range(115, 127))):
        graph = LineGraph(line)
        end = next(p for p in graph.ends(line) if p[0] == 0)
        assert max(row for row, _ in shaft(graph, end, width, 5.0, _MM)) in last


def _lines(*ways, shape=(60, 60)):
    line = np.zeros(shape, np.uint8)
    for way in ways:
        cv2.polylines(line, [np.array(way, np.int32)], False, 1)
    return skeletonize(line > 0)

"""Hard cases of the pictures and the geometry: 18 families, six variants each.

The other six families (what goes wrong inside the optimiser) are in ``test_optimiser.py``.
A case is (variant, function that makes the angiograms, classes it may end in, true tree or None).
Where a case may end ``ok`` it has a tree to be near to: the true one, or, where the pictures
cannot show that the input is wrong, the tree that the wrong input describes (``described``).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Intensity
from tests.hard.phantoms import (
    DONE,
    GRID,
    NOT_OK,
    PAIR,
    SIDE,
    angiogram,
    bars,
    both,
    carm,
    changed,
    described,
    helix,
    path_of,
    paths,
    raw,
    seven,
    straight,
    told,
)  # fmt: skip

REFUSED = {"refused"}
DARK = Intensity(kind="raw", polarity="dark")
TREE = seven()


def turned(angle):
    return (carm(-angle / 2, 10), carm(angle / 2, 10))


def of(tree, views):
    return lambda: paths(tree, views)


def separation_extremes():
    for angle, allowed in ((2, REFUSED), (4, REFUSED), (177, NOT_OK), (12, NOT_OK), (20, NOT_OK),
                           (165, NOT_OK)):  # fmt: skip
        yield f"{angle} deg", of(TREE, turned(angle)), allowed, TREE


def separation_sweep():
    for angle in (30, 50, 70, 90, 110, 145):
        yield f"{angle} deg", of(TREE, turned(angle)), DONE, TREE


def in_the_epipolar_plane():
    # Views that turn about z have their central epipolar plane at z = 0.
    for tilt in (0, 2, 5, 10, 20, 30):
        axis = (np.cos(np.radians(tilt)), 0.3, np.sin(np.radians(tilt)))
        tree = both(straight(axis, 44.0, 1.5), straight((0.1, 0.2, 1.0), 40.0, 1.3, (12, 9, 2)))
        yield f"{tilt} deg out of it", of(tree, (carm(-40), carm(45))), DONE, tree


def foreshortened():
    d = PAIR[0].axes[2]
    side = np.cross(d, [0.3, 0.2, 1.0])
    side /= np.linalg.norm(side)
    for tilt in (0, 4, 8, 12, 16, 20):
        axis = np.cos(np.radians(tilt)) * d + np.sin(np.radians(tilt)) * side
        tree = both(straight(axis, 44.0, 1.6), straight((0.5, 0.3, 1.0), 40.0, 1.3, (10, 12, 3)))
        yield f"{tilt} deg off the beam", of(tree, PAIR), DONE, tree


def ghosts():
    for count in (2, 3, 4):
        for gap in (9.0, 14.0):
            tree = bars(count, gap)
            yield f"{count} bars {gap:g} mm apart", of(tree, (carm(-40), carm(45))), DONE, tree


def nothing_to_see():
    full = [lambda p: np.full_like(p, 65535.0), lambda p: np.zeros_like(p)]
    yield "both blank", lambda: changed(paths(TREE), full[1]), REFUSED, None
    yield "view 2 blank", lambda: changed(paths(TREE), full[1], 1), REFUSED, None
    yield "all saturated", lambda: changed(paths(TREE), full[0]), REFUSED, None
    yield "view 1 saturated", lambda: changed(paths(TREE), full[0], 0), REFUSED, None
    yield "constant", lambda: changed(paths(TREE), lambda p: np.full_like(p, 900.0)), REFUSED, None
    yield (
        "raw without vessels",
        lambda: raw(straight(length=1.0, radius=0.3), photons=300, mu=1e-6),
        REFUSED, None,
    )  # fmt: skip


def hardly_any_vessel():
    def dot(p):
        out = np.zeros_like(p)
        out[64, 64] = 2000.0
        return out

    def stub(p):
        out = dot(p)
        out[64, 65] = 2000.0
        return out

    def thin(p):
        out = np.zeros_like(p)
        out[:, 64] = 900.0
        return out

    yield "one pixel", lambda: changed(paths(TREE), dot), REFUSED, None
    yield "two pixels", lambda: changed(paths(TREE), stub), REFUSED, None
    yield "one column", lambda: changed(paths(TREE, turned(70)), thin), REFUSED, None
    edge = straight((0, 0, 1.0), 60.0, 1.4, (38, 0, 0))
    yield "along the border", of(edge, PAIR), DONE, edge
    long = straight((0.3, 0.2, 1.0), 120.0, 1.5)
    yield "beyond the picture", of(long, PAIR), DONE, long
    short = straight(length=27.0)
    yield "27 mm of vessel", of(short, PAIR), DONE, short


def wrong_geometry():
    a, b = PAIR
    normal = np.cross(a.axes[2], b.axes[2])
    normal /= np.linalg.norm(normal)
    within = np.cross(normal, b.axes[2])
    pictures = paths(TREE)
    moved = b.moved(5.0 * within)
    for name, other, allowed, truth in (
        ("primary 1 deg", b.turned(1.0), DONE, TREE),
        ("primary 5 deg", b.turned(5.0), NOT_OK, None),
        ("secondary 5 deg", b.turned(0.0, 5.0), NOT_OK, None),
        ("5 mm along the rotation axis", b.moved(5.0 * normal), DONE, TREE),
        # Ten times the stated prior without a trace: ``gcar validate`` says so, no sigma can.
        ("5 mm within the plane", moved, DONE, described(TREE, PAIR, (a, moved))),
        ("SDD 3 %", dataclasses.replace(b, sdd_mm=1.03 * b.sdd_mm), NOT_OK, None),
    ):
        yield name, lambda v=other: told(pictures, (a, v)), allowed, truth


def unlike_views():
    a, b = PAIR
    for name, other in (
        ("other magnification", dataclasses.replace(b, sdd_mm=1050.0)),
        ("other size", dataclasses.replace(b, rows=160, columns=144)),
        ("other pitch", dataclasses.replace(b, rows=192, columns=192, pixel_spacing_mm=(0.8,) * 2)),
        ("pixels not square", dataclasses.replace(b, pixel_spacing_mm=(1.1, 1.3))),
        ("detector turned", dataclasses.replace(b, detector_rotation_deg=20.0)),
        ("principal point off", dataclasses.replace(b, principal_point_px=(70.0, 57.0))),
    ):
        yield name, of(TREE, (a, other)), DONE, TREE


def bit_depths():
    for step in (1, 4, 16, 40, 80, 160):

        def make(step=step):
            kind = Intensity(kind="path_length", polarity="bright", mm_per_count=0.001 * step)
            return [
                angiogram(v, np.rint(path_of(TREE, v) * 1000 / step), str(k), kind, 8)
                for k, v in enumerate(PAIR)
            ]

        yield f"{0.001 * step:g} mm a count", make, DONE, TREE


def polarities():
    lying = Intensity(kind="path_length", polarity="dark", mm_per_count=0.001)
    yield (
        "path length said to be dark",
        lambda: [dataclasses.replace(p, intensity=lying) for p in paths(TREE)],
        {"error 4"}, None,
    )  # fmt: skip
    for said in ("dark", "bright"):
        yield f"raw {said}", lambda s=said: raw(TREE, polarity=s), DONE, TREE
    for said, other in (("dark", "bright"), ("bright", "dark")):
        kind = Intensity(kind="raw", polarity=other)
        yield (
            f"raw {said} said to be {other}",
            lambda s=said, k=kind: [
                dataclasses.replace(p, intensity=k) for p in raw(TREE, polarity=s)
            ],
            NOT_OK, None,
        )  # fmt: skip
    inverted = lambda: changed(paths(TREE), lambda p: p.max() - p)  # noqa: E731
    yield "path length inverted", inverted, REFUSED, None


def log_or_linear():
    bright = Intensity(kind="attenuation", polarity="bright")
    for gain in (20.0, 200.0):
        yield (
            f"attenuation times {gain:g}",
            lambda g=gain: [
                angiogram(v, g * path_of(TREE, v), str(k), bright) for k, v in enumerate(PAIR)
            ],
            DONE, TREE,
        )  # fmt: skip
    yield "linear", lambda: raw(TREE, photons=1e5), DONE, TREE
    yield "linear said to be log", lambda: raw(TREE, kind="attenuation"), DONE, TREE
    yield (
        "log said to be linear",
        lambda: [
            angiogram(v, 255 - 10 * path_of(TREE, v), str(k), DARK, 8)
            for k, v in enumerate(PAIR)
        ],
        DONE, TREE,
    )  # fmt: skip
    yield "strong contrast", lambda: raw(TREE, mu=0.5), DONE, TREE


def noise():
    for photons in (1e2, 1e3, 1e4, 1e5):
        yield f"{photons:g} photons", lambda n=photons: raw(TREE, photons=n), DONE, TREE
    yield "saturated", lambda: raw(TREE, add=lambda g: np.minimum(1.6 * g, 255)), NOT_OK, None

    def dead(grey):
        grey = grey.copy()
        grey[40:43] = 0.0
        return grey

    yield "dead rows", lambda: raw(TREE, add=dead), NOT_OK, None


def clutter():
    rows, cols = np.mgrid[:SIDE, :SIDE]

    def wire(g):
        return g - 60 * (np.abs(rows - 0.4 * cols - 20) < 1.5)

    def text(g):
        g = g.copy()
        g[4:12, 6:60:4] = 0
        return g

    def collimator(g):
        return np.where((rows < 12) | (cols > 115), 0, g)

    for name, add, allowed in (
        ("catheter", wire, NOT_OK),
        ("gradient", lambda g: g * (0.5 + 0.5 * cols / SIDE), DONE),
        ("spine", lambda g: g - 40 * np.exp(-(((cols - 40) / 12.0) ** 2)), DONE),
        ("diaphragm", lambda g: g - 50 / (1 + np.exp(-(rows - 90 + 0.2 * cols) / 2.0)), DONE),
        ("text", text, DONE),
        ("collimator", collimator, DONE),
    ):
        truth = TREE if allowed == DONE else None
        yield name, lambda f=add: raw(TREE, add=f), allowed, truth


def motion():
    a, b = PAIR
    normal = np.cross(a.axes[2], b.axes[2])
    normal /= np.linalg.norm(normal)

    def moved(change):
        other = dataclasses.replace(
            TREE,
            nodes_mm=change(TREE.nodes_mm),
            branches=tuple(
                dataclasses.replace(p, points_mm=change(p.points_mm)) for p in TREE.branches
            ),
        )
        return lambda: [paths(TREE, (a,))[0], angiogram(b, 1000 * path_of(other, b), "2")]

    turn = np.radians(3.0)
    R = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    # A tree moved by x in view 2 is that view moved by -x.
    within = 5.0 * np.cross(normal, b.axes[2])
    apart = described(TREE, (a, b.moved(within)), PAIR)
    for name, change, allowed, truth in (
        ("2 mm along the axis", lambda x: x + 2.0 * normal, DONE, TREE),
        ("5 mm along the axis", lambda x: x + 5.0 * normal, DONE, TREE),
        ("10 mm along the axis", lambda x: x + 10.0 * normal, NOT_OK, None),
        ("5 mm within the plane", lambda x: x + within, DONE, apart),
        ("3 deg", lambda x: x @ R.T, NOT_OK, None),
        ("not rigid", lambda x: x * [1.0, 1.0, 1.06] + [0, 0, 1.0], DONE, TREE),
    ):
        yield name, moved(change), allowed, truth


def flips():
    pictures = paths(TREE)
    last = np.array([SIDE - 1, SIDE - 1])
    # The pictures of the tree's point reflection: nothing in them says which one was there.
    reflected = described(TREE, PAIR, PAIR, lambda pixels: last - pixels)
    yield "view 2 left-right", lambda: changed(pictures, lambda p: p[:, ::-1], 1), NOT_OK, None
    yield "view 2 up-down", lambda: changed(pictures, lambda p: p[::-1], 1), NOT_OK, None
    turned_over = lambda: changed(pictures, lambda p: p[::-1, ::-1])  # noqa: E731
    yield "both turned by 180 deg", turned_over, DONE, reflected
    yield "both transposed", lambda: changed(pictures, lambda p: p.T), NOT_OK, None
    yield "views swapped", lambda: told(pictures, PAIR[::-1]), NOT_OK, None
    mirrored = (carm(30, -20), carm(-45, 25))
    yield "LAO for RAO", lambda: told(pictures, mirrored), NOT_OK, None


def contradictory():
    for first, second in (
        (helix(), TREE), (TREE, helix()), (straight(), TREE), (helix(), straight()),
        (TREE, straight((1.0, 0.2, 0.1))), (bars(3), helix()),
    ):  # fmt: skip
        name = f"{len(first.branches)} and {len(second.branches)} branches"
        name += f", {first.length_mm:.0f} and {second.length_mm:.0f} mm"
        yield (
            name,
            lambda x=first, y=second: [paths(x, PAIR[:1])[0],
                                       angiogram(PAIR[1], 1000 * path_of(y, PAIR[1]), "2")],
            NOT_OK, None,
        )  # fmt: skip


def out_of_distribution():
    rng = np.random.default_rng(3)
    noise_picture = np.rint(3000 * rng.random((SIDE, SIDE)) * (rng.random((SIDE, SIDE)) > 0.95))
    lines = np.zeros((SIDE, SIDE))
    lines[10:120:22] = 1500.0
    checks = np.zeros((SIDE, SIDE))
    checks[40:80, 40:80] = 1200.0 * ((np.indices((40, 40)) // 5).sum(0) % 2)
    for name, picture in (("noise", noise_picture), ("lines", lines), ("checks", checks)):
        yield name, lambda p=picture: changed(paths(TREE), lambda _: p), NOT_OK, None
    thick = dataclasses.replace(
        TREE,
        branches=tuple(dataclasses.replace(b, radius_mm=3 * b.radius_mm) for b in TREE.branches),
    )
    yield "three times as thick", of(thick, PAIR), DONE, thick
    yield "view 2 is view 1", lambda: changed(paths(TREE), lambda p: p[::-1], 1), NOT_OK, None
    far = tuple(
        dataclasses.replace(v, sod_mm=3000.0, sdd_mm=4700.0, pixel_spacing_mm=(1.2, 1.2))
        for v in PAIR
    )
    yield "a source 3 m away", of(TREE, far), DONE, TREE


def voxels():
    for shape in ((256, 256, 26), (40, 40, 40), (26, 80, 80), (80, 26, 40), (130, 130, 130),
                  (20, 20, 160)):  # fmt: skip
        grid = Grid(center_mm=(0, 0, 0), size_mm=(EDGE,) * 3, shape=shape)
        yield "x".join(map(str, shape)), of(TREE, PAIR), DONE, TREE, grid


EDGE = GRID.size_mm[0]

FAMILIES = {
    "1 separation extremes": separation_extremes,
    "2 separation sweep": separation_sweep,
    "3 in the epipolar plane": in_the_epipolar_plane,
    "4 foreshortened": foreshortened,
    "5 ghosts": ghosts,
    "6 nothing to see": nothing_to_see,
    "7 hardly any vessel": hardly_any_vessel,
    "8 wrong geometry": wrong_geometry,
    "9 unlike views": unlike_views,
    "10 bit depths": bit_depths,
    "11 polarities": polarities,
    "12 log or linear": log_or_linear,
    "13 noise": noise,
    "14 clutter": clutter,
    "15 motion": motion,
    "16 flips": flips,
    "22 voxels": voxels,
    "23 out of distribution": out_of_distribution,
    "24 contradictory views": contradictory,
}

"""Tubes that are no coronary tree: forks, coils, rings, twins and several trees, from a seed.

Phantoms, single vessels and arteries of other organs lie otherwise than coronary arteries do. A
predictor that has met trees of one anatomy alone is sure of itself where such a scene leaves two
places open; these teach it what two views tell without anatomy, and where they tell nothing.
"""

from __future__ import annotations

import numpy as np

from gcar_export.scenes.capsules import Capsules, Tube
from gcar_export.scenes.tree_curves import STEP_MM, texture_radius, unit

#: how often there are one, two, three trees that do not touch
TREES = (0.75, 0.2, 0.05)
RING_SHARE = TWIN_SHARE = 0.12
#: no tube leaves a ball of this radius round the middle of all, mm
REACH_MM = 68.0


def free_tubes(rng: np.random.Generator, thinnest_mm: float = 0.5) -> Capsules:
    """Draw a scene, its middle in the isocentre.

    Parameters
    ----------
    rng : source of all choices
    thinnest_mm : no radius is smaller
    """
    tubes: list[Tube] = []
    for _ in range(1 + int(rng.choice(len(TREES), p=TREES))):
        tubes += _tree(rng, 18.0 * rng.normal(size=3))
    if rng.random() < RING_SHARE:
        tubes += _ring(rng, tubes)
    if rng.random() < TWIN_SHARE:
        tubes.append(_twin(rng, tubes[int(rng.integers(len(tubes)))]))
    wall = float(rng.choice([0.0, 0.03, 0.1]))
    every = np.concatenate([points for points, _ in tubes])
    middle = 0.5 * (every.min(axis=0) + every.max(axis=0))
    smaller = min(1.0, REACH_MM / float(np.linalg.norm(every - middle, axis=1).max()))
    return Capsules.of(
        [
            (smaller * (points - middle), texture_radius(rng, r, thinnest_mm, wall, thinnest_mm))
            for points, r in tubes
        ]
    )


def _tree(rng: np.random.Generator, start: np.ndarray) -> list[Tube]:
    """One tube, and others that leave it and each other."""
    # One strength for all: a tree is straight or winds as a whole, mostly.
    bend = float(np.exp(rng.uniform(np.log(0.003), np.log(0.09))))
    calibre = float(np.exp(rng.uniform(np.log(0.7), np.log(3.6))))
    tubes = [
        _tube(rng, start, rng.normal(size=3), rng.uniform(30, 110), calibre, bend),
    ]
    for _ in range(int(rng.integers(0, 8))):
        points, radius = tubes[int(rng.integers(len(tubes)))]
        last = len(points) - 2
        at = last if rng.random() < 0.35 else int(rng.integers(1, last))
        along = unit(points[at + 1] - points[at])
        aside = unit(np.cross(along, rng.normal(size=3)))
        angle = np.deg2rad(rng.uniform(15, 100))
        way = np.cos(angle) * along + np.sin(angle) * aside
        thick = radius[at] * rng.uniform(0.4, 1.0)
        tubes.append(_tube(rng, points[at], way, rng.uniform(12, 60), thick, bend))
    return tubes


def _tube(
    rng: np.random.Generator, start: np.ndarray, way: np.ndarray, length: float, radius: float,
    bend: float,
) -> Tube:  # fmt: skip
    """Follow a direction that turns steadily (a coil) and at random, ``bend`` in 1/mm."""
    n = max(6, int(length / STEP_MM))
    spin = bend * rng.normal(size=3)
    turn = np.zeros(3)
    direction = unit(way)
    points = np.empty((n, 3))
    points[0] = start
    for k in range(1, n):
        turn = 0.97 * turn + 0.24 * bend * rng.normal(size=3)
        direction = unit(direction + STEP_MM * np.cross(spin + turn, direction))
        points[k] = points[k - 1] + STEP_MM * direction
    return points, radius * (1 - rng.uniform(0.0, 0.6) * np.linspace(0, 1, n))


def _ring(rng: np.random.Generator, tubes: list[Tube]) -> list[Tube]:
    """Close a ring at a point of a tube: an ellipse that is bent out of its plane."""
    points, radius = tubes[int(rng.integers(len(tubes)))]
    at = int(rng.integers(len(points)))
    a, b, c = rng.uniform(10, 30), rng.uniform(10, 30), rng.uniform(0, 10)
    t = np.linspace(0, 2 * np.pi, max(12, int(np.pi * (a + b) / STEP_MM)))
    ring = np.stack([a * np.cos(t), b * np.sin(t), c * np.sin(2 * t + 0.5)], axis=1)
    turned = (ring - ring[0]) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return [(points[at] + turned, np.full(len(t), radius[at] * rng.uniform(0.5, 1.0)))]


def _twin(rng: np.random.Generator, tube: Tube) -> Tube:
    """Repeat a tube some millimetres beside itself."""
    points, radius = tube
    shift = unit(rng.normal(size=3)) * rng.uniform(1.5, 4.0) * (1.0 + radius.max())
    return points + shift, radius * rng.uniform(0.7, 1.2)

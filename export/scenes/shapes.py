"""Shapes as phantoms have them: single tubes, forks, coils, rings, twins. No coronary tree."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gcar_export.scenes.capsules import Capsules, Tube
from gcar_export.scenes.tree_curves import unit

Shape = Callable[[np.random.Generator], list[Tube]]
_POINTS = 100


def _even(first: float, last: float) -> np.ndarray:
    return np.linspace(first, last, _POINTS)


def _way(
    rng: np.random.Generator, start: np.ndarray, way: tuple[float, float, float], length: float,
    bend: float = 0.06,
) -> np.ndarray:  # fmt: skip
    """Walk from ``start``, the direction swaying slowly."""
    direction, sway = unit(np.array(way)), rng.normal(size=3)
    points = [np.asarray(start, float)]
    for _ in range(_POINTS - 1):
        sway = 0.94 * sway + 0.34 * rng.normal(size=3)
        direction = unit(direction + bend * 0.6 * sway)
        points.append(points[-1] + direction * length / _POINTS)
    return np.array(points)


def _straight(rng: np.random.Generator) -> list[Tube]:
    return [(np.outer(_even(-35, 35), unit(rng.normal(size=3))), _even(2, 1))]


def _helix(rng: np.random.Generator) -> list[Tube]:
    a = _even(0, 4 * np.pi)
    return [(np.stack([20 * np.cos(a), 20 * np.sin(a), _even(-35, 35)], axis=1), _even(2, 1.2))]


def _spiral(rng: np.random.Generator) -> list[Tube]:
    a, r = _even(0, 5 * np.pi), _even(8, 30)
    rise = 15 * np.sin(_even(0, 2 * np.pi))
    return [(np.stack([r * np.cos(a), r * np.sin(a), rise], axis=1), _even(1.8, 1))]


def _fork(rng: np.random.Generator) -> list[Tube]:
    stem = _way(rng, np.array([0, -5, 35.0]), (0, 0.3, -1), 30)
    left = _way(rng, stem[-1], (0.8, 0.2, -0.7), 40)
    right = _way(rng, stem[-1], (-0.8, 0.1, -0.7), 40)
    return [(stem, _even(2, 1.8)), (left, _even(1.5, 0.8)), (right, _even(1.4, 0.8))]


def _thin_fork(rng: np.random.Generator) -> list[Tube]:
    return [(points, 0.35 * radius) for points, radius in _fork(rng)]


def _narrowed_fork(rng: np.random.Generator) -> list[Tube]:
    (stem, radius), *others = _fork(rng)
    narrowing = 0.75 * np.exp(-(((np.arange(_POINTS) - 50) / 5.0) ** 2))
    return [(stem, radius * (1 - narrowing)), *others]


def _wide_fork(rng: np.random.Generator) -> list[Tube]:
    stem = _way(rng, np.array([0, 0, 40.0]), (0.2, 0.3, -1), 80)
    bulge = 1.5 * np.exp(-(((np.arange(_POINTS) - 50) / 8.0) ** 2))
    return [(stem, 3 + bulge), (_way(rng, stem[40], (1, 0.4, -0.4), 40), _even(2.2, 1.5))]


def _comb(rng: np.random.Generator) -> list[Tube]:
    stem = _way(rng, np.array([-30, 0, 10.0]), (1, 0.2, -0.2), 75)
    tubes = [(stem, _even(2, 0.9))]
    for at in range(15, 95, 15):
        x, y, z = rng.normal(size=3)
        tubes.append((_way(rng, stem[at], (0.3 * x, y, z), rng.uniform(15, 35)), _even(0.9, 0.5)))
    return tubes


def _star(rng: np.random.Generator) -> list[Tube]:
    ways = rng.normal(size=(6, 3))
    return [(_way(rng, np.zeros(3), (x, y, z), 40), _even(1.8, 0.8)) for x, y, z in ways]


def _ring(rng: np.random.Generator) -> list[Tube]:
    a = _even(0, 2 * np.pi)
    ring = np.stack([25 * np.cos(a), 18 * np.sin(a), 8 * np.cos(2 * a)], axis=1)
    return [(ring, _even(1.5, 1.5)), (_way(rng, ring[0], (0.2, 0.2, 1), 30), _even(1.8, 1.5))]


def _apart(rng: np.random.Generator) -> list[Tube]:
    one = _way(rng, np.array([-20, 0, 30.0]), (0.1, 0.2, -1), 70)
    other = _way(rng, np.array([20, 10, 30.0]), (-0.1, -0.2, -1), 70)
    return [(one, _even(1.8, 0.9)), (other, _even(1.6, 0.9))]


def _beside(rng: np.random.Generator) -> list[Tube]:
    one = _way(rng, np.array([0, 0, 35.0]), (0.2, 0.3, -1), 70)
    return [(one, _even(1.5, 1)), (one + np.array([6.0, 5.0, 0.0]), _even(1.5, 1))]


def _halving(rng: np.random.Generator) -> list[Tube]:
    tubes: list[Tube] = []

    def grow(start: np.ndarray, way: np.ndarray, radius: float, length: float, forks: int) -> None:
        points = _way(rng, start, (way[0], way[1], way[2]), length)
        tubes.append((points, _even(radius, 0.8 * radius)))
        for _ in range(2 if forks else 0):
            turned = unit(points[-1] - points[-6]) + 0.8 * rng.normal(size=3)
            grow(points[-1], turned, 0.75 * radius, 0.8 * length, forks - 1)

    grow(np.array([0, 0, 35.0]), np.array([0, 0.2, -1]), 2.2, 28.0, 3)
    return tubes


SHAPES: dict[str, Shape] = {
    "straight tube": _straight, "helix": _helix, "spiral": _spiral, "fork": _fork,
    "thin fork": _thin_fork, "fork with a stenosis": _narrowed_fork, "wide fork": _wide_fork,
    "comb": _comb, "star": _star, "ring": _ring, "two apart": _apart, "two side by side": _beside,
    "halving tree": _halving,
}  # fmt: skip


def shape(name: str, rng: np.random.Generator) -> tuple[Capsules, list[np.ndarray]]:
    """Draw a shape, its middle in the isocentre; return its lumen and its lines, (m, 3) mm."""
    tubes = SHAPES[name](rng)
    every = np.concatenate([points for points, _ in tubes])
    middle = 0.5 * (every.min(axis=0) + every.max(axis=0))
    tubes = [(points - middle, radius) for points, radius in tubes]
    return Capsules.of(tubes), [points for points, _ in tubes]

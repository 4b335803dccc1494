"""The heart that generated vessels lie on, their curves and their calibres."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np

from gcar_deploy.tree.tree import along, polyline_arc

STEP_MM = 0.8
#: exponent of Murray's law: r_parent^3 = sum r_daughter^3
MURRAY = 3.0
#: a smooth map of (n, 3) points
Warp: TypeAlias = Callable[[np.ndarray], np.ndarray]
#: no lumen is wider, mm radius
WIDEST_MM = 3.4


@dataclasses.dataclass(frozen=True, eq=False)
class Vessel:
    """One vessel: (m, 3) points in mm LPS, (m,) radii in mm, a name and its side."""

    name: str
    side: str
    points_mm: np.ndarray
    radius_mm: np.ndarray


@dataclasses.dataclass(frozen=True)
class Heart:
    """A half ellipsoid: its axes in LPS, its rim and its length."""

    axes: np.ndarray  # rows: anterior groove, left, apex direction, in LPS
    rim_mm: float
    squash: float
    length_mm: float

    def surface(self, phi_deg: np.ndarray, s: np.ndarray, lift_mm: np.ndarray) -> np.ndarray:
        """(n, 3) points at angle, height 0 .. 1 and distance from the surface."""
        phi = np.deg2rad(phi_deg)
        # A superellipse keeps the ventricle full before it closes at the apex.
        across = np.clip(1 - np.clip(s, -0.5, 1) ** 2 * np.sign(s), 0.0, None) ** 0.62
        local = np.stack(
            [
                (self.rim_mm * across + lift_mm) * np.cos(phi),
                (self.rim_mm * self.squash * across + lift_mm) * np.sin(phi),
                self.length_mm * s,
            ],
            axis=1,
        )
        return local @ self.axes


def random_heart(rng: np.random.Generator) -> Heart:
    """Draw size and attitude of a heart."""
    apex = unit(np.array([0.62, -0.55, -0.56]) + 0.22 * rng.normal(size=3))
    groove = np.array([0.25, -0.55, 0.80]) + 0.25 * rng.normal(size=3)
    groove = unit(groove - (groove @ apex) * apex)
    left = np.cross(groove, apex)
    if left[0] + left[1] < 0:
        left = -left
    return Heart(
        axes=np.stack([groove, left, apex]),
        rim_mm=rng.uniform(38, 56),
        squash=rng.uniform(0.85, 1.2),
        length_mm=rng.uniform(80, 118),
    )


def vessel(name: str, side: str, points: np.ndarray, r_start: float, r_end: float | None) -> Vessel:
    """Lay radii along a curve, from ``r_start`` to ``r_end`` (0.7 of it where None)."""
    if r_end is None:
        r_end = r_start * 0.7
    t = np.linspace(0, 1, len(points))
    return Vessel(name, side, points, r_start + (r_end - r_start) * t**0.8)


def surface_curve(
    rng: np.random.Generator, heart: Heart, way: Any, *, start: np.ndarray, cut: float,
    lift: float = 0.0,
) -> np.ndarray:  # fmt: skip
    """Lay a curve through (phi, s) points of the heart's surface, from ``start`` on."""
    from scipy.interpolate import PchipInterpolator

    way = np.asarray(way, dtype=np.float64)
    knots = np.linspace(0, 1, len(way))
    t = np.linspace(0, 1, 400)
    phi, s = PchipInterpolator(knots, way[:, 0])(t), PchipInterpolator(knots, way[:, 1])(t)
    points = heart.surface(phi, s, np.full(len(t), lift) + rng.normal() * 1.5)
    # The curve leaves its parent at the parent's own point and settles on the surface.
    settle = np.exp(-np.linspace(0, 1, len(t)) / rng.uniform(0.06, 0.2))
    points = points + settle[:, None] * (start - points[0])
    points = _resample(points)
    points = points[: max(4, int(len(points) * cut))]
    return _tortuous(rng, points)


def free_curve(rng: np.random.Generator, ends: Sequence[np.ndarray], bow: float) -> np.ndarray:
    """Bow a line between two points."""
    a, b = np.asarray(ends[0]), np.asarray(ends[1])
    n = max(6, int(np.linalg.norm(b - a) / STEP_MM))
    t = np.linspace(0, 1, n)[:, None]
    return _resample(a + t * (b - a) + np.sin(np.pi * t) * rng.normal(size=3) * bow)


def _tortuous(rng: np.random.Generator, points: np.ndarray) -> np.ndarray:
    """Add smooth noise along the curve (correlation 5 .. 20 mm) that is zero at its start."""
    n = len(points)
    arc = np.arange(n) * STEP_MM
    wiggle = np.zeros_like(points)
    strength = rng.gamma(2.0, 0.45)
    for _ in range(4):
        wavelength = rng.uniform(9, 45)
        wiggle += (
            0.5
            * strength
            * np.sqrt(wavelength / 20)
            * np.sin(2 * np.pi * arc / wavelength + rng.uniform(0, 2 * np.pi))[:, None]
            * rng.normal(size=3)
        )
    fade = 1 - np.exp(-arc / 6.0)
    return _resample(points + fade[:, None] * (wiggle - wiggle[0]))


def daughter(rng: np.random.Generator, r_parent: float, low: float, high: float) -> float:
    """Radius of a daughter that carries a share of the parent's flow (Murray's law)."""
    return float(r_parent * rng.uniform(low, high) ** (1 / MURRAY))


def texture_radius(
    rng: np.random.Generator,
    radius_mm: np.ndarray,
    floor_mm: float,
    wall: float,
    thinnest_mm: float,
) -> np.ndarray:
    """(n,) mm: slow waves, a rough wall, stenoses and ectasia; no thinner than the floor.

    ``wall`` is the relative roughness from one point to the next.
    """
    n = len(radius_mm)
    arc = np.arange(n) * STEP_MM
    radius = np.maximum(radius_mm, floor_mm * rng.uniform(0.8, 1.12))
    slow = sum(
        rng.normal() * 0.05 * np.sin(2 * np.pi * arc / w + rng.uniform(0, 6.3))
        for w in rng.uniform(8, 40, size=3)
    )
    radius = radius * (1 + slow) * (1 + wall * rng.normal(size=n))
    for _ in range(rng.poisson(0.25 * n * STEP_MM / 60)):
        centre, width = rng.uniform(0, arc[-1]), rng.uniform(2, 7)
        depth = rng.uniform(0.2, 0.65) if rng.random() < 0.75 else -rng.uniform(0.2, 0.5)
        radius = radius * (1 - depth * np.exp(-0.5 * ((arc - centre) / width) ** 2))
    return np.clip(radius, thinnest_mm, WIDEST_MM)


def _resample(points: np.ndarray) -> np.ndarray:
    arc = polyline_arc(points)
    return along(points, arc, np.linspace(0, arc[-1], max(4, int(arc[-1] / STEP_MM) + 1)))


def random_warp(rng: np.random.Generator) -> Warp:
    """Draw a sum of three long waves, up to a few millimetres each."""
    waves = rng.normal(size=(3, 3)) * rng.uniform(0.03, 0.09, size=(3, 1))
    phases = rng.uniform(0, 2 * np.pi, size=3)
    amplitude = rng.normal(size=(3, 3)) * 2.2
    return lambda points: points + np.sin(points @ waves.T + phases) @ amplitude


def winding_warp(rng: np.random.Generator, strength_mm: float) -> Warp:
    """Draw short waves (11 .. 38 mm) of space: every vessel winds, branches stay attached."""
    wavelength = rng.uniform(11, 38, size=6)
    directions = rng.normal(size=(6, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    waves = 2 * np.pi * directions / wavelength[:, None]
    phases = rng.uniform(0, 2 * np.pi, size=6)
    # Longer waves swing wider; more than this would fold space.
    amplitude = rng.normal(size=(6, 3)) * strength_mm * wavelength[:, None] / 25
    return lambda points: points + np.sin(points @ waves.T + phases) @ amplitude


def unit(v: np.ndarray) -> np.ndarray:
    """Return a vector of length 1."""
    return v / np.linalg.norm(v)

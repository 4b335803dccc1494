"""Anatomically plausible coronary trees, from a seed.

Vessels are curves on a heart-shaped surface, a half ellipsoid with the atrioventricular
groove as its rim and the interventricular groove along its length. A point of the surface is
(phi, s): phi = angle round the heart's axis (0 at the anterior interventricular groove,
positive towards the patient's left), s = 0 at the rim .. 1 at the apex.

LM, LAD with diagonals and septals, LCx with obtuse marginals (and a ramus at times), RCA with
conus and acute marginals, PDA and PLV; right, left or balanced dominance; Murray's law at
each fork, taper, stenoses and ectasia, tortuosity, missing and cut-off branches, random heart
axis and size, and a smooth warp. Radii 0.4 .. 2.8 mm.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

STEP_MM = 0.8
#: exponent of Murray's law: r_parent^3 = sum r_daughter^3
MURRAY = 3.0


@dataclasses.dataclass(frozen=True, eq=False)
class Vessel:
    """One vessel: (m, 3) points in mm LPS, (m,) radii in mm, a name and its side."""

    name: str
    side: str
    points_mm: np.ndarray
    radius_mm: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class SyntheticTree:
    """Vessels of one patient, centred on its bounding box."""

    vessels: tuple[Vessel, ...]
    dominance: str

    def segments(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (n, 3) starts, (n, 3) ends and (n,) radii of capsules that cover the lumen."""
        starts = np.concatenate([v.points_mm[:-1] for v in self.vessels])
        ends = np.concatenate([v.points_mm[1:] for v in self.vessels])
        radii = np.concatenate([0.5 * (v.radius_mm[1:] + v.radius_mm[:-1]) for v in self.vessels])
        return starts, ends, radii

    def sides(self, which: str) -> SyntheticTree:
        """Keep the ``left`` or ``right`` vessels alone, centred anew."""
        kept = tuple(v for v in self.vessels if v.side == which)
        return _centred(dataclasses.replace(self, vessels=kept))


@dataclasses.dataclass(frozen=True)
class _Heart:
    axes: np.ndarray  # rows: anterior groove, left, apex direction, in LPS
    rim_mm: float
    squash: float
    length_mm: float

    def surface(self, phi_deg: np.ndarray, s: np.ndarray, lift_mm: np.ndarray) -> np.ndarray:
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


def random_tree(rng: np.random.Generator) -> SyntheticTree:
    """Draw one patient's left and right coronary tree."""
    heart = _random_heart(rng)
    dominance = str(rng.choice(["right", "left", "balanced"], p=[0.8, 0.1, 0.1]))
    calibre = rng.uniform(0.85, 1.35)
    # Label volumes rarely keep what is thinner than a voxel or two: most trees end at 1 mm.
    floor = rng.uniform(0.55, 1.0) if rng.random() < 0.2 else rng.uniform(1.0, 1.65)
    vessels = _left_tree(rng, heart, dominance, calibre) + _right_tree(
        rng, heart, dominance, calibre
    )
    bend = _random_warp(rng)
    finished = []
    for v in vessels:
        points = bend(v.points_mm)
        radius = _texture_radius(rng, v, floor)
        finished.append(dataclasses.replace(v, points_mm=points, radius_mm=radius))
    return _centred(SyntheticTree(tuple(finished), dominance))


# -- the heart ----------------------------------------------------------------------------


def _random_heart(rng: np.random.Generator) -> _Heart:
    apex = _unit(np.array([0.62, -0.55, -0.56]) + 0.22 * rng.normal(size=3))
    groove = np.array([0.25, -0.55, 0.80]) + 0.25 * rng.normal(size=3)
    groove = _unit(groove - (groove @ apex) * apex)
    left = np.cross(groove, apex)
    if left[0] + left[1] < 0:
        left = -left
    return _Heart(
        axes=np.stack([groove, left, apex]),
        rim_mm=rng.uniform(38, 56),
        squash=rng.uniform(0.85, 1.2),
        length_mm=rng.uniform(80, 118),
    )


def _random_warp(rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """Draw a sum of three long waves, up to a few millimetres each."""
    waves = rng.normal(size=(3, 3)) * rng.uniform(0.03, 0.09, size=(3, 1))
    phases = rng.uniform(0, 2 * np.pi, size=3)
    amplitude = rng.normal(size=(3, 3)) * 2.2

    def bend(points: np.ndarray) -> np.ndarray:
        return points + np.sin(points @ waves.T + phases) @ amplitude

    return bend


# -- vessels ------------------------------------------------------------------------------


def _left_tree(
    rng: np.random.Generator, heart: _Heart, dominance: str, calibre: float
) -> list[Vessel]:
    fork_phi, fork_s = rng.uniform(5, 35), rng.uniform(-0.10, 0.04)
    r_lm = calibre * rng.uniform(1.9, 2.6)
    inner = rng.uniform(6, 20)
    ostium = heart.surface(
        np.array([fork_phi - rng.uniform(10, 40)]),
        np.array([fork_s - rng.uniform(0, 0.12)]),
        np.array([-inner]),
    )[0]
    fork = heart.surface(np.array([fork_phi]), np.array([fork_s]), np.array([rng.uniform(-3, 3)]))[
        0
    ]
    lm = _free_curve(rng, [ostium, fork], bow=2.0)
    r_lad = _daughter(rng, r_lm, 0.5, 0.62)
    r_lcx = (max(r_lm**MURRAY - r_lad**MURRAY, 0.2)) ** (1 / MURRAY)
    out = [_vessel("LM", "left", lm, r_lm, 0.97 * r_lm)]
    lad = _surface_curve(
        rng,
        heart,
        [
            (fork_phi, fork_s),
            (rng.uniform(-5, 8), 0.15),
            (rng.uniform(-10, 10), 0.5),
            (rng.uniform(-15, 15), rng.uniform(0.8, 0.97)),
        ],
        start=fork,
        cut=rng.uniform(0.7, 1.0),
    )
    out.append(_vessel("LAD", "left", lad, r_lad, r_lad * rng.uniform(0.45, 0.7)))
    for k in range(rng.choice([0, 1, 2, 3, 4], p=[0.06, 0.3, 0.36, 0.2, 0.08])):
        out += _side_branch(
            rng, heart, f"D{k + 1}", "left", out[1], (0.06, 0.7), sign=+1, reach=(25, 90)
        )
    for k in range(rng.choice([0, 1, 2, 3], p=[0.6, 0.22, 0.12, 0.06])):
        out += _septal(rng, heart, f"S{k + 1}", out[1])
    if rng.random() < 0.3:
        ramus = _surface_curve(
            rng,
            heart,
            [
                (fork_phi, fork_s),
                (rng.uniform(30, 55), 0.2),
                (rng.uniform(40, 75), rng.uniform(0.45, 0.8)),
            ],
            start=fork,
            cut=rng.uniform(0.5, 1.0),
        )
        out.append(_vessel("RI", "left", ramus, _daughter(rng, r_lad, 0.3, 0.6), None))
    end_phi = {"right": rng.uniform(70, 150), "balanced": rng.uniform(130, 172), "left": 178.0}[
        dominance
    ]
    lcx = _surface_curve(
        rng,
        heart,
        [
            (fork_phi, fork_s),
            (0.5 * (fork_phi + end_phi), rng.uniform(-0.04, 0.12)),
            (end_phi, rng.uniform(-0.02, 0.25)),
        ],
        start=fork,
        cut=rng.uniform(0.55, 1.0),
    )
    i_cx = len(out)
    out.append(_vessel("LCx", "left", lcx, r_lcx, r_lcx * rng.uniform(0.45, 0.75)))
    for k in range(rng.choice([0, 1, 2, 3, 4], p=[0.1, 0.3, 0.34, 0.18, 0.08])):
        out += _side_branch(
            rng, heart, f"OM{k + 1}", "left", out[i_cx], (0.1, 0.9), sign=0, reach=(20, 85)
        )
    if dominance == "left":
        out += _posterior(rng, heart, "left", out[i_cx])
    return out


def _right_tree(
    rng: np.random.Generator, heart: _Heart, dominance: str, calibre: float
) -> list[Vessel]:
    phi0 = -rng.uniform(25, 60)
    r = calibre * rng.uniform(1.5, 2.5) * (0.7 if dominance == "left" else 1.0)
    ostium = heart.surface(
        np.array([phi0 + rng.uniform(0, 20)]),
        np.array([-rng.uniform(0.05, 0.3)]),
        np.array([-rng.uniform(5, 18)]),
    )[0]
    end_phi = {
        "right": -rng.uniform(168, 182),
        "balanced": -rng.uniform(160, 180),
        "left": -rng.uniform(70, 130),
    }[dominance]
    bulge = rng.uniform(-2, 8)
    rca = _surface_curve(
        rng,
        heart,
        [
            (phi0 - 8, -0.12),
            (0.65 * phi0 + 0.35 * end_phi, rng.uniform(-0.15, 0.08)),
            (0.3 * phi0 + 0.7 * end_phi, rng.uniform(-0.06, 0.12)),
            (end_phi, rng.uniform(-0.05, 0.1)),
        ],
        start=ostium,
        cut=1.0 if rng.random() < 0.7 else rng.uniform(0.25, 1.0),
        lift=bulge,
    )
    out = [_vessel("RCA", "right", rca, r, r * rng.uniform(0.65, 0.95))]
    if rng.random() < 0.4:
        out += _side_branch(
            rng, heart, "CB", "right", out[0], (0.04, 0.15), sign=+1, reach=(10, 40)
        )
    for k in range(rng.choice([0, 1, 2, 3], p=[0.3, 0.38, 0.22, 0.1])):
        out += _side_branch(
            rng, heart, f"AM{k + 1}", "right", out[0], (0.2, 0.8), sign=0, reach=(12, 65)
        )
    if dominance != "left":
        out += _posterior(rng, heart, "right", out[0], pda=True, many=dominance == "right")
    return out


def _posterior(
    rng: np.random.Generator, heart: _Heart, side: str, parent: Vessel, *, pda: bool = True,
    many: bool = True,
) -> list[Vessel]:  # fmt: skip
    """PDA in the posterior groove and posterolateral branches, from the end of ``parent``."""
    out = []
    start, r_end = parent.points_mm[-1], float(parent.radius_mm[-1])
    local = start @ heart.axes.T
    phi = np.rad2deg(np.arctan2(local[1], local[0]))
    if pda and rng.random() < 0.85:
        way = [
            (phi, 0.03),
            (180 + rng.uniform(-14, 14), 0.25),
            (180 + rng.uniform(-20, 20), rng.uniform(0.5, 0.9)),
        ]
        way = [(_near(p, phi), s) for p, s in way]
        points = _surface_curve(rng, heart, way, start=start, cut=rng.uniform(0.35, 1.0))
        out.append(_vessel("PDA", side, points, _daughter(rng, r_end, 0.4, 0.7), None))
    toward = -1 if side == "left" else +1
    for k in range(rng.choice([0, 1, 2, 3], p=[0.25, 0.4, 0.25, 0.1]) if many else 0):
        turn = rng.uniform(20, 75)
        base = _near(180.0, phi)
        sign = -1 if side == "right" else toward
        way = [
            (phi, 0.0),
            (base + sign * 0.5 * turn, rng.uniform(0.02, 0.15)),
            (base + sign * turn, rng.uniform(0.15, 0.6)),
        ]
        points = _surface_curve(rng, heart, way, start=start, cut=rng.uniform(0.35, 1.0))
        out.append(_vessel(f"PL{k + 1}", side, points, _daughter(rng, r_end, 0.35, 0.7), None))
    return out


def _side_branch(
    rng: np.random.Generator, heart: _Heart, name: str, side: str, parent: Vessel,
    where: tuple[float, float], sign: float, reach: tuple[float, float],
) -> list[Vessel]:  # fmt: skip
    i = int(np.clip(rng.uniform(*where) * len(parent.points_mm), 1, len(parent.points_mm) - 3))
    start = parent.points_mm[i]
    local = start @ heart.axes.T
    phi = np.rad2deg(np.arctan2(local[1], local[0]))
    s = local[2] / heart.length_mm
    turn = rng.uniform(8, 45) * (sign if sign else rng.choice([-1, 1]) * 0.5)
    s_end = np.clip(s + rng.uniform(0.2, 0.7), -0.1, 0.95)
    way = [
        (phi, s),
        (phi + 0.6 * turn, s + 0.3 * (s_end - s)),
        (phi + turn * rng.uniform(0.8, 1.6), s_end),
    ]
    points = _surface_curve(rng, heart, way, start=start, cut=1.0)
    points = points[: max(5, int(rng.uniform(*reach) / STEP_MM))]
    r0 = _daughter(rng, float(parent.radius_mm[i]), 0.25, 0.75)
    out = [_vessel(name, side, points, r0, None)]
    if len(points) * STEP_MM > 30 and rng.random() < 0.22:
        out += _side_branch(rng, heart, name + "a", side, out[0], (0.25, 0.7), 0, (10, 45))
    return out


def _septal(rng: np.random.Generator, heart: _Heart, name: str, parent: Vessel) -> list[Vessel]:
    i = int(np.clip(rng.uniform(0.08, 0.6) * len(parent.points_mm), 1, len(parent.points_mm) - 3))
    start = parent.points_mm[i]
    inward = -heart.axes[0] + 0.5 * heart.axes[2] + 0.25 * rng.normal(size=3)
    end = start + _unit(inward) * rng.uniform(8, 35)
    return [
        _vessel(
            name,
            "left",
            _free_curve(rng, [start, end], bow=4.0),
            _daughter(rng, float(parent.radius_mm[i]), 0.15, 0.4),
            None,
        )
    ]


# -- curves and calibres --------------------------------------------------------------------


def _surface_curve(
    rng: np.random.Generator, heart: _Heart, way: Any, *, start: np.ndarray, cut: float,
    lift: float = 0.0,
) -> np.ndarray:  # fmt: skip
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


def _free_curve(rng: np.random.Generator, ends: Sequence[np.ndarray], bow: float) -> np.ndarray:
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


def _vessel(
    name: str, side: str, points: np.ndarray, r_start: float, r_end: float | None
) -> Vessel:
    if r_end is None:
        r_end = r_start * 0.7
    t = np.linspace(0, 1, len(points))
    return Vessel(name, side, points, r_start + (r_end - r_start) * t**0.8)


def _daughter(rng: np.random.Generator, r_parent: float, low: float, high: float) -> float:
    """Radius of a daughter that carries a share of the parent's flow (Murray's law)."""
    return float(r_parent * rng.uniform(low, high) ** (1 / MURRAY))


def _texture_radius(rng: np.random.Generator, vessel: Vessel, floor: float) -> np.ndarray:
    n = len(vessel.radius_mm)
    arc = np.arange(n) * STEP_MM
    radius = np.maximum(vessel.radius_mm, floor * rng.uniform(0.8, 1.12))
    slow = sum(
        rng.normal() * 0.05 * np.sin(2 * np.pi * arc / w + rng.uniform(0, 6.3))
        for w in rng.uniform(8, 40, size=3)
    )
    radius = radius * (1 + slow) * (1 + 0.06 * rng.normal(size=n))
    for _ in range(rng.poisson(0.25 * n * STEP_MM / 60)):
        centre, width = rng.uniform(0, arc[-1]), rng.uniform(2, 7)
        depth = rng.uniform(0.2, 0.65) if rng.random() < 0.75 else -rng.uniform(0.2, 0.5)
        radius = radius * (1 - depth * np.exp(-0.5 * ((arc - centre) / width) ** 2))
    return np.clip(radius, 0.4, 3.4)


def _resample(points: np.ndarray) -> np.ndarray:
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    n = max(4, int(arc[-1] / STEP_MM) + 1)
    t = np.linspace(0, arc[-1], n)
    return np.stack([np.interp(t, arc, points[:, k]) for k in range(3)], axis=1)


def _centred(tree: SyntheticTree) -> SyntheticTree:
    everything = np.concatenate([v.points_mm for v in tree.vessels])
    middle = 0.5 * (everything.min(axis=0) + everything.max(axis=0))
    moved = tuple(dataclasses.replace(v, points_mm=v.points_mm - middle) for v in tree.vessels)
    return dataclasses.replace(tree, vessels=moved)


def _near(angle: float, reference: float) -> float:
    """Return the angle shifted by whole turns so that it is nearest to ``reference``."""
    return angle + 360.0 * round((reference - angle) / 360.0)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)

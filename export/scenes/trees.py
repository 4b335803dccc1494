"""Anatomically plausible coronary trees, from a seed.

Vessels are curves on a heart-shaped surface, a half ellipsoid with the atrioventricular
groove as its rim and the interventricular groove along its length. A point of the surface is
(phi, s): phi = angle round the heart's axis (0 at the anterior interventricular groove,
positive towards the patient's left), s = 0 at the rim .. 1 at the apex.

LM, LAD with diagonals and septals, LCx with obtuse marginals (and a ramus at times), RCA with
conus and acute marginals, PDA and PLV; right, left or balanced dominance; Murray's law at
each fork, taper, stenoses and ectasia, tortuosity, missing and cut-off branches, random heart
axis and size, and a smooth warp. Radii 0.4 .. 2.8 mm, from 0.22 mm in the style ``thin_style``.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.tree.curves import resample
from gcar_deploy.types import Points
from gcar_export.scenes.tree_curves import (
    MURRAY,
    STEP_MM,
    Heart,
    Vessel,
    daughter,
    free_curve,
    random_heart,
    random_warp,
    surface_curve,
    texture_radius,
    unit,
    vessel,
    winding_warp,
)

SIDES = ("left", "right")


@dataclasses.dataclass(frozen=True)
class TreeStyle:
    """What trees of one kind share; the default is what label volumes hold.

    Attributes
    ----------
    floor_mm : (lowest, highest) radius below which no vessel of a tree narrows; None draws what
        label volumes keep: mostly 1 mm and more
    thinnest_mm : no radius anywhere is smaller
    twigs : thin side branches per 100 mm of vessel, beside the named ones
    twig_flow : (lowest, highest) share of its parent's flow that a twig carries
    taper : share of its radius that a vessel loses on the way to its end, beside what it loses to
        branches
    winding_mm : strength of short bends
    wall : relative roughness of the radius from one point to the next
    jitter_mm : roughness of the centreline
    """

    floor_mm: tuple[float, float] | None = None
    thinnest_mm: float = 0.4
    twigs: float = 0.0
    twig_flow: tuple[float, float] = (0.02, 0.3)
    taper: float = 0.0
    winding_mm: float = 0.0
    wall: float = 0.06
    jitter_mm: float = 0.0


@dataclasses.dataclass(frozen=True, eq=False)
class SyntheticTree:
    """Vessels of one patient, centred on its bounding box."""

    vessels: tuple[Vessel, ...]

    def segments(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (n, 3) starts, (n, 3) ends and (n,) radii of capsules that cover the lumen."""
        starts = np.concatenate([v.points_mm[:-1] for v in self.vessels])
        ends = np.concatenate([v.points_mm[1:] for v in self.vessels])
        radii = np.concatenate([0.5 * (v.radius_mm[1:] + v.radius_mm[:-1]) for v in self.vessels])
        return starts, ends, radii

    def line(self, step_mm: float = 0.5) -> Points:
        """(n, 3) points of the centrelines, mm, so far apart."""
        return np.concatenate([resample(v.points_mm, step_mm) for v in self.vessels])

    def sides(self, which: str) -> SyntheticTree:
        """Keep the ``left`` or ``right`` vessels alone, centred anew."""
        kept = tuple(v for v in self.vessels if v.side == which)
        return _centred(dataclasses.replace(self, vessels=kept))


def thin_style(rng: np.random.Generator) -> TreeStyle:
    """Draw a style that contrast shows and label volumes lose: twigs, tapered ends, bends."""
    return TreeStyle(
        floor_mm=(0.22, 0.4),
        thinnest_mm=0.22,
        twigs=rng.uniform(0.5, 4.0),
        taper=rng.uniform(0.0, 0.6),
        winding_mm=rng.uniform(0.0, 0.8),
        wall=rng.choice([0.0, 0.03, 0.1]),
        jitter_mm=rng.choice([0.0, 0.1]),
    )


def rough_style(rng: np.random.Generator) -> TreeStyle:
    """Draw a style as of label volumes, from smooth to rough walls, straight to tortuous."""
    return TreeStyle(
        floor_mm=(0.35, 1.1) if rng.random() < 0.3 else None,
        twigs=rng.choice([0.0, rng.uniform(0.2, 1.5)]),
        twig_flow=(0.1, 0.4),
        winding_mm=rng.choice([0.0, rng.uniform(0.0, 0.8)]),
        wall=rng.uniform(0.0, 0.16),
        jitter_mm=rng.choice([0.0, rng.uniform(0.0, 0.3)]),
    )


def any_style(rng: np.random.Generator) -> TreeStyle | None:
    """Draw one of the three: plain (None), thin, rough."""
    return [None, thin_style(rng), rough_style(rng)][int(rng.integers(3))]


def random_tree(rng: np.random.Generator, style: TreeStyle | None = None) -> SyntheticTree:
    """Draw one patient's left and right coronary tree."""
    style = style or TreeStyle()
    heart = random_heart(rng)
    dominance = str(rng.choice(["right", "left", "balanced"], p=[0.8, 0.1, 0.1]))
    calibre = rng.uniform(0.85, 1.35)
    # Label volumes rarely keep what is thinner than a voxel or two: most trees end at 1 mm.
    floor = rng.uniform(0.55, 1.0) if rng.random() < 0.2 else rng.uniform(1.0, 1.65)
    vessels = _left_tree(rng, heart, dominance, calibre) + _right_tree(
        rng, heart, dominance, calibre
    )
    bend = random_warp(rng)
    if style.floor_mm is not None:
        floor = rng.uniform(*style.floor_mm)
    if style.twigs:
        vessels += [t for side in SIDES for t in _twigs(rng, heart, vessels, side, style)]
    wind = winding_warp(rng, style.winding_mm) if style.winding_mm else None
    finished = []
    for v in vessels:
        points = bend(v.points_mm)
        if wind is not None:
            points = wind(points)
        if style.jitter_mm:
            points = points + style.jitter_mm * rng.normal(size=points.shape)
        radius = v.radius_mm * (1 - style.taper * np.linspace(0, 1, len(v.radius_mm)))
        radius = texture_radius(rng, radius, floor, style.wall, style.thinnest_mm)
        finished.append(dataclasses.replace(v, points_mm=points, radius_mm=radius))
    return _centred(SyntheticTree(tuple(finished)))


# -- vessels ------------------------------------------------------------------------------


def _left_tree(
    rng: np.random.Generator, heart: Heart, dominance: str, calibre: float
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
    lm = free_curve(rng, [ostium, fork], bow=2.0)
    r_lad = daughter(rng, r_lm, 0.5, 0.62)
    r_lcx = (max(r_lm**MURRAY - r_lad**MURRAY, 0.2)) ** (1 / MURRAY)
    out = [vessel("LM", "left", lm, r_lm, 0.97 * r_lm)]
    lad = surface_curve(
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
    out.append(vessel("LAD", "left", lad, r_lad, r_lad * rng.uniform(0.45, 0.7)))
    for k in range(rng.choice([0, 1, 2, 3, 4], p=[0.06, 0.3, 0.36, 0.2, 0.08])):
        out += _side_branch(
            rng, heart, f"D{k + 1}", "left", out[1], (0.06, 0.7), sign=+1, reach=(25, 90)
        )
    for k in range(rng.choice([0, 1, 2, 3], p=[0.6, 0.22, 0.12, 0.06])):
        out += _septal(rng, heart, f"S{k + 1}", out[1])
    if rng.random() < 0.3:
        ramus = surface_curve(
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
        out.append(vessel("RI", "left", ramus, daughter(rng, r_lad, 0.3, 0.6), None))
    end_phi = {"right": rng.uniform(70, 150), "balanced": rng.uniform(130, 172), "left": 178.0}[
        dominance
    ]
    lcx = surface_curve(
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
    out.append(vessel("LCx", "left", lcx, r_lcx, r_lcx * rng.uniform(0.45, 0.75)))
    for k in range(rng.choice([0, 1, 2, 3, 4], p=[0.1, 0.3, 0.34, 0.18, 0.08])):
        out += _side_branch(
            rng, heart, f"OM{k + 1}", "left", out[i_cx], (0.1, 0.9), sign=0, reach=(20, 85)
        )
    if dominance == "left":
        out += _posterior(rng, heart, "left", out[i_cx])
    return out


def _right_tree(
    rng: np.random.Generator, heart: Heart, dominance: str, calibre: float
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
    rca = surface_curve(
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
    out = [vessel("RCA", "right", rca, r, r * rng.uniform(0.65, 0.95))]
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
    rng: np.random.Generator, heart: Heart, side: str, parent: Vessel, *, pda: bool = True,
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
        points = surface_curve(rng, heart, way, start=start, cut=rng.uniform(0.35, 1.0))
        out.append(vessel("PDA", side, points, daughter(rng, r_end, 0.4, 0.7), None))
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
        points = surface_curve(rng, heart, way, start=start, cut=rng.uniform(0.35, 1.0))
        out.append(vessel(f"PL{k + 1}", side, points, daughter(rng, r_end, 0.35, 0.7), None))
    return out


def _twigs(
    rng: np.random.Generator, heart: Heart, vessels: list[Vessel], side: str, style: TreeStyle
) -> list[Vessel]:
    """Thin branches anywhere on one side's tree, on twigs too."""
    parents = [v for v in vessels if v.side == side]
    length = STEP_MM * sum(len(v.points_mm) for v in parents)
    out = []
    for k in range(rng.poisson(style.twigs * length / 100)):
        share = np.array([len(v.points_mm) for v in parents], float)
        parent = parents[rng.choice(len(parents), p=share / share.sum())]
        if len(parent.points_mm) < 8:
            continue
        name = f"T{k + 1}"
        twig = _side_branch(rng, heart, name, side, parent, (0.1, 0.95), 0, (6, 40))[0]
        i = int(np.linalg.norm(parent.points_mm - twig.points_mm[0], axis=1).argmin())
        r0 = daughter(rng, float(parent.radius_mm[i]), *style.twig_flow)
        out.append(vessel(name, side, twig.points_mm, r0, None))
        parents.append(out[-1])
    return out


def _side_branch(
    rng: np.random.Generator, heart: Heart, name: str, side: str, parent: Vessel,
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
    points = surface_curve(rng, heart, way, start=start, cut=1.0)
    points = points[: max(5, int(rng.uniform(*reach) / STEP_MM))]
    r0 = daughter(rng, float(parent.radius_mm[i]), 0.25, 0.75)
    out = [vessel(name, side, points, r0, None)]
    if len(points) * STEP_MM > 30 and rng.random() < 0.22:
        out += _side_branch(rng, heart, name + "a", side, out[0], (0.25, 0.7), 0, (10, 45))
    return out


def _septal(rng: np.random.Generator, heart: Heart, name: str, parent: Vessel) -> list[Vessel]:
    i = int(np.clip(rng.uniform(0.08, 0.6) * len(parent.points_mm), 1, len(parent.points_mm) - 3))
    start = parent.points_mm[i]
    inward = -heart.axes[0] + 0.5 * heart.axes[2] + 0.25 * rng.normal(size=3)
    end = start + unit(inward) * rng.uniform(8, 35)
    return [
        vessel(
            name,
            "left",
            free_curve(rng, [start, end], bow=4.0),
            daughter(rng, float(parent.radius_mm[i]), 0.15, 0.4),
            None,
        )
    ]


def _centred(tree: SyntheticTree) -> SyntheticTree:
    everything = np.concatenate([v.points_mm for v in tree.vessels])
    middle = 0.5 * (everything.min(axis=0) + everything.max(axis=0))
    moved = tuple(dataclasses.replace(v, points_mm=v.points_mm - middle) for v in tree.vessels)
    return dataclasses.replace(tree, vessels=moved)


def _near(angle: float, reference: float) -> float:
    """Return the angle shifted by whole turns so that it is nearest to ``reference``."""
    return angle + 360.0 * round((reference - angle) / 360.0)

"""A beating heart: where a generated tree is at every phase of the beat.

The left ventricle shortens towards the apex, its wall moves inwards and twists, each by its own
curve over the beat, fast in systole and early filling, nearly still in between; the heart swings as
a whole, and a smooth field moves every part a little by itself. Amplitudes are those measured of
coronary arteries: 5 .. 20 mm in all, most in the atrioventricular groove (Shechter et al., IEEE
Trans Med Imaging 25 (2006) 369).
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from gcar_deploy.types import Array, Points, Scalars
from gcar_export.scenes.tree_curves import unit
from gcar_export.scenes.trees import SyntheticTree

#: share of the beat, and contraction there: R wave, end of systole, early filling, diastasis, the
#: atrium's kick
_TIMES = (0.0, 0.36, 0.52, 0.60, 0.84, 1.0)
_HEIGHTS = (0.0, 1.0, 0.35, 0.27, 0.22, 0.0)
_TIME_SPREAD, _HEIGHT_SPREAD = 0.12, 0.05


@dataclasses.dataclass(frozen=True, eq=False)
class Heartbeat:
    """How the points of one patient's tree move within a beat.

    Attributes
    ----------
    base_mm : (3,) middle of the valves' plane
    axes : (3, 3) rows: two across the heart, and towards the apex
    length_mm : from base to apex
    inwards : share of the distance from the axis that is lost at the end of systole
    shortening_mm : of the base towards the apex
    twist_deg : of the apex against the base
    swing_mm : (3, 4) first and second harmonic (cosine, sine) of the whole heart's own way
    own_mm, own_per_mm : (k, 3, 4), (k, 3) smooth field: harmonics and wave vectors
    squeeze : contraction over the beat, 0 .. 1 for phases 0 .. 1
    lead : beats by which the twist is ahead of it
    """

    base_mm: Points
    axes: Points
    length_mm: float
    inwards: float
    shortening_mm: float
    twist_deg: float
    swing_mm: Array
    own_mm: Array
    own_per_mm: Array
    squeeze: PchipInterpolator
    lead: float

    def at(self, points_mm: Points, phase: float) -> Points:
        """(n, 3) mm LPS, where the points that are at ``points_mm`` at the R wave are at a phase.

        Parameters
        ----------
        points_mm : (n, 3) mm LPS
        phase : beats since an R wave; whole beats change nothing
        """
        phase = phase % 1.0
        squeeze = float(self.squeeze(phase))
        turn = float(self.squeeze(phase + self.lead * np.sin(np.pi * phase)))
        x, y, z = self.axes @ (points_mm - self.base_mm).T
        height = np.clip(z / self.length_mm, -0.2, 1.0)
        z = z + self.shortening_mm * squeeze * (1 - height)
        closer = 1 - self.inwards * squeeze
        angle = np.deg2rad(self.twist_deg) * turn * (height - 0.3)
        x, y = (
            closer * (x * np.cos(angle) - y * np.sin(angle)),
            closer * (x * np.sin(angle) + y * np.cos(angle)),
        )
        out = np.stack([x, y, z], axis=1) @ self.axes + self.base_mm
        basis = _harmonics(phase)
        out = out + self.swing_mm @ basis
        waves = np.sin(points_mm @ self.own_per_mm.T + np.arange(len(self.own_per_mm)))
        moved: Points = out + waves @ (self.own_mm @ basis)
        return moved


def random_heartbeat(rng: np.random.Generator, tree: SyntheticTree) -> Heartbeat:
    """Draw the motion of one patient's heart."""
    points = np.concatenate([v.points_mm for v in tree.vessels])
    apex = unit(np.array([0.62, -0.55, -0.56]) + 0.15 * rng.normal(size=3))
    across = unit(np.cross(apex, rng.normal(size=3)))
    axes = np.stack([across, np.cross(apex, across), apex])
    along = points @ apex
    low, high = np.percentile(along, [5, 99])
    middle = points.mean(axis=0)
    base = middle + (low - middle @ apex) * apex
    steps = np.diff(_TIMES) * np.exp(_TIME_SPREAD * rng.normal(size=len(_TIMES) - 1))
    times = np.concatenate([[0.0], np.cumsum(steps) / steps.sum()])
    heights = np.array(_HEIGHTS) + _HEIGHT_SPREAD * rng.normal(size=6) * (0, 0, 1, 1, 1, 0)
    fields = 4
    return Heartbeat(
        base_mm=base, axes=axes, length_mm=float(high - low),
        inwards=rng.uniform(0.06, 0.2),
        shortening_mm=rng.uniform(7, 16),
        twist_deg=float(rng.choice([-1, 1])) * rng.uniform(5, 16),
        swing_mm=rng.normal(size=(3, 4)) * (1.2, 1.2, 0.5, 0.5),
        own_mm=rng.normal(size=(fields, 3, 4)) * (0.5, 0.5, 0.25, 0.25),
        own_per_mm=rng.normal(size=(fields, 3)) / 25.0,
        squeeze=PchipInterpolator(times, heights),
        lead=rng.uniform(0.02, 0.08),
    )  # fmt: skip


def _harmonics(phase: float) -> Scalars:
    """(4,) zero at phase 0: every point is at home at the R wave."""
    t = 2 * np.pi * phase
    return np.array([1 - np.cos(t), np.sin(t), 1 - np.cos(2 * t), np.sin(2 * t)])


@dataclasses.dataclass(frozen=True, eq=False)
class RunMotion:
    """What moves in one run beside the beat.

    Attributes
    ----------
    phases : (n,) beats since an R wave at each frame
    shift_mm : (n, 3) of the whole patient: table, then breathing
    bolus : (n,) time of each frame in frames since contrast came out of the catheter
    """

    phases: Scalars
    shift_mm: Points
    bolus: Scalars


def random_run(
    rng: np.random.Generator, frames: int, beats: float, table_mm: float, wait: float = 0.0
) -> RunMotion:
    """Draw beats of uneven length, breathing, and when contrast is given.

    Parameters
    ----------
    frames : int
    beats : of the whole run, give or take a fifth
    table_mm : standard deviation along each axis of where the patient lies
    wait : frames by which contrast comes later; at 0 half of all runs begin filled
    """
    rate = beats * rng.uniform(0.8, 1.2) / frames
    # Beats differ by some percent: the phase is a smooth curve of time.
    knots = np.linspace(0, frames - 1, 4)
    rates = rate * (1 + 0.05 * rng.normal(size=4))
    run = CubicSpline(knots, rates).antiderivative()(np.arange(frames))
    phases: Scalars = np.asarray(rng.uniform(0, 1) + run, dtype=np.float64)
    time = np.arange(frames) / frames
    breath = rng.uniform(0, 6) * np.sin(2 * np.pi * (rng.uniform(0.2, 0.7) * time + rng.uniform()))
    way = unit(np.array([0.0, 0.35, 1.0]) + 0.2 * rng.normal(size=3))
    shift = (breath - breath[0])[:, None] * way + table_mm * rng.normal(size=3)
    bolus = np.arange(float(frames)) - rng.uniform(-5, 3) - wait
    return RunMotion(phases, np.asarray(shift), bolus)

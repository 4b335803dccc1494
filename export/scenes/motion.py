"""Smooth motion of a heart between two runs, beyond a rigid shift: cardiac phase and breathing.

The heart contracts about its axis, shortens along it and twists; what lies round it adds long
waves (Shechter et al., IEEE TMI 25 (2006) 369: cardiac and respiratory motion of the coronary
arteries, of which the rigid part is the larger). The mean move is taken out: a rigid shift is a
matter of the pose.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.types import Points
from gcar_export.scenes.trees import SyntheticTree

#: wavelengths of the waves, mm, and how many there are
WAVES_MM, WAVES = (90.0, 240.0), 4


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class HeartMotion:
    """A displacement u(X) = (M X + sum of waves) * scale - mean.

    Attributes
    ----------
    matrix : (3, 3) contraction, shortening and (small) twist: a linear field
    twist : (3,) axis times twist per mm along it, rad / mm
    waves, phases, amplitudes : (k, 3) rad / mm, (k,), (k, 3) mm
    scale : float
    mean_mm : (3,) what is taken out
    """

    matrix: np.ndarray
    twist: np.ndarray
    waves: np.ndarray
    phases: np.ndarray
    amplitudes: np.ndarray
    scale: float = 1.0
    mean_mm: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))

    def at(self, points: Points) -> Points:
        """(n, 3) displacements of points, mm."""
        axis = self.twist / max(float(np.linalg.norm(self.twist)), 1e-12)
        turned = (points @ axis)[:, None] * np.cross(self.twist, points)
        long = np.sin(points @ self.waves.T + self.phases) @ self.amplitudes
        return self.scale * (points @ self.matrix.T + turned + long) - self.mean_mm


def heart_motion(rng: np.random.Generator, points: Points, rms_mm: float) -> HeartMotion:
    """Draw a motion whose root mean square over ``points`` (n, 3) is ``rms_mm``, its mean zero."""
    axis = np.array([0.62, -0.55, -0.56]) + 0.22 * rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    along = np.outer(axis, axis)
    contraction, shortening = rng.uniform(-1, 1, 2) * (0.06, 0.06)
    directions = rng.normal(size=(WAVES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    motion = HeartMotion(
        matrix=contraction * (np.eye(3) - along) + shortening * along,
        twist=axis * rng.normal() * 0.0015,
        waves=2 * np.pi * directions / rng.uniform(*WAVES_MM, size=(WAVES, 1)),
        phases=rng.uniform(0, 2 * np.pi, WAVES),
        amplitudes=rng.normal(size=(WAVES, 3)) * rng.uniform(0.3, 1.5),
    )
    free = motion.at(points)
    mean = free.mean(axis=0)
    scale = rms_mm / float(np.sqrt(np.mean(np.sum((free - mean) ** 2, axis=1))))
    return dataclasses.replace(motion, scale=scale, mean_mm=scale * mean)


def moved_tree(tree: SyntheticTree, motion: HeartMotion, along: np.ndarray) -> SyntheticTree:
    """Return the tree displaced by the part of a motion that ``along`` (3, 3) lets through."""
    return dataclasses.replace(
        tree,
        vessels=tuple(
            dataclasses.replace(v, points_mm=v.points_mm + motion.at(v.points_mm) @ along.T)
            for v in tree.vessels
        ),
    )

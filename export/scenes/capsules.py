"""Trees as capsules, generated ones and those of users' label volumes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

#: (m, 3) points along a line and (m,) radii, mm
Tube = tuple[np.ndarray, np.ndarray]


@dataclasses.dataclass(frozen=True, eq=False)
class Capsules:
    """A tree as capsules: (n, 3) starts and ends in mm LPS, (n,) radii in mm."""

    starts: np.ndarray
    ends: np.ndarray
    radii: np.ndarray

    @staticmethod
    def of(tubes: Sequence[Tube]) -> Capsules:
        """Cover tubes; a capsule's radius is the mean of those at its ends."""
        return Capsules(
            np.concatenate([points[:-1] for points, _ in tubes]),
            np.concatenate([points[1:] for points, _ in tubes]),
            np.concatenate([0.5 * (radius[1:] + radius[:-1]) for _, radius in tubes]),
        )

    def moved(self, shift_mm: np.ndarray) -> Capsules:
        """Return the tree moved by (3,) mm."""
        return Capsules(self.starts + shift_mm, self.ends + shift_mm, self.radii)

    def turned(self, matrix: np.ndarray) -> Capsules:
        """Return the tree turned (or mirrored) about the isocentre."""
        return Capsules(self.starts @ matrix.T, self.ends @ matrix.T, self.radii)

    def kept(self, which: np.ndarray) -> Capsules:
        """Return the capsules chosen by a (n,) bool."""
        return Capsules(self.starts[which], self.ends[which], self.radii[which])

    @property
    def reach_mm(self) -> float:
        """Largest coordinate, mm."""
        return float(max(np.abs(self.starts).max(), np.abs(self.ends).max()))

    def oval(self, rng: np.random.Generator) -> Capsules:
        """Return a lumen of oval sections round the same lines, of about the same area."""
        stretch = rng.uniform(0.1, 0.45)
        along = self.ends - self.starts
        # One direction of space keeps the long axis of neighbouring sections alike.
        across = np.cross(along, rng.normal(size=3))
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
        shift = (stretch * self.radii)[:, None] * across
        radii = self.radii * (1 - 0.55 * stretch)
        return Capsules(
            np.concatenate([self.starts - shift, self.starts, self.starts + shift]),
            np.concatenate([self.ends - shift, self.ends, self.ends + shift]),
            np.tile(radii, 3),
        )


@dataclasses.dataclass(frozen=True, eq=False)
class LabelTree:
    """A user's tree: whole, and its left and right side where the label tells them apart."""

    whole: Capsules
    sides: tuple[Capsules, ...] = ()

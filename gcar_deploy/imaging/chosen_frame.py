"""Which frame of a run a picture is, and how well it goes with that of another run."""

from __future__ import annotations

import dataclasses
from typing import Any

from gcar_deploy.types import Array, Mask, Scalars


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class FramePair:
    """Frames of two runs held against each other, and the pair that was taken.

    Attributes
    ----------
    scores : (n, m) correlation of how the contrast is spread over the epipolar planes, -1 .. 1
    remaining : (n, m) bool, pairs that are filled and still enough to be taken
    chosen : frames of the first and the second run, from 0
    margin : how far ``chosen`` is ahead of the best pair in which one of both frames shows another
        shape of the heart; None where no remaining frame does
    filling, motion : of both runs, per frame: contrast, 1 where it is nearly the most, and share of
        it that stands elsewhere in the neighbouring frames
    """

    scores: Array
    remaining: Mask
    chosen: tuple[int, int]
    margin: float | None
    filling: tuple[Scalars, Scalars]
    motion: tuple[Scalars, Scalars]

    @property
    def score(self) -> float:
        """Of the pair that was taken."""
        return float(self.scores[self.chosen])


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ChosenFrame:
    """Frame of a run that the program itself chose.

    Attributes
    ----------
    number : from 1
    of : frames of the run
    reason : end of a sentence
    pair : how it was chosen together with a frame of another run; None: by itself
    partner : number of that other run among the views, from 1; None without one
    """

    number: int
    of: int
    reason: str
    pair: FramePair | None = None
    partner: int | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values, as in ``result.json``."""
        return {
            "number": self.number,
            "of": self.of,
            "reason": self.reason,
            "partner": self.partner,
            "score": None if self.pair is None else self.pair.score,
            "margin": None if self.pair is None else self.pair.margin,
        }

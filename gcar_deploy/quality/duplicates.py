"""Two pictures that are one: by what they show, whatever bytes hold it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import cv2
import numpy as np

from gcar_deploy.errors import RefusedError
from gcar_deploy.geometry.carm import separation_deg
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.types import Image

#: pictures are compared at this size, smaller ones at their own: noise, depth and scale of the
#: grey values no longer matter
_SIDE = 96
#: Correlation from which two pictures are one, between copies in other depths, sizes and noise
#: and different views that share table and collimator
_SAME = 0.94
#: what varies over more than this is background, pixels of that size
_BACKGROUND_PX = 3.0
#: directions nearer to each other than this show nearly the same, deg
_NEAR_DEG = 10.0


def check_duplicates(angiograms: Sequence[Angiogram]) -> None:
    """Refuse a picture that was given twice.

    Raises
    ------
    RefusedError
        Two pictures show the same, in equal or in other bytes.
    """
    side = min(_SIDE, *(min(a.pixels.shape) for a in angiograms))
    small = [_signature(a.pixels, side) for a in angiograms]
    for (first, a), (second, b) in combinations(zip(angiograms, small, strict=True), 2):
        apart = separation_deg(first.carm, second.carm) > _NEAR_DEG
        equal = first.sha256 != "" and first.sha256 == second.sha256
        if equal or (apart and float((a * b).sum()) > _SAME):
            raise RefusedError(
                f"views {first.view_id} and {second.view_id} are the same picture; "
                "give two different runs"
            )


def _signature(pixels: Image, side: int) -> Image:
    """(side, side) area averages of mean 0 and length 1; zeros for a constant picture."""
    # Sums of the largest grey values would be infinite.
    scaled = np.asarray(pixels, np.float32) / (np.abs(pixels).max() or 1)
    small = cv2.resize(scaled, (side, side), interpolation=cv2.INTER_AREA)
    # A background that both views share is no sign of one picture.
    small = small - cv2.GaussianBlur(small, (0, 0), _BACKGROUND_PX)
    small = small - small.mean()
    length = float(np.linalg.norm(small))
    out: Image = small / length if length > 0 else small
    return out

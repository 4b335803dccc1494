"""Two pictures that are one: by what they show, whatever bytes hold it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import cv2
import numpy as np

from gcar_deploy.errors import RefusedError
from gcar_deploy.geometry.carm import separation_deg
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.imaging.collimator import collimator
from gcar_deploy.types import Image

#: pictures are compared at this size, smaller ones at their own: noise, depth and scale of the
#: grey values no longer matter
_SIDE = 96
#: Correlation from which two pictures are one, between copies in other depths, sizes and noise
#: and different views that share table and collimator
_SAME = 0.94
#: what varies over more than this is background, pixels of that size
_BACKGROUND_PX = 3.0
#: share of a small pixel that no collimator shuts
_OPEN = 0.99
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
    small = [_signature(a, side) for a in angiograms]
    for (first, a), (second, b) in combinations(zip(angiograms, small, strict=True), 2):
        if not (np.ptp(first.pixels) or np.ptp(second.pixels)):
            continue  # that both are blank is told where vessels are looked for
        apart = separation_deg(first.carm, second.carm) > _NEAR_DEG
        equal = first.sha256 != "" and first.sha256 == second.sha256
        if equal or (apart and _correlation(a, b) > _SAME):
            raise RefusedError(
                f"views {first.view_id} and {second.view_id} are the same picture; "
                "give two different runs"
            )


def _signature(angiogram: Angiogram, side: int) -> tuple[Image, Image]:
    """(side, side) area averages without background, and what of each is picture, 0 or 1.

    A collimator's rim stands out more than any vessel, and the views of a study share it.
    """
    pixels, shut = angiogram.pixels, np.zeros(angiogram.pixels.shape, bool)
    if angiogram.intensity.kind == "raw":
        shut = collimator(pixels) | collimator(pixels, negative=True)
    # Sums of the largest grey values would be infinite.
    scaled = np.asarray(pixels, np.float32) / (np.abs(pixels).max() or 1)
    small, open_ = (
        cv2.resize(picture, (side, side), interpolation=cv2.INTER_AREA)
        for picture in (scaled, (~shut).astype(np.float32))
    )
    shown = (open_ > _OPEN).astype(np.float32)
    # A background that both views share is no sign of one picture.
    near, whole = (cv2.GaussianBlur(one, (0, 0), _BACKGROUND_PX) for one in (small * shown, shown))
    left: Image = ((small - near / np.maximum(whole, 1e-3)) * shown).astype(np.float32)
    return left, shown


def _correlation(first: tuple[Image, Image], second: tuple[Image, Image]) -> float:
    """Of two signatures where both show a picture; 0 where either is constant."""
    both = (first[1] * second[1]) > 0
    if not both.any():
        return 0.0
    a, b = (picture[both] - picture[both].mean() for picture, _ in (first, second))
    length = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / length if length > 0 else 0.0

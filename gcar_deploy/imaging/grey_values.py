"""Grey values as pictures with bright vessels whose paths add up, one for each law of theirs."""

from __future__ import annotations

import numpy as np

from gcar_deploy.imaging import enhance
from gcar_deploy.imaging.collimator import collimator
from gcar_deploy.types import Image, Mask

#: grey values are no darker than this share of the white level: half a step of 16 bits
BLACK = 2.0**-17


def bright_vessels(pixels: Image, kind: str, dark: bool) -> tuple[dict[str, Image], Mask]:
    """Pictures in which vessels are bright and paths add up, one per grey-value law.

    Returns
    -------
    pictures : name -> (rows, cols) float32
        ``search`` (where given) is the one to look for vessels in; the others are linear in
        the path if their law holds: ``linear`` (logarithm taken), ``log`` (Beer's law), and
        ``display``, a compromise that is nowhere far off.
    holes : (rows, cols) bool, collimator
    """
    white = max(float(np.percentile(pixels, 99.5)), 1e-12)
    level = pixels / np.float32(white)
    if kind == "attenuation":
        level = -level if dark else level
        return {"linear": level, "display": level}, np.zeros(pixels.shape, bool)
    if not dark:  # a negative: turn it back, so that Beer's law can be tried on it
        level = float(level.max()) - level
    holes = collimator(pixels, negative=not dark)
    # Half of the darkest grey value that is one: black stays finite, whatever a count is.
    darkest = float(np.min(level, where=level > 0, initial=np.inf))
    floor = np.float32(min(max(0.5 * darkest, BLACK), 1.0))
    return {
        "search": enhance.absorbance(level),
        "display": -np.log(np.clip(level, 0, None) + np.float32(enhance.DISPLAY_OFFSET)),
        "linear": -level,
        "log": -np.log(np.maximum(level, floor)),
    }, holes

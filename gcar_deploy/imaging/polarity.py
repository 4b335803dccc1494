"""Whether vessels are darker or brighter than what surrounds them."""

from __future__ import annotations

import dataclasses
import logging

from gcar_deploy.imaging import enhance
from gcar_deploy.imaging.angiogram import Angiogram

_log = logging.getLogger(__name__)
#: polarity is taken from the picture only when one sign answers this much more strongly. Forty real
#: pictures: dark by 1.5 and more; generated ones of noise and thick bone: bright by up to 1.2
_POLARITY_MARGIN = 1.4


def with_polarity(angiogram: Angiogram) -> Angiogram:
    """Return the picture with its polarity declared: it is looked for once."""
    told = angiogram.intensity
    if told.kind in ("path_length", "mask") or told.polarity != "auto":
        return angiogram
    polarity = "dark" if is_dark(angiogram) else "bright"
    return dataclasses.replace(angiogram, intensity=dataclasses.replace(told, polarity=polarity))


def is_dark(angiogram: Angiogram) -> bool:
    """Whether vessels are darker than their surroundings: declared, else seen, else usual."""
    declared = angiogram.intensity.polarity
    if declared != "auto":
        return declared == "dark"
    usual = angiogram.intensity.kind == "raw"
    seen, margin = enhance.vessels_are_dark(angiogram.pixels, angiogram.carm.pixel_at_isocenter_mm)
    decided = margin >= _POLARITY_MARGIN
    _log.info(
        "view %s: vessels taken as %s (%s, strengths differ by a factor %.2f)",
        angiogram.view_id, "dark" if (seen if decided else usual) else "bright",
        "seen in the picture" if decided else f"usual for {angiogram.intensity.kind}", margin,
    )  # fmt: skip
    return seen if decided else usual

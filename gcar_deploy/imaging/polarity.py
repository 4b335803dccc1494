"""Whether vessels are darker or brighter than what surrounds them."""

from __future__ import annotations

import dataclasses
import functools
import logging
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from gcar_deploy.beside import side_by_side
from gcar_deploy.imaging import enhance
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.types import Array, Image

if TYPE_CHECKING:  # only a name in annotations: pictures need no scene file
    from gcar_deploy.geometry.scene import Intensity

_log = logging.getLogger(__name__)
#: polarity is taken from pictures only where one sign shows so many times as much. Of dark ones
#: forty real show 1.27 times as much or more (one under 1.5), sixty generated ones of all displays
#: 1.01 (six under 1.5)
_MARGIN = 1.5
#: ... and from a single picture against the others where it shows so many times as much
_SURE = 3.0
#: so many frames of a run are asked
_ASKED = 6


def with_polarity(angiograms: Sequence[Angiogram]) -> list[Angiogram]:
    """Return the pictures with their polarity declared: it is looked for once.

    Those of one kind that do not say theirs came through one chain of display and are judged
    together: a noisy one is read like the clear one beside it.
    """
    out = list(angiograms)
    for kind in ("raw", "attenuation"):
        open_ = [
            k for k, one in enumerate(out)
            if one.intensity.kind == kind and one.intensity.polarity == "auto"
        ]  # fmt: skip
        for k, dark in zip(open_, _are_dark([out[k] for k in open_]), strict=True):
            told = dataclasses.replace(out[k].intensity, polarity="dark" if dark else "bright")
            out[k] = dataclasses.replace(out[k], intensity=told)
    return out


def is_dark(angiogram: Angiogram) -> bool:
    """Whether vessels are darker than their surroundings: declared, else seen, else usual."""
    if angiogram.intensity.polarity != "auto":
        return angiogram.intensity.polarity == "dark"
    return _are_dark([angiogram])[0]


def is_dark_run(frames: Sequence[Image] | Array, pixel_mm: float, intensity: Intensity) -> bool:
    """``is_dark`` of a run, by the frame that tells most: one without contrast tells nothing."""
    if intensity.polarity != "auto":
        return intensity.polarity == "dark"
    some = frames[:: max(1, len(frames) // _ASKED)]
    said = max((enhance.darkness(one, pixel_mm) for one in some), key=abs)
    return said > 0 if _decides(said) else intensity.kind == "raw"


def _decides(said: float) -> bool:
    return abs(said) >= math.log(_MARGIN)


def _are_dark(angiograms: Sequence[Angiogram]) -> list[bool]:
    """Say it of pictures of one kind: what one shows for sure, else what all show together."""
    works = [
        functools.partial(enhance.darkness, one.pixels, one.carm.pixel_at_isocenter_mm)
        for one in angiograms
    ]
    seen = side_by_side(works)
    together = math.fsum(seen) / max(len(seen), 1)
    out = []
    for one, own in zip(angiograms, seen, strict=True):
        said = own if abs(own) >= math.log(_SURE) else together
        decided = _decides(said)
        dark = said > 0 if decided else one.intensity.kind == "raw"
        why = "seen" if decided else f"usual for {one.intensity.kind}"
        _log.info(
            "view %s: vessels taken as %s (%s, strengths differ by a factor %.2f, %.2f together)",
            one.view_id, "dark" if dark else "bright", why, math.exp(own), math.exp(together),
        )  # fmt: skip
        out.append(dark)
    return out

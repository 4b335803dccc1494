"""What of a picture says how much vessel a ray crosses: paths, absorbance or a mask."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import cv2
import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.extract import above_half
from gcar_deploy.imaging.polarity import is_dark
from gcar_deploy.types import Array, Image, Mask

#: display curves that are tried: path as -log(level + offset); a large offset is a linear one
OFFSETS = (0.0, 0.1, 0.25, 0.6, 1.5, 4.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Signal:
    """One view's picture.

    Attributes
    ----------
    carm : CArm, with the geometry that was used
    image : (rows, cols) float32; mm of ``path``, 0 or 1 of ``mask``, else levels, vessels bright
        where ``laws`` says how
    valid : (rows, cols) bool, pixels that carry a picture
    kind : ``path``, ``contrast`` or ``mask``
    laws : what may turn levels into something linear in the path
    """

    carm: CArm
    image: Image
    valid: Mask
    kind: str
    laws: tuple[Callable[[Array], Array], ...] = (np.asarray,)

    @property
    def calibrated(self) -> bool:
        """Whether it shows millimetres of vessel."""
        return self.kind == "path"

    def at(self, pixels: Array) -> tuple[Array, Array]:
        """(n, m) values at (n, m, 2) places (col, row), and whether there is a picture."""
        where = np.nan_to_num(pixels, posinf=-9.0, neginf=-9.0).clip(-9, 32000).astype(np.float32)
        column, row = where[:, :, 0], where[:, :, 1]
        value = cv2.remap(self.image, column, row, cv2.INTER_LINEAR, borderValue=0.0)
        inside = cv2.remap(
            self.valid.astype(np.float32), column, row, cv2.INTER_LINEAR, borderValue=0.0
        )
        return np.asarray(value, dtype=np.float64), inside > 0.999


def read_signal(angiogram: Angiogram, view: VesselImage) -> Signal:
    """Choose what of a picture to measure by.

    Parameters
    ----------
    angiogram : the picture
    view : what was found in it, with the geometry that was used
    """
    kind, pixels = angiogram.intensity.kind, angiogram.pixels
    if view.painted is not None:
        # Whoever paints says that the picture does not show the vessel as it is.
        view = dataclasses.replace(view, valid=view.valid & ~view.painted)
    if kind == "mask":
        return Signal(view.carm, above_half(pixels).astype(np.float32), view.valid, "mask")
    if kind == "path_length":
        path = pixels * np.float32(angiogram.intensity.mm_per_count or 1.0)
        return Signal(view.carm, path.astype(np.float32), view.valid, "path")
    white = max(float(np.percentile(pixels, 99.5)), 1e-12)
    level = np.ascontiguousarray(pixels / np.float32(white), dtype=np.float32)
    dark = is_dark(angiogram)
    if kind == "attenuation":
        return Signal(view.carm, -level if dark else level, view.valid, "contrast")
    if not dark:
        level = float(level.max()) - level
    laws = tuple(functools.partial(_absorbed, offset=offset + 0.5 / white) for offset in OFFSETS)
    return Signal(view.carm, level, view.valid, "contrast", laws)


def _absorbed(level: Array, offset: float) -> Array:
    out: Array = -np.log(np.maximum(level, 0.0) + offset)
    return out

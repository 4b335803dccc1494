"""The steps of vessel extraction as PNG files."""

from __future__ import annotations

import cv2
import numpy as np

from gcar_deploy.errors import GcarError
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.types import Array

#: colours of the picture of steps, blue green red
_LINE = (60, 220, 60)
_CATHETER = (40, 60, 255)


def vessel_pictures(found: VesselImage) -> dict[str, Array]:
    """Draw each step; path lengths stand in where nothing was enhanced.

    Returns
    -------
    file name -> (rows, cols) uint8; ``steps.png`` is (rows, cols, 3): the response in grey, the
    skeleton in green, what was taken for a catheter in red
    """
    response = found.path_mm if found.vesselness is None else found.vesselness
    top = max(float(np.percentile(response, 99.9)), 1e-12)
    grey = np.round(np.clip(response / top, 0, 1) * 255).astype(np.uint8)
    steps = np.repeat(grey[:, :, None], 3, axis=2)
    if found.catheter is not None:
        steps[found.catheter] = _CATHETER
    steps[found.skeleton] = _LINE
    return {
        "vesselness.png": grey,
        "mask.png": found.mask.astype(np.uint8) * 255,
        "skeleton.png": found.skeleton.astype(np.uint8) * 255,
        "steps.png": steps,
    }


def png_files(found: VesselImage) -> dict[str, bytes]:
    """File name -> content, of ``vessel_pictures``."""
    files = {}
    for name, picture in vessel_pictures(found).items():
        ok, data = cv2.imencode(".png", picture)
        if not ok:
            raise GcarError(f"{name} cannot be encoded")
        files[name] = data.tobytes()
    return files

"""The steps of vessel extraction as PNG files."""

from __future__ import annotations

import cv2
import numpy as np

from gcar_deploy.errors import GcarError
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.types import Array


def vessel_pictures(found: VesselImage) -> dict[str, Array]:
    """File name -> (rows, cols) uint8 picture; path lengths stand in where nothing was enhanced."""
    response = found.path_mm if found.vesselness is None else found.vesselness
    top = max(float(np.percentile(response, 99.9)), 1e-12)
    return {
        "vesselness.png": np.round(np.clip(response / top, 0, 1) * 255).astype(np.uint8),
        "mask.png": found.mask.astype(np.uint8) * 255,
        "skeleton.png": found.skeleton.astype(np.uint8) * 255,
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

"""The steps of vessel extraction as PNG files, all or none."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from gcar_deploy.errors import UsageError
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


def write_folder(out_dir: Path, pictures: Mapping[str, Array], *, force: bool = False) -> None:
    """Write pictures into a new folder by way of a temporary one beside it and a rename.

    Raises
    ------
    UsageError
        The folder exists (without ``force``), is a file or a link, or cannot be written.
    """
    if out_dir.is_symlink() or (out_dir.exists() and not out_dir.is_dir()):
        raise UsageError(f"{out_dir} is not a folder; choose another name")
    if out_dir.exists() and not force:
        raise UsageError(f"{out_dir} exists; choose another folder or add --force")
    try:
        out_dir.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out_dir.parent, prefix=".gcar-") as temporary:
            fresh = Path(temporary) / "new"
            fresh.mkdir()
            for name, picture in pictures.items():
                ok, data = cv2.imencode(".png", picture)
                if not ok:
                    raise OSError("a picture could not be encoded")
                (fresh / name).write_bytes(data.tobytes())
            if out_dir.exists():
                os.rename(out_dir, Path(temporary) / "old")
            shutil.move(fresh, out_dir)
    except OSError as error:
        raise UsageError(f"{out_dir} cannot be written ({error.strerror or error})") from None

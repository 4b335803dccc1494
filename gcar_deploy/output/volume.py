"""volume.nii.gz: vessel occupancy as NIfTI, byte for byte the same for the same input."""

from __future__ import annotations

import gzip

import nibabel
import numpy as np

from gcar_deploy.geometry.grid import Grid
from gcar_deploy.types import Volume


def nifti_bytes(volume: Volume, grid: Grid) -> bytes:
    """Encode an occupancy volume.

    Parameters
    ----------
    volume : (nx, ny, nz) float32, 0 .. 1
    grid : Grid
        Its affine is written in mm RAS, as NIfTI wants it.
    """
    affine = grid.affine_ras()
    image = nibabel.Nifti1Image(np.asarray(volume, dtype=np.float32), affine)
    image.header.set_xyzt_units("mm")
    image.header["descrip"] = b"gcar vessel occupancy 0..1"
    image.header["cal_max"] = 1.0
    # Scanner-anatomical: the coordinates are the patient's, origin at the isocentre.
    image.set_sform(affine, code=1)
    image.set_qform(affine, code=1)
    return gzip.compress(image.to_bytes(), compresslevel=6, mtime=0)

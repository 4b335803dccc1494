"""Pictures upright to the next quarter turn: on its side, one shows the same vessels.

Skeletons, blocks of pixels and the network look different along rows and columns, so a picture that
is turned by a right angle with its geometry would give another tree.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from gcar_deploy.errors import GeometryError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.matrix import read_off
from gcar_deploy.geometry.own_frame import GRAIN_DIGITS
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.types import Array


def upright(carm: CArm) -> tuple[CArm, int]:
    """Return the view of a picture that stands upright, and what brings it there.

    Parameters
    ----------
    carm : CArm in the scene's own coordinates

    Returns
    -------
    carm : its detector turned by -45 .. 45 deg
    turns : quarter turns of the picture, anticlockwise, 0 .. 3
    """
    # Each takes 90 deg from what the detector is turned by.
    turns = math.floor((carm.detector_rotation_deg + 45.0) / 90.0) % 4
    if not turns or carm.projection_matrix is not None:
        return carm, 0
    told = read_off(_pixel_turn(carm, turns) @ carm.world2pixel).rounded(GRAIN_DIGITS)
    rows, columns = (carm.rows, carm.columns)[:: -1 if turns % 2 else 1]
    try:
        return CArm.from_reading(told, carm.sdd_mm, rows=rows, columns=columns), turns
    except GeometryError:
        # The view is at the very end of a range.
        return carm, 0


def turned_point(
    carm: CArm, point: tuple[float, float] | None, turns: int
) -> tuple[float, float] | None:
    """Return where a point (col, row) of a view's picture lies in the turned one."""
    if point is None or not turns:
        return point
    column, row, _ = (_pixel_turn(carm, turns) @ [*point, 1.0]).tolist()
    return column, row


def turned_angiogram(angiogram: Angiogram, carm: CArm, turns: int) -> Angiogram:
    """Return a picture and all that was drawn in it, turned; ``carm`` is the view it then has."""
    return dataclasses.replace(
        angiogram,
        carm=carm,
        bare=tuple(_turned(frame, turns) for frame in angiogram.bare),
        **_arrays(angiogram, ("pixels", "valid", "mask", "erased", "painted"), turns),
    )


def turned_view(found: VesselImage, carm: CArm, turns: int) -> VesselImage:
    """Return what was found in a picture, turned; ``carm`` is the view that it then has."""
    if not turns:
        return dataclasses.replace(found, carm=carm)
    kept = found.kept
    return dataclasses.replace(
        found,
        carm=carm,
        others=tuple(turned_view(other, carm, turns) for other in found.others),
        kept=None if kept is None else lambda: turned_view(kept(), carm, turns),
        **_arrays(
            found,
            ("path_mm", "mask", "skeleton", "valid", "vesselness", "catheter", "device", "painted"),
            turns,
        ),
    )


def _arrays(of: Angiogram | VesselImage, names: Sequence[str], turns: int) -> dict[str, Any]:
    return {name: _turned(getattr(of, name), turns) for name in names}


def _turned(array: Any, turns: int) -> Any:
    if array is None or not turns:
        return array
    return np.ascontiguousarray(np.rot90(array, turns))


def _pixel_turn(carm: CArm, turns: int) -> Array:
    """(3, 3) from a picture's pixels (col, row, 1) to those of the turned one."""
    out, rows, columns = np.eye(3), carm.rows, carm.columns
    for _ in range(turns % 4):
        out = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, columns - 1.0], [0.0, 0.0, 1.0]]) @ out
        rows, columns = columns, rows
    return out

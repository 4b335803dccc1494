"""A large shift between the runs that a wrong scale of one view would ask for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gcar_deploy.imaging.angiogram import VesselImage

#: a view whose pixels are told too small or too large fits when the patient stands nearer to its
#: source or farther: a shift so much of which is along its beam, and so large a share of its SOD
ALONG_SHARE, LEAST_SCALE = 0.85, 0.02


def along_a_beam(views: Sequence[VesselImage], offset_mm: Sequence[float]) -> str:
    """Say whose scale would explain a large shift: nearly all of it along that view's beam."""
    shift = float(np.linalg.norm(offset_mm))
    along = [float(abs(view.carm.axes[2] @ offset_mm)) for view in views]
    most = int(np.argmax(along))
    share = along[most] / views[most].carm.sod_mm
    if along[most] < ALONG_SHARE * shift or share < LEAST_SCALE:
        return ""
    return (
        f", nearly all of it along the beam of view {views[most].view_id}, as where its pixel "
        f"spacing, SDD or SOD is some {share:.0%} off"
    )

"""Frames of a run before contrast comes."""

from __future__ import annotations

import numpy as np

from gcar_deploy.frames.choose import SeenRun, reduced_frames
from gcar_deploy.frames.masses import run_masses
from gcar_deploy.types import Scalars

#: the first frames hold no more than this share of the contrast, and later ones so much more
_FLOOR, _RISE = 0.45, 0.4
#: what the first frames may differ by: noise, and a catheter that beats with the heart
_SPREAD = 0.12
#: frames before the one that is taken that are read: six seconds at 15 a second
_BACK = 90
#: most frames that are worth looking at
MOST = 6


def bare_frames(filling: Scalars) -> tuple[int, ...]:
    """Frames (from 0) that surely hold no contrast, at most ``MOST``; mostly there are none.

    Parameters
    ----------
    filling : (n,) contrast of each frame, about 1 where it is most (``masses.RunMasses``)
    """
    floor = float(filling[:2].mean())
    if floor > _FLOOR or filling.max() < floor + _RISE:
        return ()
    # The first drop of contrast is in the trunk: the frame before it is left out as well.
    count = int(np.argmax(filling > floor + _SPREAD)) - 1
    if count < 1:
        return ()
    return tuple(sorted({int(k) for k in np.linspace(0, count - 1, MOST).round()}))


def bare_before(run: SeenRun, frame: int) -> tuple[int, ...]:
    """Bare frames of a run before a frame (from 0): the same however that frame was chosen."""
    if frame < 2:
        return ()
    first = max(0, frame - _BACK)
    small = reduced_frames(run, range(first, frame + 1))
    masses = run_masses(small, run.carm, run.intensity, run.cine.valid)
    return tuple(first + k for k in bare_frames(masses.filling)) if masses.beats else ()

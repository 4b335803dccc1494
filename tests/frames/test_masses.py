"""A run's frames are read alike whichever way round their display is."""

from __future__ import annotations

import numpy as np

from gcar_deploy.frames.masses import _bright
from gcar_deploy.geometry.scene import Intensity
from tests.imaging.phantoms import carm, raw_picture, tube_paths


def test_a_negative_run_has_the_same_shutter_and_bright_vessels():
    path = tube_paths()
    row, column = np.indices(path.shape) - 127.5
    outside = np.hypot(row, column) > 128
    stack = np.stack([raw_picture(share * path) for share in (0.0, 0.6, 1.0)])
    stack[:, outside] = 4
    view = carm(*path.shape)
    (one, holes), (other, others) = (
        _bright(frames, view, Intensity(kind="raw")) for frames in (stack, 255 - stack)
    )
    assert holes[outside].all() and (holes == others).mean() > 0.99
    vessel, beside = (path > 2) & ~holes, (path == 0) & ~holes
    for frames in (one, other):
        assert frames[-1][vessel].mean() > frames[-1][beside].mean() + 0.05

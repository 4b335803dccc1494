"""Pictures in the scene's own order and coordinates."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from gcar_deploy.config import RunOptions
from gcar_deploy.geometry.frame import OwnFrame
from gcar_deploy.imaging.angiogram import Angiogram


def in_own_frame(
    frame: OwnFrame, angiograms: Sequence[Angiogram], options: RunOptions
) -> tuple[list[Angiogram], RunOptions]:
    """Return pictures and landmarks in the scene's own order, the views in its coordinates."""
    seen = [
        dataclasses.replace(angiograms[k], carm=frame.carm(angiograms[k].carm)) for k in frame.order
    ]
    marks = tuple(tuple(mark[k] for k in frame.order) for mark in options.landmarks)
    return seen, dataclasses.replace(options, landmarks=marks)

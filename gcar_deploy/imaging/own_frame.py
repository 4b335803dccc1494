"""Pictures in the scene's own order and coordinates."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from gcar_deploy.config import Landmark, RunOptions
from gcar_deploy.geometry.own_frame import OwnFrame
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.imaging.square import square_point, squared


def in_own_frame(
    frame: OwnFrame, angiograms: Sequence[Angiogram], options: RunOptions
) -> tuple[list[Angiogram], RunOptions]:
    """Return pictures and marks in the scene's own order, coordinates and square pixels."""
    seen = [
        squared(dataclasses.replace(angiograms[k], carm=frame.carm(angiograms[k].carm)))
        for k in frame.order
    ]

    def ordered(marks: Sequence[Landmark]) -> tuple[Landmark, ...]:
        return tuple(
            tuple(square_point(angiograms[k].carm, mark[k]) for k in frame.order) for mark in marks
        )

    x0, y0, z0 = (float(value) for value in frame.origin_mm)
    return seen, dataclasses.replace(
        options,
        landmarks=ordered(options.landmarks),
        same_branch=ordered(options.same_branch),
        ostia=ordered(options.ostia),
        deleted_mm=tuple((x - x0, y - y0, z - z0) for x, y, z in options.deleted_mm),
    )

"""Pictures in the scene's own order and coordinates."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from gcar_deploy.config import Landmark, RunOptions
from gcar_deploy.geometry.own_frame import OwnFrame
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.square import on_given_pixels, square_point, squared


def in_own_frame(
    frame: OwnFrame, angiograms: Sequence[Angiogram], options: RunOptions
) -> tuple[list[Angiogram], RunOptions]:
    """Return pictures and marks in the scene's own order, coordinates and square pixels."""
    carms = [frame.carm(angiogram.carm) for angiogram in angiograms]
    seen = [squared(dataclasses.replace(angiograms[k], carm=carms[k])) for k in frame.order]

    def ordered(marks: Sequence[Landmark]) -> tuple[Landmark, ...]:
        return tuple(tuple(square_point(carms[k], mark[k]) for k in frame.order) for mark in marks)

    x0, y0, z0 = (float(value) for value in frame.origin_mm)
    return seen, dataclasses.replace(
        options,
        landmarks=ordered(options.landmarks),
        same_branch=ordered(options.same_branch),
        ostia=ordered(options.ostia),
        deleted_mm=tuple((x - x0, y - y0, z - z0) for x, y, z in options.deleted_mm),
    )


def found_as_given(frame: OwnFrame, views: Sequence[VesselImage]) -> tuple[VesselImage, ...]:
    """Return what was found in the scene's own order and pixels in those that were given."""
    # The frame's own view says how many square pixels there are: the given one rounds elsewhere.
    return tuple(
        dataclasses.replace(on_given_pixels(views[frame.place(k)], frame.carm(carm)), carm=carm)
        for k, carm in enumerate(frame.given)
    )

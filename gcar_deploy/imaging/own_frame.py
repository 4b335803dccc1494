"""Pictures in the scene's own order and coordinates."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from gcar_deploy.config import Landmark, RunOptions
from gcar_deploy.geometry.own_frame import OwnFrame
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.square import on_given_pixels, square_point, squared
from gcar_deploy.imaging.upright import turned_angiogram, turned_point, turned_view, upright


def in_own_frame(
    frame: OwnFrame, angiograms: Sequence[Angiogram], options: RunOptions
) -> tuple[list[Angiogram], RunOptions]:
    """Return pictures and marks in the scene's own order and coordinates.

    Upright to the next quarter turn, and on square pixels.
    """
    own = [frame.carm(angiogram.carm) for angiogram in angiograms]
    stood = [upright(carm) for carm in own]
    seen = [squared(turned_angiogram(angiograms[k], *stood[k])) for k in frame.order]

    def placed(k: int, point: tuple[float, float] | None) -> tuple[float, float] | None:
        carm, turns = stood[k]
        return square_point(carm, turned_point(own[k], point, turns))

    def ordered(marks: Sequence[Landmark]) -> tuple[Landmark, ...]:
        return tuple(tuple(placed(k, mark[k]) for k in frame.order) for mark in marks)

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
    out = []
    for k, given in enumerate(frame.given):
        # The frame's view says how many square pixels there are: the given one rounds elsewhere.
        carm, turns = upright(frame.carm(given))
        found = on_given_pixels(views[frame.place(k)], carm)
        out.append(turned_view(found, given, -turns % 4))
    return tuple(out)


def turns_back(frame: OwnFrame, view: int) -> int:
    """Return what turns the picture of the file's view from upright to as it was given."""
    return -upright(frame.carm(frame.given[view]))[1] % 4

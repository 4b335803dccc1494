"""Options by which a person tells what the pictures cannot: pose, landmarks, vessel masks."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from gcar_deploy.config import Landmark, RunOptions

_Function = TypeVar("_Function", bound=Callable[..., Any])
#: views whose mask can be given on the command line
_MASKS = (1, 2, 3, 4)


def hint_options(function: _Function) -> _Function:
    """Add --segmenter, --pose, --landmark, --mask1 ...; see ``hinted`` and ``given_masks``."""
    for k in reversed(_MASKS):
        function = click.option(
            f"--mask{k}",
            type=click.Path(path_type=Path),
            metavar="PICTURE",
            help=f"Vessel mask of view {k}; it wins over what is found in the picture.",
        )(function)
    return reading_options(function)


def reading_options(function: _Function) -> _Function:
    """Add --segmenter, --pose and --landmark; see ``hinted``."""
    for option in (
        click.option(
            "--landmark",
            "landmarks",
            multiple=True,
            metavar="C1,R1:C2,R2",
            help="Column and row of one point in each view (- where unseen); repeatable.",
        ),
        click.option(
            "--pose",
            type=click.Choice(["auto", "off"]),
            default="auto",
            show_default=True,
            help="Whether shift and turn between the runs are estimated.",
        ),
        click.option(
            "--segmenter",
            type=click.Choice(["classic", "net", "auto"]),
            default="auto",
            show_default=True,
            help="Who finds vessels in raw pictures; auto takes the mean of both.",
        ),
    ):
        function = option(function)
    return function


def hinted(options: RunOptions, hints: Mapping[str, Any]) -> RunOptions:
    """Return options with --segmenter, --pose and --landmark built in.

    Raises
    ------
    UsageError
        A landmark is not written as it should be, or given although --pose is off.
    """
    from gcar_deploy.errors import UsageError

    if hints["landmarks"] and hints["pose"] == "off":
        raise UsageError("--landmark corrects the pose: it cannot be used with --pose off")
    return dataclasses.replace(
        options,
        imaging=dataclasses.replace(options.imaging, segmenter=hints["segmenter"]),
        pose=dataclasses.replace(options.pose, enabled=hints["pose"] == "auto"),
        landmarks=tuple(parse_landmark(text) for text in hints["landmarks"]),
    )


def given_masks(hints: Mapping[str, Any]) -> dict[int, Path]:
    """Return number of the view -> its mask."""
    return {k: hints[f"mask{k}"] for k in _MASKS if hints[f"mask{k}"] is not None}


def parse_landmark(text: str) -> Landmark:
    """Read ``C1,R1:C2,R2[:C3,R3 ...]``, with - where a view does not show the point.

    Raises
    ------
    UsageError
    """
    from gcar_deploy.errors import UsageError

    out: list[tuple[float, float] | None] = []
    for part in text.split(":"):
        if part.strip() == "-":
            out.append(None)
            continue
        try:
            column, row = (float(word) for word in part.split(","))
        except ValueError:
            column = row = math.nan
        if not (math.isfinite(column) and math.isfinite(row)):
            raise UsageError(
                f"--landmark {text[:60]!r} must be column,row:column,row with one point per view"
            )
        out.append((column, row))
    return tuple(out)

"""Options that make an order, each written once; a verb names the fields of the order it takes."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias, TypeVar

import click

from gcar_deploy.cli.paths import ANY_PATH, GEOMETRY
from gcar_deploy.config import PREDICTORS, REFINERS, SEGMENTERS, RunOptions
from gcar_deploy.inputs.order import EXTRAS, POSES, Order, load_order
from gcar_deploy.inputs.words import parse_frames, parse_landmark, parse_lesion, parse_mask

_Function = TypeVar("_Function", bound=Callable[..., Any])
_Option: TypeAlias = Callable[[Any], Any]


def _choice(name: str, choices: tuple[str, ...], usual: str, text: str) -> _Option:
    # No default value: what is not said leaves an order file, or a running engine, its own.
    kind = click.Choice(list(choices))
    return click.option(f"--{name}", type=kind, show_default=usual, help=text)


_USUAL = RunOptions()
#: field of the order -> option; in the order of help
OPTIONS: Mapping[str, _Option] = {
    "geometry": click.option(
        "--geom", "geometry", type=GEOMETRY, help="Geometry of the views (JSON); DICOM has its own."
    ),
    "out": click.option("--out", type=ANY_PATH, help="New folder for what is written."),
    "predictor": _choice(
        "predictor", PREDICTORS, _USUAL.predict.predictor,
        "Who decides depth: a model, or none (the visual hull is thinned).",
    ),
    "refiner": _choice(
        "refiner", REFINERS, _USUAL.refine.refiner, "How the tree is fitted to the pictures."
    ),
    "deadline_s": click.option(
        "--deadline", "deadline_s", type=click.FloatRange(min=0, min_open=True), metavar="SECONDS",
        help="End the refinement with what it has after so long.",
    ),
    "frames": click.option(
        "--frame", "frames", metavar="N|auto", show_default="auto",
        help="Frame of each run (DICOM, folder, TIFF of pages), from 1; one for all, or 7,12; "
        "auto takes frames that go together.",
    ),
    "pixel_spacing_mm": click.option(
        "--pixel-spacing", "pixel_spacing_mm", type=click.FloatRange(0.02, 10), metavar="MM",
        help="DICOM without it: pixel spacing at the detector.",
    ),
    "sod_mm": click.option(
        "--sod", "sod_mm", type=click.FloatRange(300, 5000), metavar="MM",
        help="DICOM without it: source to isocentre.",
    ),
    "allow_rescale": click.option(
        "--allow-rescale", is_flag=True,
        help="Take pictures of another size than their geometry's for rescaled ones.",
    ),
    "segmenter": _choice(
        "segmenter", SEGMENTERS, _USUAL.imaging.segmenter,
        "Who finds vessels in raw pictures; auto takes both.",
    ),
    "pose": _choice(
        "pose", POSES, "auto", "Whether shift and turn between the runs are estimated."
    ),
    "landmarks": click.option(
        "--landmark", "landmarks", multiple=True, metavar="C1,R1:C2,R2",
        help="Column and row of one point in each view (- where unseen); repeatable.",
    ),
    "masks": click.option(
        "--mask", "masks", multiple=True, metavar="N:PICTURE",
        help="Vessel mask of view N, which wins over what is found in the picture; repeatable.",
    ),
    "lesions": click.option(
        "--lesion", "lesions", multiple=True, metavar="N:C1,R1:C2,R2",
        help="Proximal and distal border of a lesion in view N, beside those found; repeatable.",
    ),
    "strict": click.option(
        "--strict", is_flag=True, help="Take a degraded result for a refusal (exit code 6)."
    ),
    "force": click.option("--force", is_flag=True, help="Replace a folder that gcar wrote."),
    "glb": click.option("--glb", is_flag=True, help="Write surface.glb as well."),
    "dicom_stl": click.option(
        "--dicom-stl", is_flag=True,
        help="Write surface.dcm (DICOM Encapsulated STL) as well.",
    ),
    "file": click.option(
        "--order", "file", type=ANY_PATH,
        help="Order file; what else is said on the command line goes before it.",
    ),
}  # fmt: skip
#: what tells how pictures are read
READING = (
    "geometry", "frames", "pixel_spacing_mm", "sod_mm", "allow_rescale", "segmenter", "pose",
    "landmarks", "masks",
)  # fmt: skip
#: what tells how a tree is made of them
METHOD = ("predictor", "refiner", "deadline_s")
#: options that ask for further files
EXTRA_FILES = {name.replace("-", "_"): name for name in EXTRAS}


def order_options(*fields: str) -> Callable[[_Function], Any]:
    """Add options for these fields of an order; the command gets them as the argument ``order``.

    Parameters
    ----------
    fields : keys of ``OPTIONS``; an argument ``views`` of the command goes into the order too
    """

    def decorate(function: _Function) -> Any:
        @functools.wraps(function)
        def wrapper(**values: Any) -> Any:
            own = {name: values.pop(name) for name in list(values) if name in known}
            return function(order=made_order(own), **values)

        known = {*fields, "views"}
        command: Any = wrapper
        for name in reversed([name for name in OPTIONS if name in fields]):
            command = OPTIONS[name](command)
        return command

    return decorate


def made_order(said: Mapping[str, Any]) -> Order:
    """Make the order of what was said on the command line, over what an order file says.

    Raises
    ------
    UsageError
        A value is not written as it should be, or out of range.
    """
    values = {name: value for name, value in said.items() if value not in (None, (), False)}
    file = values.pop("file", None)
    masks = dict(parse_mask(text) for text in values.pop("masks", ()))
    extras = [name for option, name in EXTRA_FILES.items() if values.pop(option, False)]
    if masks:
        values["masks"] = masks
    if extras:
        values["extras"] = tuple(extras)
    if "frames" in values:
        values["frames"] = parse_frames(values["frames"])
    if "landmarks" in values:
        values["landmarks"] = tuple(parse_landmark(text) for text in values["landmarks"])
    if "lesions" in values:
        values["lesions"] = tuple(parse_lesion(text) for text in values["lesions"])
    return dataclasses.replace(Order() if file is None else load_order(file), **values)

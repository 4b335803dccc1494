"""gcar enhance PICTURE --out DIR: look at each step of finding the vessels."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import click

from gcar_deploy.cli.common import gathered, say, segmenter_option
from gcar_deploy.cli.paths import pictures
from gcar_deploy.cli.request import order_options
from gcar_deploy.config import SEGMENTERS
from gcar_deploy.inputs.order import Order


@dataclasses.dataclass(frozen=True)
class Meaning:
    """What a grey value means, and how large a pixel is."""

    kind: str
    polarity: str
    pixel_mm: float | None
    mm_per_count: float | None


_MEANING = {
    "mm_per_count": click.option(
        "--mm-per-count", type=click.FloatRange(0, min_open=True),
        help="For --kind path_length: millimetres of vessel per count.",
    ),
    "pixel_mm": click.option(
        "--pixel-mm", type=click.FloatRange(0.01, 10),
        help="Pixel size at the isocentre (detector spacing x SOD / SDD); by default what DICOM "
        "says, else the longer side of the picture is taken as 150 mm.",
    ),
    "polarity": click.option(
        "--polarity", type=click.Choice(["auto", "dark", "bright"]), default="auto",
        show_default=True, help="Whether vessels are darker or brighter than what surrounds them.",
    ),
    "kind": click.option(
        "--kind", type=click.Choice(["raw", "attenuation", "path_length", "mask"]), default="raw",
        show_default=True, help="What a grey value means.",
    ),
}  # fmt: skip


@click.command("enhance")
@pictures("picture", count=1)
@order_options("out", "frames", "force")
@gathered("meaning", Meaning, _MEANING)
@click.option(
    "--segmenter",
    type=click.Choice([*SEGMENTERS, "both"]),
    default="auto",
    show_default=True,
    help="Who finds the vessels; both writes classic and net_ pictures side by side.",
)
@segmenter_option
def enhance(
    picture: Path, order: Order, meaning: Meaning, segmenter: str, segmenter_model: Path | None
) -> None:
    """Write vesselness.png, mask.png and skeleton.png of PICTURE at its own size.

    And steps.png: the vesselness with the skeleton in green and, in red, what was taken for a
    catheter and left out. With the same pixel size the mask is that of gcar run, which with
    --segmenter auto may still take the network alone where its views then agree better.

    \b
    Example:
      gcar enhance view1.png --out steps
    """  # noqa: D301 - click wants a real backspace
    from gcar_deploy.config import ImagingOptions
    from gcar_deploy.engine import check_target_of
    from gcar_deploy.errors import UsageError
    from gcar_deploy.imaging.extract import asked_network, extract_vessels
    from gcar_deploy.imaging.net import load_segmenter
    from gcar_deploy.imaging.pictures import png_files
    from gcar_deploy.imaging.skeleton import arc_length
    from gcar_deploy.output.folder import write_folder

    out = check_target_of(dataclasses.replace(order, views=(picture,)))
    if meaning.kind == "path_length" and meaning.mm_per_count is None:
        raise UsageError("--kind path_length needs --mm-per-count")
    options = ImagingOptions()
    angiogram, notes = _read(picture, order, meaning)
    for note in notes:
        say(f"gcar: {note}")
    pictures: dict[str, bytes] = {}
    told: list[str] = []
    for who in ("classic", "net") if segmenter == "both" else (segmenter,):
        chosen = dataclasses.replace(options, segmenter=who)
        network, missing = asked_network(
            [angiogram], chosen, load_segmenter(who, model=segmenter_model)
        )
        for note in missing:
            say(f"gcar: {note}")
        found = extract_vessels(angiogram, chosen, network)
        prefix = "net_" if (segmenter, who) == ("both", "net") else ""
        pictures |= {prefix + name: p for name, p in png_files(found).items()}
        length_mm = float(arc_length(found.skeleton).sum()) * found.carm.pixel_at_isocenter_mm
        told.append(
            f"{out}: {prefix}vesselness.png, {prefix}mask.png ({found.mask.mean():.1%} of the "
            f"picture), {prefix}skeleton.png (about {length_mm:.0f} mm), {prefix}steps.png "
            f"({found.catheter_mm:.0f} mm taken for catheter)"
        )
    write_folder(out, pictures, force=order.force)
    for line in told:
        click.echo(line)


def _read(picture: Path, order: Order, meaning: Meaning) -> tuple[Any, list[str]]:
    """Return the picture as an angiogram, and what is worth telling of it."""
    from gcar_deploy.config import ImagingOptions, RunOptions
    from gcar_deploy.dicom.carm import frame_carm
    from gcar_deploy.dicom.header import is_dicom
    from gcar_deploy.dicom.scene import read_run, wanted_frames
    from gcar_deploy.errors import GeometryError
    from gcar_deploy.geometry.scene import Intensity
    from gcar_deploy.imaging.angiogram import Angiogram
    from gcar_deploy.imaging.read import read_picture
    from gcar_deploy.inputs.runs import find_runs, seen_runs, with_bare

    valid, pixel_mm, chosen = None, meaning.pixel_mm, None
    notes: list[str] = []
    options = order.options(RunOptions())
    intensity = Intensity(
        kind=meaning.kind, polarity=meaning.polarity, mm_per_count=meaning.mm_per_count
    )
    if is_dicom(picture):
        dicom = options.dicom
        run = read_run(picture, dicom, wanted_frames(dicom, 1)[0])
        pixels, valid = (run.pixels, run.header.bits, run.header.sha256), run.valid
        chosen = run.chosen
        notes += run.notes
        if pixel_mm is None:
            try:
                pixel_mm = frame_carm(run.header, run.index, dicom)[0].pixel_at_isocenter_mm
            except GeometryError as error:
                notes.append(f"its pixel size is not known: {error}")
    else:
        pixels = read_picture(
            picture, ImagingOptions().limits, subtracted=intensity.subtracted,
            binary=meaning.kind == "mask",
        )  # fmt: skip
    angiogram = Angiogram.without_geometry("picture", pixels, intensity, pixel_mm)
    if pixel_mm is None:
        notes.append(
            f"a pixel is taken as {angiogram.carm.pixel_at_isocenter_mm:.3g} mm at the isocentre "
            "(150 mm for the longer side); gcar run knows it from the geometry, and --pixel-mm "
            "tells it here"
        )
    angiogram = dataclasses.replace(angiogram, valid=valid, frame=chosen)
    runs = find_runs([picture], options)
    (angiogram,), more = with_bare([angiogram], runs, seen_runs(runs, None, options))
    return angiogram.in_range(), notes + more

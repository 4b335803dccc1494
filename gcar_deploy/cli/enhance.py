"""gcar enhance PICTURE --out DIR: look at each step of finding the vessels."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import click

from gcar_deploy.cli.common import chosen_dicom


@click.command("enhance")
@click.argument("picture", type=click.Path(path_type=Path))
@click.option(
    "--out", "out_dir", required=True, type=click.Path(path_type=Path), help="New folder."
)
@click.option(
    "--kind",
    type=click.Choice(["raw", "attenuation", "path_length", "mask"]),
    default="raw",
    show_default=True,
    help="What a grey value means.",
)
@click.option(
    "--polarity",
    type=click.Choice(["auto", "dark", "bright"]),
    default="auto",
    show_default=True,
    help="Whether vessels are darker or brighter than what surrounds them.",
)
@click.option(
    "--pixel-mm",
    type=click.FloatRange(0.01, 10),
    default=None,
    help="Pixel size at the isocentre (detector spacing x SOD / SDD); by default the longer "
    "side of the picture is taken as 150 mm.",
)
@click.option(
    "--mm-per-count",
    type=click.FloatRange(0, min_open=True),
    default=None,
    help="For --kind path_length: millimetres of vessel per count.",
)
@click.option("--frame", default="auto", show_default=True, help="DICOM: frame, from 1.")
@click.option(
    "--segmenter",
    type=click.Choice(["classic", "net", "auto", "both"]),
    default="auto",
    show_default=True,
    help="Who finds the vessels; both writes classic and net_ pictures side by side.",
)
@click.option("--force", is_flag=True, help="Replace a folder that gcar wrote.")
def enhance(
    picture: Path,
    out_dir: Path,
    kind: str,
    polarity: str,
    pixel_mm: float | None,
    mm_per_count: float | None,
    frame: str,
    segmenter: str,
    force: bool,
) -> None:
    r"""Write vesselness.png, mask.png and skeleton.png of PICTURE at its own size.

    And steps.png: the vesselness with the skeleton in green and, in red, what was taken for a
    catheter and left out.

    \b
    Example:
      gcar enhance view1.png --out steps
    """
    from gcar_deploy.config import DicomOptions, ImagingOptions
    from gcar_deploy.dicom.header import is_dicom
    from gcar_deploy.dicom.scene import read_run
    from gcar_deploy.errors import UsageError
    from gcar_deploy.geometry.scene import Intensity
    from gcar_deploy.imaging.angiogram import Angiogram
    from gcar_deploy.imaging.extract import asked_network, extract_vessels
    from gcar_deploy.imaging.net import load_segmenter
    from gcar_deploy.imaging.pictures import png_files
    from gcar_deploy.imaging.read import read_picture
    from gcar_deploy.output.folder import check_target, write_folder

    check_target(out_dir, force=force, inputs=(picture,))
    if kind == "path_length" and mm_per_count is None:
        raise UsageError("--kind path_length needs --mm-per-count")
    options = ImagingOptions()
    intensity = Intensity(kind=kind, polarity=polarity, mm_per_count=mm_per_count)
    if is_dicom(picture):
        run = read_run(picture, DicomOptions(), chosen_dicom(frame, None, None).frames[0])
        pixels, valid = (run.pixels, run.header.bits, run.header.sha256), run.valid
        click.echo("\n".join(f"gcar: {note}" for note in run.notes), err=True)
    else:
        pixels, valid = read_picture(picture, options.limits), None
    angiogram = Angiogram.without_geometry("picture", pixels, intensity, pixel_mm)
    angiogram = dataclasses.replace(angiogram, valid=valid)
    pictures: dict[str, bytes] = {}
    for who in ("classic", "net") if segmenter == "both" else (segmenter,):
        chosen = dataclasses.replace(options, segmenter=who)
        network, missing = asked_network([angiogram], chosen, load_segmenter(who))
        click.echo("".join(f"gcar: {note}\n" for note in missing), err=True, nl=False)
        found = extract_vessels(angiogram, chosen, network)
        prefix = "net_" if (segmenter, who) == ("both", "net") else ""
        pictures |= {prefix + name: p for name, p in png_files(found).items()}
    write_folder(out_dir, pictures, force=force)
    length_mm = found.skeleton.sum() * found.carm.pixel_at_isocenter_mm
    click.echo(
        f"{out_dir}: vesselness.png, mask.png ({found.mask.mean():.1%} of the picture), "
        f"skeleton.png (about {length_mm:.0f} mm), steps.png ({found.catheter_mm:.0f} mm taken "
        "for catheter)"
    )

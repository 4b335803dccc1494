"""gcar dicom RESULT RUN ...: what goes back to the archive, as files."""

from __future__ import annotations

from pathlib import Path

import click

from gcar_deploy.cli.common import needs_extra
from gcar_deploy.cli.paths import ANY_PATH, pictures


@click.command("dicom")
@click.argument("result", type=ANY_PATH, metavar="RESULT_DIR")
@pictures("runs", required=True, metavar="RUN1 RUN2 ...")
@click.option("--out", required=True, type=ANY_PATH, help="New folder for the files.")
@click.option(
    "--pdf", type=ANY_PATH, metavar="FILE",
    help="A page printed from the report: it becomes an Encapsulated PDF.",
)  # fmt: skip
@click.option("--force", is_flag=True, help="Replace a folder that gcar wrote.")
def dicom(result: Path, runs: tuple[Path, ...], out: Path, pdf: Path | None, force: bool) -> None:
    """Write a result as DICOM objects of the study that its runs belong to.

    measurements.dcm is a Comprehensive 3D SR (TID 1500), surface.dcm an Encapsulated STL,
    overlay_view1.dcm ... Secondary Captures, page.dcm the PDF. Patient and study are copied from
    RUN1. gcar listen --send-to sends the same objects, without a page.

    \b
    Example:
      gcar dicom result run1.dcm run2.dcm --out archive
      gcar dicom result run1.dcm run2.dcm --pdf printed.pdf --out archive
    """  # noqa: D301 - click wants a real backspace
    with needs_extra("sr", "pydicom", "highdicom"):
        from gcar_deploy.output.dicom_study import file_bytes, study_objects
    from gcar_deploy.output.folder import check_target, write_folder

    inputs = (result, *runs, *(() if pdf is None else (pdf,)))
    check_target(out, force=force, inputs=inputs)
    made = study_objects(result, runs, pdf)
    write_folder(out, {name: file_bytes(data) for name, data in made.items()}, force=force)
    click.echo("\n".join([str(out), *(f"{n}: {d.SOPClassUID.name}" for n, d in made.items())]))

"""gcar slicer RESULT: a scene that 3D Slicer opens."""

from __future__ import annotations

from pathlib import Path

import click

from gcar_deploy.cli.paths import ANY_PATH


@click.command("slicer")
@click.argument("result", type=ANY_PATH, metavar="RESULT_DIR")
@click.option(
    "--out", type=ANY_PATH, metavar="FILE.mrml",
    help="The scene; RESULT_DIR.mrml beside the folder by default.",
)  # fmt: skip
@click.option("--force", is_flag=True, help="Replace a scene that is there.")
def slicer(result: Path, out: Path | None, force: bool) -> None:
    """Write a scene of a result for 3D Slicer: volume, lumen and centreline with colours.

    The scene names the folder's files from where it lies: move both together.

    \b
    Example:
      gcar slicer result
      Slicer result.mrml
    """  # noqa: D301 - click wants a real backspace
    from gcar_deploy.errors import UsageError
    from gcar_deploy.files import is_there, whole_file
    from gcar_deploy.output.slicer_scene import FILES, slicer_scene
    from gcar_deploy.output.stored import read_listed, read_summary

    summary = read_summary(result / "result.json")
    for name in FILES:
        read_listed(result, name, summary)
    folder = result.resolve()
    out = folder.with_name(f"{folder.name}.mrml") if out is None else out.resolve()
    if out.suffix != ".mrml":
        raise UsageError(f"--out {out.name} must end in .mrml, or Slicer does not know it")
    if is_there(out) and not force:
        raise UsageError(f"{out} exists; add --force to replace it")
    try:
        with whole_file(out) as partial:
            partial.write_text(slicer_scene(folder, out), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{out} cannot be written ({error.strerror})") from None
    click.echo(str(out))

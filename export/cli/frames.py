"""``gcar-export frame-pairs``: parse, call, print."""

from __future__ import annotations

import click

from gcar_export.cli.options import SEED, counted


@click.command("frame-pairs")
@counted("--patients", 10, "Generated patients, two runs each.")
@counted("--seed", 7_300, "Population of patients.", SEED)
def frame_pairs(patients: int, seed: int) -> None:
    """Choose frames of generated cine runs, and say how far off the heart's phase is.

    Each patient is a beating tree in two runs of 15 frames and two beats, with contrast that comes
    and goes, breathing and a patient who moved between the runs.

    Example: gcar-export frame-pairs --patients 10
    """
    from gcar_export.studies import frame_pairs as study

    found = []
    for row in study.rows(seed, patients):
        found.append(row)
        click.echo(f"[{len(found)}/{patients}] {row.error_frames:.1f} frames off", err=True)
    click.echo(study.table(found))

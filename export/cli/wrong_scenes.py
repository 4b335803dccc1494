"""``gcar-export wrong-scenes``: parse, call, print."""

from __future__ import annotations

from pathlib import Path

import click

from gcar_export.cli.evaluate import words
from gcar_export.cli.options import FROM_ZERO, OUT_FOLDER, SEED, counted


@click.command("wrong-scenes")
@counted("--trees", 6, "Examinations that are spoilt.")
@counted("--right", 4, "More right ones of each kind.", FROM_ZERO)
@counted("--seed", 62_002, "Population of generated trees.", SEED)
@click.option("--families", default="", help="Only these, comma-separated.")
@click.option("--out", type=OUT_FOLDER, required=True, help="Rows (CSV), table.")
def wrong_scenes(trees: int, right: int, seed: int, families: str, out: Path) -> None:
    """Reconstruct scenes that are wrong on purpose: which are called ok, and how far off they are.

    Generated trees as path lengths, masks and raw pictures of two and three views; beside them
    right scenes. Says of each error whether the pictures show it.

    Example: gcar-export wrong-scenes --trees 6 --right 4 --out wrong
    """
    from gcar_export.studies import wrong_scenes_table as study

    out.mkdir(parents=True, exist_ok=True)

    def told(row: study.Row) -> None:
        off = "-" if row.error_mm is None else f"{row.error_mm:.2f} mm"
        text = f"{row.exam} {row.pictures} {row.views}: {row.change}: {row.status} {off}"
        click.echo(f"{text} [{row.shows}] {row.sentence[:90]}", err=True)

    rows = study.measure(seed, trees, right, told, words(families))
    study.write_csv(rows, out / "wrong_scenes.csv")
    text = study.tables(rows)
    (out / "wrong_scenes.md").write_text(text + "\n", encoding="utf-8")
    click.echo(text)

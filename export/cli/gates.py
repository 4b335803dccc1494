"""``gcar-export gate-table``: parse, call, print."""

from __future__ import annotations

import functools
import sys
from pathlib import Path

import click

from gcar_export.cli.evaluate import words

_FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)


@click.command("gate-table")
@click.option("--trees", default=24, show_default=True, help="Generated trees per seed.")
@click.option("--seed", default=50_001, show_default=True, help="Population to choose gates on.")
@click.option("--check-seed", default=50_002, show_default=True, help="Population to check on.")
@click.option("--data", type=_FOLDER, help="Folder with label volumes: look at these as well.")
@click.option("--cases", default="", help="Only these of them, comma-separated.")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Rows, table, PNG.")
def gate_table(
    trees: int, seed: int, check_seed: int, data: Path | None, cases: str, out: Path
) -> None:
    """Judge the quality gates by pairs of one tree, of two, misplaced and swapped ones.

    Goes on where an earlier run with the same --out stopped.

    Example: gcar-export gate-table --trees 24 --data data --out gates
    """
    from gcar_deploy.config import QualityOptions
    from gcar_export.evaluate.evaluate import find_labels
    from gcar_export.studies import gate_report as report
    from gcar_export.studies import gate_table as study
    from gcar_export.studies.gate_pairs import KINDS, OFF, PICTURES, real_subject

    gates = QualityOptions()
    files = find_labels(data) if data else []
    wanted = [f for f in files if not cases or f.name.split(".")[0] in words(cases)]
    subjects = [functools.partial(real_subject, file) for file in wanted]
    real_kinds = [kind for kind in KINDS if kind not in OFF]
    out.mkdir(parents=True, exist_ok=True)
    rows_file = out / "rows.jsonl"
    total = 2 * trees * len(KINDS) * len(PICTURES) + len(wanted) * len(real_kinds) * len(PICTURES)
    with click.progressbar(length=total, label="pairs", file=sys.stderr) as bar:
        on_pair = functools.partial(bar.update, 1)
        first, second = (study.measure(rows_file, s, trees, on_pair) for s in (seed, check_seed))
        real = (
            study.measure_real(rows_file, subjects, real_kinds, on_pair)
            if len(subjects) > 1
            else []
        )
    parts = [
        f"Seed {seed}, gates as they are:", report.status_table(first, gates),
        f"Seed {check_seed}, gates as they are:", report.status_table(second, gates),
        "Both seeds:", report.level_table([*first, *second], gates),
        f"Seed {seed}:", report.doubt_table(first, gates),
        f"Seed {check_seed}:", report.doubt_table(second, gates),
        f"Gates chosen on seed {seed}, checked on {check_seed}:",
        report.gate_table(first, second, gates),
    ]  # fmt: skip
    if real:
        parts += ["Label volumes, gates as they are:", report.status_table(real, gates)]
        parts.append(report.doubt_table(real, gates))
    text = "\n\n".join(parts)
    (out / "gates.md").write_text(text + "\n", encoding="utf-8")
    report.draw([*first, *second], gates, out / "gates.png")
    click.echo(text)
    click.echo(out / "gates.png")

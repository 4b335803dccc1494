"""``gcar-export gate-table``, ``ghost-fit`` and ``status-table``: parse, call, print."""

from __future__ import annotations

import functools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from gcar_export.cli.evaluate import words
from gcar_export.cli.options import FOLDER, OUT_FILE, OUT_FOLDER, SEED, counted, taking

if TYPE_CHECKING:
    from gcar_export.studies.gate_rows import Row

#: what all three commands ask: they read and add to the same rows
_shared = taking(
    click.option("--data", type=FOLDER, help="Folder with label volumes: look at these as well."),
    click.option("--cases", default="", help="Only these of them, comma-separated."),
    click.option("--out", type=OUT_FOLDER, required=True,
                 help="Rows, tables, pictures; may hold those of an earlier run."),
)  # fmt: skip


def _measured(
    out: Path, seeds: Sequence[tuple[int, int]], files: Sequence[Path], kinds: Sequence[str]
) -> list[list[Row]]:
    """Rows of each (seed, trees), then of the label volumes."""
    from gcar_export.studies import gate_rows
    from gcar_export.studies.gate_pairs import OFF, PICTURES, real_subject

    out.mkdir(parents=True, exist_ok=True)
    real_kinds = [kind for kind in kinds if kind not in OFF]
    makers = [functools.partial(real_subject, file) for file in files]
    total = sum(trees for _, trees in seeds) * len(kinds) + len(makers) * len(real_kinds)
    rows = out / "rows.jsonl"
    with click.progressbar(length=total * len(PICTURES), label="pairs", file=sys.stderr) as bar:
        step = functools.partial(bar.update, 1)
        found = [gate_rows.measure(rows, seed, trees, step, kinds) for seed, trees in seeds]
        enough = len(makers) > 1
        found.append(gate_rows.measure_real(rows, makers, real_kinds, step) if enough else [])
    return found


def _labels(data: Path | None, cases: str) -> list[Path]:
    from gcar_export.evaluate.evaluate import find_labels

    return find_labels(data, words(cases)) if data else []


def _say(parts: Sequence[str], file: Path) -> None:
    text = "\n\n".join(parts)
    file.write_text(text + "\n", encoding="utf-8")
    click.echo(text)


@click.command("gate-table")
@counted("--trees", 24, "Generated trees per seed.")
@counted("--seed", 50_001, "Population to choose gates on.", SEED)
@counted("--check-seed", 50_002, "Population to check on.", SEED)
@_shared
def gate_table(
    trees: int, seed: int, check_seed: int, data: Path | None, cases: str, out: Path
) -> None:
    """Judge the quality gates by pairs of one tree, of two, misplaced and swapped ones.

    Goes on where an earlier run with the same --out stopped.

    Example: gcar-export gate-table --trees 24 --data data --out gates
    """
    from gcar_deploy.config import QualityOptions
    from gcar_export.studies import gate_report as report
    from gcar_export.studies.gate_pairs import KINDS

    gates = QualityOptions()
    seeds = ((seed, trees), (check_seed, trees))
    first, second, real = _measured(out, seeds, _labels(data, cases), KINDS)
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
    _say(parts, out / "gates.md")
    report.draw([*first, *second], gates, out / "gates.png")
    click.echo(out / "gates.png")


@click.command("ghost-fit")
@counted("--trees", 24, "Generated trees to fit to.")
@counted("--seed", 60_001, "Population to fit to.", SEED)
@counted("--check-trees", 12, "Other trees, to check on.")
@counted("--check-seed", 60_002, "Their population.", SEED)
@click.option("--write", type=OUT_FILE,
              help="Write the model there (gcar_deploy/quality/ghosts.json).")  # fmt: skip
@_shared
def ghost_fit(
    trees: int,
    seed: int,
    check_trees: int,
    check_seed: int,
    write: Path | None,
    data: Path | None,
    cases: str,
    out: Path,
) -> None:
    """Fit the probability of a ghost on generated trees; check it on others and on real ones.

    Goes on where an earlier run with the same --out stopped: take a new one for a new predictor.

    Example: gcar-export ghost-fit --data data --out ghosts --write gcar_deploy/quality/ghosts.json
    """
    from gcar_deploy.engine import Engine
    from gcar_export.studies import ghost_fit as study

    seeds = ((seed, trees), (check_seed, check_trees))
    first, second, real = _measured(out, seeds, _labels(data, cases), ["same"])
    model = study.fit(first)
    groups = {f"fitted (seed {seed})": first, f"other (seed {check_seed})": second}
    if real:
        groups["real"] = real
    digest = dict(Engine(threads=1).model or {}).get("sha256", "none")[:12]
    made_of = study.made_of(first, seed, digest)
    (write or out / "ghosts.json").write_text(study.as_json(model, made_of), encoding="utf-8")
    tables = [made_of, study.summary_table(model, groups), study.reliability_table(model, groups)]
    _say(tables, out / "ghosts.md")
    study.draw(model, groups, out / "ghosts.png")
    click.echo(out / "ghosts.png")


@click.command("status-table")
@counted("--trees", 12, "Generated trees per seed.")
@counted("--seed", 50_001, "Population of the rule.", SEED)
@counted("--check-seed", 50_002, "Population to check on.", SEED)
@_shared
def status_table(
    trees: int, seed: int, check_seed: int, data: Path | None, cases: str, out: Path
) -> None:
    """Tell how statuses and truth go together, and the ROC of the score underneath.

    Goes on where an earlier run, also of gate-table, with the same --out stopped.

    Example: gcar-export status-table --data data --out gates
    """
    from gcar_deploy.config import QualityOptions
    from gcar_export.studies import status_table as study
    from gcar_export.studies.gate_pairs import WRONG

    gates = QualityOptions()
    seeds = ((seed, trees), (check_seed, trees))
    first, second, real = _measured(out, seeds, _labels(data, cases), ["same", *WRONG])
    groups = {f"seed {seed}": first, f"seed {check_seed}": second} | (
        {"real": real} if real else {}
    )
    chosen = study.chosen_share(first, gates)
    rule = f"good_ghost_share: {gates.good_ghost_share:g}; by the rule on seed {seed}: {chosen:g}"
    _say([study.truth_table(groups, gates), rule], out / "status.md")
    study.draw(groups, gates, out / "status.png")
    click.echo(out / "status.png")

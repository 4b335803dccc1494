"""The verbs about refinement: from true starts, what it costs, and whether its sigma is true."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click

from gcar_deploy.errors import UsageError
from gcar_export.cli.evaluate import words
from gcar_export.cli.options import FILE, FOLDER, OUT_FILE, OUT_FOLDER, SEED, Number, counted


@click.command("refine-table")
@click.option("--data", type=FOLDER, required=True, help="Folder with label volumes.")
@click.option("--cases", default="", help="Only these cases, comma-separated.")
@click.option("--protocols", default="paper,clinical", show_default=True)
@click.option("--noises", default="0,0.5,1,2", show_default=True, help="Start noise, voxels.")
@click.option(
    "--out",
    type=OUT_FOLDER,
    default=None,
    help="Folder that keeps every fit; a run with the same folder goes on where it stopped.",
)
def refine_table(data: Path, cases: str, protocols: str, noises: str, out: Path | None) -> None:
    """Refine from the same true and noisy points in both modes, with and without centreline loss.

    Example: gcar-export refine-table --data data --cases 0001,0134,0595 --out fits
    """
    from gcar_export.evaluate.evaluate import find_labels
    from gcar_export.studies import refine_table as refining

    try:
        levels = [float(word) for word in words(noises)]
    except ValueError:
        raise UsageError(f"--noises {noises!r} is not a comma-separated list of numbers") from None
    count = len(find_labels(data, words(cases)))
    total = count * len(levels) * len(refining.MODES) * len(words(protocols))
    tables = []
    with click.progressbar(length=total, label="fits", file=sys.stderr) as bar:
        for protocol in words(protocols):
            rows = refining.refine_rows(
                data, protocol, words(cases), levels, out, lambda: bar.update(1)
            )
            tables.append(refining.table(rows, protocol))
    click.echo("\n\n".join(tables))


@click.command("cost-curves")
def cost_curves() -> None:
    """Time the stages against Gaussians, vessel, views, pixels, voxels; print the exponents.

    Example: gcar-export cost-curves
    """
    from gcar_export.studies import cost_curves as cost

    timed = cost.works()
    total = cost.REPEATS * sum(len(sizes) for sizes in timed.values())
    with click.progressbar(length=total, label="sizes", file=sys.stderr) as bar:
        found = cost.curves(lambda: bar.update(1), timed)
    click.echo(cost.table(found))


@click.command("speed-table")
@click.argument("labels", type=FILE, nargs=-1, required=True)
@click.option("--protocol", default="paper", show_default=True, help="paper, clinical or raw.")
@click.option("--rounds", type=click.IntRange(1, 100), default=3, show_default=True)
@click.option("--json", "as_json", is_flag=True, help="Print JSON in place of the table.")
@click.option("--picture", type=OUT_FILE, help="New PNG: pairs against DSC.")
def speed_table(
    labels: tuple[Path, ...], protocol: str, rounds: int, as_json: bool, picture: Path | None
) -> None:
    """Time settings and peers in one run, beside itk-rtk pairs of the same size.

    Every round runs gcar over predictor, lattices and refiner, and FDK, SART, visual hull and a
    short NeRP, once on each label volume, warm. Stars: the Pareto front of pairs against DSC.

    Example: gcar-export speed-table data/imagecas/0001.label.nii.gz --picture speed.png
    """
    from gcar_export.scenes.labels import read_label
    from gcar_export.scenes.protocols import PROTOCOLS, make_case
    from gcar_export.studies import speed_table as speed

    if protocol not in PROTOCOLS:
        raise UsageError(f"--protocol {protocol} is none of {', '.join(PROTOCOLS)}")
    if picture is not None and picture.exists():
        raise UsageError(f"{picture} exists")
    cases = [make_case(read_label(path), protocol) for path in labels]
    asked = speed.settings()
    length = len(cases) * len(asked) * rounds
    with click.progressbar(length=length, label="runs", file=sys.stderr) as bar:
        made = speed.rows(cases, asked, rounds, lambda: bar.update(1))
    click.echo(json.dumps(speed.values(made), indent=1) if as_json else speed.table(made))
    if picture is not None:
        speed.picture(made).savefig(picture, dpi=100)


@click.command("sigma-table")
@counted("--seed", 1, "Population of generated trees.", SEED)
@counted("--trees", 10, "Trees per row.")
@click.option("--protocols", default="paper,clinical", show_default=True)
@click.option("--pictures", default="clean,degraded,mask,raw", show_default=True)
@click.option("--predictors", default="multi,none", show_default=True)
@click.option("--parts", is_flag=True, help="Also what sigma is worth without some of its parts.")
@click.option("--data", type=click.Path(exists=True, file_okay=False, path_type=Path),
              help="Folder with label volumes: take their trees instead.")  # fmt: skip
def sigma_table(
    seed: int, trees: int, protocols: str, pictures: str, predictors: str, parts: bool,
    data: Path | None,
) -> None:  # fmt: skip
    """Compare the stated sigma with true errors on generated trees.

    Example: gcar-export sigma-table --seed 2 --trees 20
    """
    from gcar_export.evaluate.evaluate import find_labels
    from gcar_export.studies import sigma_table as sigma

    files = find_labels(data) if data else []

    cells = [
        (protocol, condition, predictor)
        for protocol in words(protocols)
        for condition in words(pictures)
        for predictor in words(predictors)
    ]
    rows = []
    length = len(cells) * (len(files) or trees)
    with click.progressbar(length=length, label="trees", file=sys.stderr) as bar:
        for cell in cells:
            made = sigma.calibrate_parts(
                *cell, seed=seed, trees=trees, on_tree=lambda: bar.update(1), files=files
            )
            rows += made if parts else made[-1:]
    click.echo(sigma.table(rows))


@click.command("flow-table")
@counted("--count", 20, "Generated trees.")
@click.option(
    "--percent", type=Number(1, 99), default=60.0, show_default=True,
    help="Diameter stenosis of each.",
)  # fmt: skip
@click.option("--fit", is_flag=True, help="Other trees, of 30 .. 75 %, and constants.")
def flow_table(count: int, percent: float, fit: bool) -> None:
    """Compare the pressure drop behind a stenosis with that of the true lumen.

    Example: gcar-export flow-table --count 100
    """
    from gcar_export.studies import flow_table as flow

    with click.progressbar(length=count, label="trees", file=sys.stderr) as bar:
        rows, errors = flow.flow_rows(count, percent, fit, lambda: bar.update(1))
    if fit:
        floor, factor, lost = flow.fitted(errors)
        click.echo(f"FLOOR_MM {floor:.3f}, FACTOR {factor:.3f}, LOST {lost:.3f}")
    click.echo(flow.table(rows))

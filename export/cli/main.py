"""``gcar-export``: the workshop's command line. Thin: parse, call one function, print."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import click

from gcar_deploy.errors import GcarError, UsageError
from gcar_export.cli.centers import centers_table, robustness
from gcar_export.cli.evaluate import converge, evaluate, paper_page
from gcar_export.cli.frames import frame_pairs
from gcar_export.cli.gates import gate_table, ghost_fit, status_table
from gcar_export.cli.models import export, export_segmenter, golden, verify
from gcar_export.cli.options import DURATION, FILE, FOLDER, FROM_ZERO, OUT_FILE, OUT_FOLDER, counted
from gcar_export.cli.refine import cost_curves, flow_table, refine_table, sigma_table, speed_table
from gcar_export.cli.training import train, train_devices, train_segmenter
from gcar_export.cli.wrong_scenes import wrong_scenes
from gcar_export.training.scene_stream import Terminated


class _Group(click.Group):
    """Turn the project's errors into one line on stderr and their exit code."""

    def invoke(self, ctx: click.Context) -> object:
        try:
            return super().invoke(ctx)
        except GcarError as error:
            click.echo(f"gcar-export: error: {error}", err=True)
            sys.exit(error.exit_code)
        except Terminated:
            click.echo("gcar-export: terminated", err=True)
            sys.exit(143)
        except KeyboardInterrupt:
            click.echo("gcar-export: interrupted", err=True)
            sys.exit(130)
        except BrokenPipeError:  # the reader of stdout went away, as ``head`` does: click ends it
            raise
        except (click.ClickException, click.Abort, click.exceptions.Exit):
            raise
        except ImportError as error:
            package = str(error.name).partition(".")[0]
            need = f"{package} is missing; pip install 'gcar[export]'"
            click.echo(f"gcar-export: error: {need}", err=True)
            sys.exit(UsageError.exit_code)
        except Exception as error:
            logging.getLogger("gcar_export").info("internal error", exc_info=True)
            click.echo(f"gcar-export: error: {_said(error)}", err=True)
            sys.exit(1)


def _said(error: Exception) -> str:
    """One line about an error that nobody raised on purpose."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'cannot write'}: {error.strerror}"
    detail = (str(error).splitlines() or [""])[0][:200]
    return f"internal: {type(error).__name__} {detail}; see -v"


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("-v", "--verbose", is_flag=True, help="Say more on stderr.")
def main(verbose: bool) -> None:
    """Simulate, evaluate and score coronary reconstructions."""
    level = logging.INFO if verbose else logging.WARNING
    logging.basicConfig(level=level, format="%(name)s: %(message)s", stream=sys.stderr)


@main.command()
@click.argument("case_dirs", nargs=-1, type=FOLDER)
@click.option("--volume", type=FILE, help="Instead: a volume of your own, by any method.")
@click.option("--truth", type=FILE, help="What it should be: a label volume, or shares 0 .. 1.")
@click.option(
    "--run-option", "extra", multiple=True, help="Passed on to 'gcar run', one word each."
)
@click.option("--limit", type=DURATION, default=600.0, show_default=True, help="Seconds per case.")
def score(
    case_dirs: tuple[Path, ...],
    volume: Path | None,
    truth: Path | None,
    extra: tuple[str, ...],
    limit: float,
) -> None:
    """Score ready cases (view*.png, geom.json, truth.nii.gz) through 'gcar run', or a volume.

    Of each case the Dice at 0.5, the best over common shifts of the tree up to 3 voxels (a patient
    who moved between the views shows none of it), and the best over thresholds; means are of cases
    whose names begin alike. A volume of your own has the measures of 'evaluate'.

    Example: gcar-export score --volume mine.nii.gz --truth case/truth.nii.gz
    """
    from gcar_export.evaluate import own_volume
    from gcar_export.evaluate import score as scoring

    if bool(case_dirs) == bool(volume or truth) or bool(volume) != bool(truth):
        raise UsageError("score takes folders of ready cases, or --volume with --truth")
    if volume and truth:
        click.echo(own_volume.table(own_volume.compare(volume, truth)))
        return

    scores, wrong = [], []
    for k, folder in enumerate(case_dirs):
        try:
            scores.append(scoring.score_case(folder, extra, limit))
        except UsageError as error:
            wrong.append(str(error))
        click.echo(f"[{k + 1}/{len(case_dirs)}] {folder.name}", err=True)
    if scores:
        click.echo(scoring.table(scores))
    if wrong:
        count = f"{len(wrong)} of {len(case_dirs)} cases were not scored"
        raise UsageError(f"{count}: {'; '.join(wrong)}")


@main.command()
@click.argument("label", type=FILE)
@click.argument("out", type=OUT_FOLDER)
@click.option(
    "--protocol",
    type=click.Choice(["paper", "clinical", "moved", "raw"]),
    default="paper",
    show_default=True,
)
@click.option("--views", type=click.IntRange(2, 16), default=2, show_default=True)
def simulate(label: Path, out: Path, protocol: str, views: int) -> None:
    """Make a ready case from a label volume: pictures, geom.json, truth.nii.gz.

    Example: gcar-export simulate data/imagecas/0001.label.nii.gz case --protocol clinical
    """
    from gcar_export.scenes.labels import read_label
    from gcar_export.scenes.protocols import make_case, write_case

    if out.exists() and any(out.iterdir()):
        raise UsageError(f"{out} exists and is not empty")
    for path in write_case(make_case(read_label(label), protocol, views), out):
        click.echo(path)


@main.command("pair-time")
@click.argument("label", type=FILE)
@counted("--repeats", 7, "Timings of each.")
def pair_time(label: Path, repeats: int) -> None:
    """Time a warm reconstruction against one itk-rtk forward + back projection.

    128^3 voxels, two 128x128 views, medians of timings taken in turns.

    Example: gcar-export pair-time data/imagecas/0001.label.nii.gz
    """
    from gcar_export.methods.rtk_timing import time_pair
    from gcar_export.scenes.labels import read_label
    from gcar_export.scenes.protocols import make_case

    found = time_pair(make_case(read_label(label), "paper"), repeats=repeats)
    click.echo(f"itk-rtk forward {found.forward_s:.4f} s, back {found.back_s:.4f} s")
    stages = ", ".join(f"{name} {s:.4f}" for name, s in found.stages_s.items())
    click.echo(f"warm reconstruction {found.reconstruct_s:.4f} s ({stages})")
    click.echo(f"ratio {found.ratio:.2f} (medians of {found.repeats})")


@main.command("tree-table")
@click.option("--data", type=FOLDER, help="Folder with label volumes; without: generated trees.")
@counted("--count", 30, "Generated trees of each style.")
def tree_table(data: Path | None, count: int) -> None:
    """Compare generated trees with real ones, figure by figure.

    Example: gcar-export tree-table --data data
    """
    from gcar_export.scenes.label_files import label_files
    from gcar_export.studies.tree_table import STYLES, generated_statistics, real_statistics, table

    real = label_files(data) if data else []
    columns = {}
    for style in STYLES:
        with click.progressbar(range(count), label=style, file=sys.stderr) as seeds:
            columns[style] = [generated_statistics(seed, style) for seed in seeds]
    click.echo(table({**columns, "real": [real_statistics(path) for path in real]}))


@main.command("lumen-table")
@click.option("--data", type=FOLDER, help="Folder with label volumes; without: generated trees.")
@counted("--count", 30, "Cases, one stenosis each.", FROM_ZERO)
@counted("--vessels", 0, "Single vessels of known area, of each kind of picture.", FROM_ZERO)
@counted("--healthy", 0, "Generated trees without a lesion.", FROM_ZERO)
def lumen_table(data: Path | None, count: int, vessels: int, healthy: int) -> None:
    """Measure stenosis, radius and branch lengths on trees with one known stenosis.

    Left trees, the clinical views, stenoses of 30 .. 70 % of the diameter, 8 .. 16 mm long.
    With --vessels: round, oval and (with DATA/ivus) real lumens along centrelines of DATA
    or generated ones; healthy diameters of 1.2 .. 4 mm, stenoses of 30 .. 90 %, pixels of
    0.15 .. 0.4 mm, blur of 0.3 .. 0.6 mm (full width at half maximum), noise up to 0.1 mm.
    With --healthy: how many lesions of 25 % and more are seen where there is none.

    Example: gcar-export lumen-table --data data --count 27 --vessels 24 --healthy 8
    """
    from gcar_export.studies.lumen_table import lumen_rows, table
    from gcar_export.studies.lumen_vessel_table import (
        KINDS,
        false_lesions,
        vessel_rows,
        vessel_table,
    )

    with click.progressbar(length=count, label="cases", file=sys.stderr) as bar:
        rows = lumen_rows(data, count, lambda: bar.update(1))
    click.echo(table(rows))
    if vessels:
        with click.progressbar(
            length=vessels * len(KINDS), label="vessels", file=sys.stderr
        ) as bar:
            made = vessel_rows(data, vessels, lambda: bar.update(1))
        click.echo("\n" + vessel_table(made))
    if healthy:
        with click.progressbar(length=healthy, label="healthy", file=sys.stderr) as bar:
            seen, stated = false_lesions(healthy, lambda: bar.update(1))
        click.echo(f"\nLesions of 25 % and more where there is none: {seen} in {stated} vessels")


# Verbs with files of their own.
for _verb in (
    evaluate,
    converge,
    paper_page,
    centers_table,
    robustness,
    refine_table,
    cost_curves,
    speed_table,
    sigma_table,
    flow_table,
    gate_table,
    wrong_scenes,
    frame_pairs,
    train,
    train_segmenter,
    train_devices,
    export,
    export_segmenter,
    verify,
    golden,
    ghost_fit,
    status_table,
):
    main.add_command(_verb)


@main.command()
@click.option("--data", type=FOLDER, required=True, help="Folder with phantom_xa/.")
@click.option("--out", type=OUT_FOLDER, required=True, help="New folder.")
@click.option("--landmarks", type=FILE, help="JSON of landmarks marked in the four views.")
def phantom(data: Path, out: Path, landmarks: Path | None) -> None:
    """Fit some real X-ray runs of a phantom, predict the others; tables and a page.

    Example: gcar-export phantom --data data --out phantom
    """
    from gcar_export.studies import phantom as study
    from gcar_export.studies.phantom_page import markdown, write_page

    if out.exists() and any(out.iterdir()):
        raise UsageError(f"{out} exists and is not empty")
    found, fits = study.run(data, landmarks, lambda text: click.echo(text, err=True))
    out.mkdir(parents=True, exist_ok=True)
    text = markdown(fits)
    (out / "table.md").write_text(text + "\n", encoding="utf-8")
    click.echo(text)
    click.echo(write_page(found, fits, out))


@main.command("pose-table")
@counted("--trees", 3, "Generated trees.")
@click.option("--out", type=OUT_FILE, required=True, help="Rows (JSON lines).")
def pose_table(trees: int, out: Path) -> None:
    """Measure trees from a second view that is off, with and without pose refinement.

    Goes on where an earlier run with the same --out stopped.

    Example: gcar-export pose-table --trees 3 --out pose.jsonl
    """
    from gcar_export.studies import pose_table as study

    out.parent.mkdir(parents=True, exist_ok=True)
    rows = study.measure(out, trees, progress=lambda text: click.echo(text, err=True))
    click.echo(study.markdown(rows))

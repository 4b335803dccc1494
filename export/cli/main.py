"""``gcar-export``: the workshop's command line. Thin: parse, call one function, print."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path
from typing import Any

import click

from gcar_deploy.errors import GcarError, UsageError
from gcar_export.cli.centers import centers_table, robustness
from gcar_export.cli.devices import train_devices
from gcar_export.cli.evaluate import converge, evaluate, paper_page
from gcar_export.cli.frames import frame_pairs
from gcar_export.cli.gates import gate_table, ghost_fit, status_table
from gcar_export.cli.refine import cost_curves, flow_table, refine_table, sigma_table, speed_table
from gcar_export.cli.wrong_scenes import wrong_scenes

_FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)
_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
_REPLACE = click.option("--force", is_flag=True, help="Replace a model that is there.")


def _check_free(out: Path, force: bool) -> None:
    if out.exists() and not force:
        raise UsageError(f"{out} exists; add --force to replace it")


class _Group(click.Group):
    """Turn the project's errors into one line on stderr and their exit code."""

    def invoke(self, ctx: click.Context) -> object:
        try:
            return super().invoke(ctx)
        except GcarError as error:
            click.echo(f"gcar-export: error: {error}", err=True)
            sys.exit(error.exit_code)
        except KeyboardInterrupt:
            click.echo("gcar-export: interrupted", err=True)
            sys.exit(130)
        except (click.ClickException, click.Abort, click.exceptions.Exit):
            raise
        except ImportError as error:
            need = f"{error.name} is missing; pip install 'gcar[export]'"
            click.echo(f"gcar-export: error: {need}", err=True)
            sys.exit(1)
        except Exception as error:
            logging.getLogger("gcar_export").info("internal error", exc_info=True)
            detail = (str(error).splitlines() or [""])[0][:200]
            kind = type(error).__name__
            click.echo(f"gcar-export: error: internal: {kind} {detail}; see -v", err=True)
            sys.exit(1)


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("-v", "--verbose", is_flag=True, help="Say more on stderr.")
def main(verbose: bool) -> None:
    """Simulate, evaluate and score coronary reconstructions."""
    level = logging.INFO if verbose else logging.WARNING
    logging.basicConfig(level=level, format="%(name)s: %(message)s", stream=sys.stderr)


@main.command()
@click.argument("case_dirs", nargs=-1, type=_FOLDER, required=True)
@click.option(
    "--run-option", "extra", multiple=True, help="Passed on to 'gcar run', one word each."
)
@click.option("--limit", default=600.0, show_default=True, help="Seconds per case.")
def score(case_dirs: tuple[Path, ...], extra: tuple[str, ...], limit: float) -> None:
    """Score ready cases (view*.png, geom.json, truth.nii.gz) through 'gcar run'.

    Example: gcar-export score cases/P_0001 cases/M_0001
    """
    from gcar_export.evaluate import score as scoring

    scores = []
    for folder in case_dirs:
        scores.append(scoring.score_case(folder, extra, limit))
        click.echo(f"[{len(scores)}/{len(case_dirs)}] {folder.name}", err=True)
    click.echo(scoring.table(scores))


@main.command()
@click.argument("label", type=_FILE)
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--protocol",
    type=click.Choice(["paper", "clinical", "moved", "raw"]),
    default="paper",
    show_default=True,
)
@click.option("--views", default=2, show_default=True, help="2 .. 16")
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
@click.argument("label", type=_FILE)
@click.option("--repeats", default=7, show_default=True, help="Timings of each.")
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


@main.command()
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the run.")
@click.option(
    "--network",
    type=click.Choice(["multi", "paper"]),
    default="multi",
    show_default=True,
    help="The predictor that sees all views, or the paper's that sees one.",
)
@click.option(
    "--preset", type=click.Choice(["cpu", "gpu", "tune", "tiny"]), default="cpu", show_default=True
)
@click.option("--steps", type=click.IntRange(1), help="Steps in all; overrides the preset.")
@click.option("--decay-steps", type=click.IntRange(1), help="Length of the final linear decay.")
@click.option(
    "--minutes", type=click.FloatRange(0), help="Stop after so long; the same command goes on."
)
@click.option(
    "--labels",
    type=_FOLDER,
    help="Label volumes of your own (.nii, .nii.gz, .nrrd, .mha, .mhd): half of the scenes.",
)
@click.option(
    "--learning-rate", type=click.FloatRange(0, 1, min_open=True), help="The preset's otherwise."
)
@click.option(
    "--seed", type=click.IntRange(1), help="Of the scenes; a tuning wants another than its model's."
)
@click.option("--warm-start", type=_FILE, help="Go on from the weights of this model (.onnx).")
def train(
    out: Path,
    network: str,
    preset: str,
    steps: int | None,
    decay_steps: int | None,
    minutes: float | None,
    labels: Path | None,
    learning_rate: float | None,
    seed: int | None,
    warm_start: Path | None,
) -> None:
    """Train a predictor on generated trees; stop and go on at will.

    Example: gcar-export train --network paper --out runs/a --minutes 60
    """
    from gcar_export.training.train import start

    start(
        out, network, preset, steps=steps, decay_steps=decay_steps, minutes=minutes, labels=labels,
        learning_rate=learning_rate, seed=seed, warm_start=warm_start,
    )  # fmt: skip


@main.command()
@click.argument("checkpoint", type=_FILE)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="The ONNX file.")
@click.option(
    "--inputs", type=click.IntRange(1), default=60, show_default=True, help="For the parity check."
)
@click.option("--int8", is_flag=True, help="Also try OUT-int8.onnx, kept if the task allows it.")
@_REPLACE
def export(checkpoint: Path, out: Path, inputs: int, int8: bool, force: bool) -> None:
    """Turn CHECKPOINT (.safetensors) into one ONNX file with its spec, and prove it.

    Example: gcar-export export runs/a/checkpoint.safetensors --out models/gcp-multi.onnx
    """
    from gcar_export.shipping.parity import export_checked

    _check_free(out, force)
    found = export_checked(checkpoint, out, inputs)
    click.echo(
        f"{out}: {found.inputs} inputs, largest difference {found.worst:.1e} of the range, "
        f"{found.decisions_equal:.4%} of decisions equal; task: Dice {found.task_torch:.4f} with "
        f"torch, {found.task_runtime:.4f} through the runtime"
    )
    if int8:
        from gcar_export.shipping.quantize import quantize_checked

        click.echo(quantize_checked(out))


@main.command()
@click.argument("model", type=_FILE)
@click.option("--scenes", default=12, show_default=True, help="Generated scenes to run.")
def verify(model: Path, scenes: int) -> None:
    """Check a model file against its spec and run it through the runtime's own predictor.

    Example: gcar-export verify models/gcp-multi.onnx
    """
    from gcar_export.shipping.verify import verify_model

    click.echo(verify_model(model, scenes))


@main.command()
@click.argument("model", type=_FILE)
@click.option("--force", is_flag=True, help="Replace an existing golden case.")
def golden(model: Path, force: bool) -> None:
    """Write MODEL's golden case: a small input, and what the model says to it today.

    It is run whenever the model is loaded; another answer is refused.

    Example: gcar-export golden models/gcp-multi.onnx
    """
    from gcar_export.shipping.golden import write_golden

    path = write_golden(model, force=force)
    click.echo(f"{path}: {path.stat().st_size} bytes")


@main.command("tree-table")
@click.option(
    "--data", type=_FOLDER, help="Folder with imagecas/; left out: generated trees alone."
)
@click.option("--count", default=30, show_default=True, help="Generated trees of each style.")
def tree_table(data: Path | None, count: int) -> None:
    """Compare generated trees with real ones, figure by figure.

    Example: gcar-export tree-table --data data
    """
    from gcar_export.studies.tree_table import STYLES, generated_statistics, real_statistics, table

    real = sorted((data / "imagecas").glob("*.label.nii.gz")) if data else []
    columns = {}
    for style in STYLES:
        with click.progressbar(range(count), label=style, file=sys.stderr) as seeds:
            columns[style] = [generated_statistics(seed, style) for seed in seeds]
    click.echo(table({**columns, "real": [real_statistics(path) for path in real]}))


@main.command("lumen-table")
@click.option(
    "--data", type=_FOLDER, help="Folder with imagecas/; left out: generated trees alone."
)
@click.option("--count", default=30, show_default=True, help="Cases, one stenosis each.")
@click.option(
    "--vessels",
    default=0,
    show_default=True,
    help="Single vessels of known area, of each kind of picture.",
)
@click.option("--healthy", default=0, show_default=True, help="Generated trees without a lesion.")
def lumen_table(data: Path | None, count: int, vessels: int, healthy: int) -> None:
    """Measure stenosis, radius and branch lengths on trees with one known stenosis.

    Left trees, the clinical views, stenoses of 30 .. 70 % of the diameter, 8 .. 16 mm long.
    With --vessels: round, oval and (with DATA/ivus) real lumens along centrelines of DATA/imagecas
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
    train_devices,
    ghost_fit,
    status_table,
):
    main.add_command(_verb)


@main.command()
@click.option("--data", type=_FOLDER, required=True, help="Folder with phantom_xa/.")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="New folder.")
@click.option("--landmarks", type=_FILE, help="JSON of landmarks marked in the four views.")
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
@click.option("--trees", default=3, show_default=True, help="Generated trees.")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Rows (JSON lines).")
def pose_table(trees: int, out: Path) -> None:
    """Measure trees from a second view that is off, with and without pose refinement.

    Goes on where an earlier run with the same --out stopped.

    Example: gcar-export pose-table --trees 3 --out pose.jsonl
    """
    from gcar_export.studies import pose_table as study

    out.parent.mkdir(parents=True, exist_ok=True)
    rows = study.measure(out, trees, progress=lambda text: click.echo(text, err=True))
    click.echo(study.markdown(rows))


@main.command("train-segmenter")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the run.")
@click.option("--preset", type=click.Choice(["cpu", "gpu"]), default="cpu", show_default=True)
@click.option("--steps", type=int, help="Steps in all.")
@click.option("--decay-steps", type=int, help="Length of the final decay.")
@click.option("--warmup-steps", type=int, help="Length of the rise at the start.")
@click.option("--batch", type=int, help="Pictures of a step.")
@click.option("--learning-rate", type=float)
@click.option("--seed", type=int, help="Of the generated pictures and the crops.")
@click.option("--real", type=_FOLDER, help="Real angiograms to train on: N.png, N_gt.png.")
@click.option("--fold", metavar="K/N", help="Leave the K-th of N parts of them out.")
@click.option("--folds", type=int, help="Train as many beside it, each without one such part.")
@click.option("--real-share", type=float, help="Of the pictures of a step, where there are any.")
@click.option("--pictures", type=int, help="Generated ones that are drawn; each is used often.")
@click.option(
    "--pool", type=click.Path(path_type=Path), help="Folder that keeps them, for several runs."
)
@click.option("--warm-start", type=_FILE, help="Checkpoint or ONNX model to begin with.")
@click.option("--minutes", type=float, help="Stop after so long; the same command goes on.")
def train_segmenter(
    out: Path, preset: str, warm_start: Path | None, pool: Path | None, minutes: float | None,
    **given: Any,
) -> None:  # fmt: skip
    """Train the segmentation network on generated and real angiograms; stop and go on at will.

    Options that are not given are those of the preset: two CPU cores for an hour, or a GPU.

    Example: gcar-export train-segmenter --out runs/s --real xca_masks --fold 1/5 --minutes 45
    """
    from gcar_export.training import segmenter as training

    options = training.chosen(preset, {k: v for k, v in given.items() if v is not None})
    workers = (os.cpu_count() or 1) if options.device != "cpu" else 1
    training.train(out, options, minutes=minutes, workers=workers, begin_from=warm_start, pool=pool)


@main.command("export-segmenter")
@click.argument("checkpoint", type=_FILE)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="The ONNX file.")
@click.option("--devices", type=_FILE, help="Of train-devices, or a model that has one: goes in.")
@_REPLACE
def export_segmenter(checkpoint: Path, out: Path, devices: Path | None, force: bool) -> None:
    """Turn the segmentation network's CHECKPOINT into one ONNX file with its spec, and prove it.

    CHECKPOINT may be an ONNX model, whose segmenter is taken as it is.

    Example: gcar-export export-segmenter runs/s/checkpoint.safetensors --out segmenter.onnx
    """
    from gcar_export.shipping import export_segmenter as exporting

    _check_free(out, force)
    worst = exporting.export_segmenter(checkpoint, out, devices=devices)
    click.echo(f"{out}: largest difference of a probability {worst:.1e}")

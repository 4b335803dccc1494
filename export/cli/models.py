"""The verbs about model files: from a checkpoint to ONNX, its proof, its golden case."""

from __future__ import annotations

from pathlib import Path

import click

from gcar_deploy.errors import UsageError
from gcar_export.cli.options import FILE, OUT_FILE, counted

_REPLACE = click.option("--force", is_flag=True, help="Replace a model that is there.")


def _check_free(out: Path, force: bool, int8: bool = False) -> None:
    """Refuse to write over a model, its spec or its golden case unasked."""
    from gcar_deploy.models import golden_path

    if out.suffix != ".onnx":
        raise UsageError(f"--out {out}: the file to write must end in .onnx")
    for model in (out, out.with_name(f"{out.stem}-int8.onnx"))[: 1 + int8]:
        for path in (model, model.with_suffix(".json"), golden_path(model)):
            if path.exists() and not force:
                raise UsageError(f"{path} exists; add --force to replace it")


@click.command()
@click.argument("checkpoint", type=FILE)
@click.option("--out", type=OUT_FILE, required=True, help="The ONNX file.")
@counted("--inputs", 60, "For the parity check.")
@click.option("--int8", is_flag=True, help="Also try OUT-int8.onnx, kept if the task allows it.")
@_REPLACE
def export(checkpoint: Path, out: Path, inputs: int, int8: bool, force: bool) -> None:
    """Turn CHECKPOINT (.safetensors) into one ONNX file with its spec, and prove it.

    Example: gcar-export export runs/a/checkpoint.safetensors --out models/gcp-multi.onnx
    """
    from gcar_export.shipping.parity import export_checked
    from gcar_export.shipping.task_check import hardly_trained

    _check_free(out, force, int8)
    found = export_checked(checkpoint, out, inputs)
    click.echo(
        f"{out}: {found.inputs} inputs, largest difference {found.worst:.1e} of the range, "
        f"{found.decisions_equal:.4%} of decisions equal; task: Dice {found.task_torch:.4f} with "
        f"torch, {found.task_runtime:.4f} through the runtime"
    )
    if hardly_trained(out, found.task_runtime):
        click.echo(
            f"gcar-export: warning: {out} finds little of the vessels (task Dice "
            f"{found.task_runtime:.2f}); the one that comes along reaches 0.69: is it trained?",
            err=True,
        )
    if int8:
        from gcar_export.shipping.quantize import quantize_checked

        click.echo(quantize_checked(out))


@click.command()
@click.argument("model", type=FILE)
@counted("--scenes", 12, "Generated scenes to run.")
def verify(model: Path, scenes: int) -> None:
    """Check a model file against its spec and run it through the runtime's own predictor.

    Example: gcar-export verify models/gcp-multi.onnx
    """
    from gcar_export.shipping.verify import verify_model

    click.echo(verify_model(model, scenes))


@click.command()
@click.argument("model", type=FILE)
@click.option("--force", is_flag=True, help="Replace an existing golden case.")
def golden(model: Path, force: bool) -> None:
    """Write MODEL's golden case: a small input, and what the model says to it today.

    It is run whenever the model is loaded; another answer is refused.

    Example: gcar-export golden models/gcp-multi.onnx
    """
    from gcar_export.shipping.golden import write_golden

    path = write_golden(model, force=force)
    click.echo(f"{path}: {path.stat().st_size} bytes")


@click.command("export-segmenter")
@click.argument("checkpoint", type=FILE)
@click.option("--out", type=OUT_FILE, required=True, help="The ONNX file.")
@click.option("--devices", type=FILE, help="Of train-devices, or a model that has one: goes in.")
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

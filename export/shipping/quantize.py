"""Optional int8: static quantisation with real calibration, kept only where the task allows it."""

from __future__ import annotations

import json
import logging
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from gcar_deploy.errors import ModelError
from gcar_deploy.models import ModelFile
from gcar_deploy.models.golden import golden_path
from gcar_deploy.predict.encoding import flat_inputs, input_names
from gcar_deploy.predict.kinds import read_predictor
from gcar_deploy.types import Array
from gcar_export.shipping.export_onnx import finish
from gcar_export.shipping.golden import write_golden
from gcar_export.shipping.task_check import task_measure
from gcar_export.training.dataset import training_scene
from gcar_export.training.networks.unet import UNetConfig
from gcar_export.training.paper_dataset import training_pictures

#: largest loss of the task measure, as a share of it
MOST_LOST = 0.01
#: seed of the calibration inputs; no training, validation or check draws from it
SEED = 60_001


class _Calibration:
    """Generated inputs, one at a time, as ONNX Runtime's quantiser asks for them."""

    def __init__(self, model: ModelFile, count: int) -> None:
        self._feeds = iter(_feeds(model, count))

    def get_next(self) -> dict[str, Array] | None:
        """Return the next input, None after the last."""
        return next(self._feeds, None)


def _feeds(model: ModelFile, count: int) -> list[dict[str, Array]]:
    if model.kind == "multi":
        return [
            dict(zip(input_names(), flat_inputs(training_scene(SEED, i).encoded), strict=True))
            for i in range(count)
        ]
    names = ["picture", "axes"][: 1 + model.inputs["pose"]]
    config = UNetConfig(pixels=model.inputs["pixels"], alpha=model.inputs["alpha"], width=(1,))
    return [
        dict(zip(names, (p.picture.network_input(), p.picture.axes_input()), strict=False))
        for i in range(count)
        for p in training_pictures(SEED, i, config)
    ]


def quantize(path: Path, out: Path, calibration: int = 16) -> ModelFile:
    """Write an int8 twin of the model at ``path`` with its spec.

    Weights and activations of convolutions and matrix products become 8-bit integers; the
    ranges come from ``calibration`` generated scenes.
    """
    from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    model = read_predictor(path)
    reader = _Calibration(model, calibration)
    CalibrationDataReader.register(_Calibration)
    with tempfile.TemporaryDirectory(prefix="gcar-int8-") as folder:
        prepared = Path(folder) / "prepared.onnx"
        # Its optimisation would fuse nodes into operators that only one runtime knows.
        quant_pre_process(
            str(path), str(prepared), skip_symbolic_shape=True, skip_optimization=True
        )
        quiet = logging.getLogger().level
        try:
            quantize_static(
                str(prepared), str(out), reader,
                op_types_to_quantize=["Conv", "MatMul", "Gemm"],
                activation_type=QuantType.QUInt8, weight_type=QuantType.QInt8, per_channel=True,
            )  # fmt: skip
        finally:
            logging.getLogger().setLevel(quiet)
    spec: dict[str, Any] = json.loads(json.dumps(model.spec))
    spec |= {"name": out.stem, "precision": f"int8, calibrated on {calibration} generated scenes"}
    finish(out, spec)
    write_golden(out, force=True)
    return read_predictor(out)


def quantize_checked(path: Path, scenes: int = 12, calibration: int = 16) -> str:
    """Write ``NAME-int8.onnx`` beside a model if the task measure allows it; say so.

    Returns
    -------
    sentence with both figures

    Raises
    ------
    ModelError
        The int8 twin loses more than ``MOST_LOST``, or cannot be made; none is left.
    """
    out = path.with_name(f"{path.stem}-int8.onnx")
    try:
        small = quantize(path, out, calibration)
        before, after = (task_measure(m, scenes) for m in (read_predictor(path), small))
        lost = (before - after) / max(before, 1e-9)
        figures = (
            f"Dice {before:.4f} -> {after:.4f} over {scenes} scenes ({-lost:+.2%}), "
            f"{path.stat().st_size:,} -> {len(small.data):,} bytes"
        )
        if not np.isfinite(lost) or lost > MOST_LOST:
            raise ModelError(f"int8 refused: {figures}; at most {MOST_LOST:.0%} may be lost")
    except BaseException:
        for file in (out, out.with_suffix(".json"), golden_path(out)):
            file.unlink(missing_ok=True)
        raise
    return f"{out}: int8 accepted, {figures}"

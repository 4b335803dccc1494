"""Golden input and output of a model: what it said on the day it was made, it must say now.

A weight that is slightly wrong loads and runs; a library that is slightly wrong does so too.
``NAME.golden.npz`` lies beside ``NAME.onnx`` and holds the model's SHA-256, every input
(``input/...``) and every output (``output/...``) of one small case.
"""

from __future__ import annotations

import dataclasses
import io
import os
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gcar_deploy.config import ModelLimits
from gcar_deploy.errors import ModelError
from gcar_deploy.files import read_bounded
from gcar_deploy.types import Array

#: largest relative and absolute difference from the golden output
RTOL, ATOL = 1e-3, 1e-4
#: runs a model: names of outputs, inputs by name -> outputs
Run = Callable[[Sequence[str], Mapping[str, Array]], Sequence[Array]]
_BROKEN = (ValueError, KeyError, EOFError, OSError, zipfile.BadZipFile, zlib.error, MemoryError,
           NotImplementedError, RuntimeError, SyntaxError, TypeError, OverflowError)  # fmt: skip


@dataclasses.dataclass(frozen=True, eq=False)
class Golden:
    """One case with its answer.

    Attributes
    ----------
    model_sha256 : str, of the ONNX file that gave the answer
    inputs, outputs : arrays by the names of the graph
    """

    model_sha256: str
    inputs: Mapping[str, Array]
    outputs: Mapping[str, Array]

    def to_bytes(self) -> bytes:
        """Return the content of ``NAME.golden.npz``."""
        arrays: dict[str, Any] = {f"input/{name}": array for name, array in self.inputs.items()}
        arrays |= {f"output/{name}": array for name, array in self.outputs.items()}
        stream = io.BytesIO()
        arrays["model_sha256"] = np.array(self.model_sha256)
        np.savez_compressed(stream, **arrays)
        return stream.getvalue()


def golden_path(model: Path) -> Path:
    """Where the golden case of ``model`` (``.onnx``) lies."""
    return model.with_suffix(".golden.npz")


def read_golden(model: Path, sha256: str, limits: ModelLimits) -> Golden | None:
    """Read the golden case beside ``model``; None where there is none.

    Raises
    ------
    ModelError
        Damaged, too large, or of another model.
    """
    path = golden_path(model)
    if not os.path.exists(path):
        return None
    try:
        data = read_bounded(path, limits.max_golden_bytes)
        _check_sizes(data, limits)
        with np.load(io.BytesIO(data), allow_pickle=False) as found:
            arrays = {name: found[name] for name in found.files}
        made_from = str(arrays.pop("model_sha256"))
    except _BROKEN:
        raise ModelError(f"golden case {path.name} is damaged; make it again") from None
    if made_from != sha256:
        raise ModelError(
            f"golden case {path.name} belongs to another model (SHA-256 {made_from[:12]}, "
            f"not {sha256[:12]})"
        )
    parts = {
        kind: {n.removeprefix(f"{kind}/"): a for n, a in arrays.items() if n.startswith(f"{kind}/")}
        for kind in ("input", "output")
    }
    if not parts["output"] or len(parts["input"]) + len(parts["output"]) != len(arrays):
        raise ModelError(f"golden case {path.name} is damaged; make it again")
    return Golden(made_from, parts["input"], parts["output"])


def check_golden(name: str, golden: Golden, run: Run) -> float:
    """Run the case and compare; return the largest absolute difference.

    Raises
    ------
    ModelError
        The model answers differently, or not at all.
    """
    wanted = list(golden.outputs)
    worst = 0.0
    for key, answer in zip(wanted, run(wanted, golden.inputs), strict=True):
        expected = golden.outputs[key]
        if answer.shape != expected.shape or not np.isfinite(answer).all():
            raise ModelError(f"model {name} fails its golden case: output {key} is not usable")
        worst = max(worst, float(np.abs(answer - expected).max(initial=0.0)))
        if not np.allclose(answer, expected, rtol=RTOL, atol=ATOL):
            raise ModelError(
                f"model {name} fails its golden case: output {key} differs by {worst:.1e}"
            )
    return worst


def _check_sizes(data: bytes, limits: ModelLimits) -> None:
    """Refuse an archive that would unpack to more than eight times the file's limit."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        sizes = [entry.file_size for entry in archive.infolist()]
    if len(sizes) > 256 or sum(sizes) > 8 * limits.max_golden_bytes:
        raise ValueError

"""A model never travels without its spec: what it expects, what it was made from, its hash."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from gcar_deploy.errors import ModelError
from gcar_deploy.predict.encoding import LEVELS, VIEW_FEATURES

SCHEMA = "gcar-model/1"
MAX_MODEL_BYTES = 64 * 2**20
#: name of the model that ``gcar run`` uses unless told otherwise
DEFAULT_MODEL = "gcp-multi"
#: name of the network that finds vessels in raw pictures
SEGMENTER_MODEL = "segmenter"


@dataclasses.dataclass(frozen=True)
class ModelFile:
    """The bytes of a verified model and its spec.

    Attributes
    ----------
    name : str
    spec : dict, the content of the ``.json`` beside the ``.onnx``
    sha256 : str of the ONNX file
    data : bytes of the ONNX file
    """

    name: str
    spec: dict[str, Any]
    sha256: str
    data: bytes = dataclasses.field(repr=False)


def shipped_model_path(name: str = DEFAULT_MODEL) -> Path | None:
    """Where the wheel keeps the model ``name``, or None if it does not ship it."""
    path = Path(str(resources.files("gcar_models"))) / f"{name}.onnx"
    return path if path.is_file() else None


def read_model(path: Path, wanted: Mapping[str, Any] | None = None) -> ModelFile:
    """Read and verify an ONNX file and the spec beside it.

    Parameters
    ----------
    path : of the ONNX file
    wanted : what its spec must say of ``inputs``; by default those of the centre predictor

    Raises
    ------
    ModelError
        A file is missing, too large, not what its spec says, or made for other inputs.
    """
    spec_path = path.with_suffix(".json")
    for p in (path, spec_path):
        if not p.is_file():
            raise ModelError(f"model file {p.name} is missing")
        if p.stat().st_size > MAX_MODEL_BYTES:
            raise ModelError(f"model file {p.name} is larger than {MAX_MODEL_BYTES >> 20} MiB")
    try:
        spec = json.loads(spec_path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError):
        raise ModelError(f"model spec {spec_path.name} is not JSON") from None
    if not isinstance(spec, dict) or spec.get("schema") != SCHEMA:
        raise ModelError(f"model spec {spec_path.name} is not of schema {SCHEMA}")
    data = path.read_bytes()
    digest = hashlib.sha256(data).hexdigest()
    if digest != spec.get("sha256"):
        raise ModelError(
            f"model file {path.name} was altered: its SHA-256 starts {digest[:12]}, "
            f"its spec says {str(spec.get('sha256'))[:12]}"
        )
    wanted = wanted or {"view_features": VIEW_FEATURES, "levels": LEVELS}
    inputs = spec.get("inputs", {})
    for key, value in wanted.items():
        if not isinstance(inputs, dict) or inputs.get(key) != value:
            raise ModelError(
                f"model {path.name} wants inputs.{key} = {dict(inputs or {}).get(key)!r}, "
                f"this version gives {value}"
            )
    return ModelFile(name=str(spec.get("name", path.stem)), spec=spec, sha256=digest, data=data)

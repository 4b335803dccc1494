"""A model never travels without its spec: what it expects, what it was made from, its hash."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from importlib import resources
from pathlib import Path
from typing import Any

from gcar_deploy.errors import ModelError
from gcar_deploy.predict.center_map import DEPTH_PIXELS, MAX_PATH_PIXELS, OFFSET_PIXELS
from gcar_deploy.predict.encoding import LEVELS, VIEW_FEATURES

SCHEMA = "gcar-model/1"
KINDS = ("multi", "single")
MAX_MODEL_BYTES = 64 * 2**20
#: the shipped model of each kind; the first is the one that ``gcar run`` uses unless told otherwise
SHIPPED = {"multi": "gcp-multi", "single": "gcp-single"}
DEFAULT_MODEL = SHIPPED["multi"]


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

    @property
    def kind(self) -> str:
        """``multi`` (all views at once) or ``single`` (one view at a time)."""
        return str(self.spec["kind"])

    @property
    def inputs(self) -> dict[str, Any]:
        """What the model wants, as its spec says."""
        return dict(self.spec["inputs"])


def shipped_model_path(name: str = DEFAULT_MODEL) -> Path | None:
    """Where the wheel keeps the model ``name``, or None if it does not ship it."""
    path = Path(str(resources.files("gcar_models"))) / f"{name}.onnx"
    return path if path.is_file() else None


def read_model(path: Path) -> ModelFile:
    """Read and verify an ONNX file and the spec beside it.

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
    _check_inputs(path.name, spec)
    return ModelFile(name=str(spec.get("name", path.stem)), spec=spec, sha256=digest, data=data)


def _check_inputs(name: str, spec: dict[str, Any]) -> None:
    """Refuse a model that was made for other inputs than this version gives."""
    kind, inputs = spec.get("kind"), spec.get("inputs")
    if kind not in KINDS:
        raise ModelError(f"model {name} has kind = {kind!r}, which is none of {', '.join(KINDS)}")
    inputs = inputs if isinstance(inputs, dict) else {}
    wanted: dict[str, float] = {"view_features": VIEW_FEATURES, "levels": LEVELS}
    if kind == "single":
        wanted = {
            "depth_pixels": DEPTH_PIXELS,
            "offset_pixels": OFFSET_PIXELS,
            "max_path_pixels": MAX_PATH_PIXELS,
        }
        for key, low, high in (("pixels", 16, 1024), ("alpha", 1, 64)):
            value = inputs.get(key)
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise ModelError(
                    f"model {name} wants inputs.{key} = {value!r}; a whole number in "
                    f"{low} .. {high} is understood"
                )
        if not isinstance(inputs.get("pose"), bool):
            raise ModelError(f"model {name} wants inputs.pose = {inputs.get('pose')!r}, not a bool")
        if inputs["pixels"] % inputs["alpha"]:
            raise ModelError(f"model {name}: inputs.pixels is no multiple of inputs.alpha")
    for key, want in wanted.items():
        if inputs.get(key) != want:
            raise ModelError(
                f"model {name} wants inputs.{key} = {inputs.get(key)!r}, this version gives {want}"
            )

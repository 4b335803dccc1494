"""A model never travels without its spec: what it expects, what it was made from, its hash."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from gcar_deploy.config import ModelLimits
from gcar_deploy.errors import GeometryError, ModelError
from gcar_deploy.files import read_bounded
from gcar_deploy.geometry.fields import read_json
from gcar_deploy.models.golden import Golden, read_golden
from gcar_deploy.models.guard import check_onnx
from gcar_deploy.predict.center_map import DEPTH_PIXELS, MAX_PATH_PIXELS, OFFSET_PIXELS
from gcar_deploy.predict.encoding import LEVELS, VIEW_FEATURES

SCHEMA = "gcar-model/1"
#: the shipped centre predictor of each kind; ``multi`` is what ``gcar run`` uses unless told
SHIPPED = {"multi": "gcp-multi", "single": "gcp-single"}
DEFAULT_MODEL = SHIPPED["multi"]
#: name of the network that finds vessels in raw pictures
SEGMENTER_MODEL = "segmenter"
_WANTED: dict[str, dict[str, float]] = {
    "multi": {"view_features": VIEW_FEATURES, "levels": LEVELS},
    "single": {
        "depth_pixels": DEPTH_PIXELS,
        "offset_pixels": OFFSET_PIXELS,
        "max_path_pixels": MAX_PATH_PIXELS,
    },
}


@dataclasses.dataclass(frozen=True)
class ModelFile:
    """The bytes of a verified model and its spec.

    Attributes
    ----------
    name : str
    spec : dict, the content of the ``.json`` beside the ``.onnx``
    sha256 : str of the ONNX file
    data : bytes of the ONNX file
    golden : Golden or None, a small case with its answer, where there is one beside the model
    limits : ModelLimits it was read with
    """

    name: str
    spec: dict[str, Any]
    sha256: str
    data: bytes = dataclasses.field(repr=False)
    golden: Golden | None = dataclasses.field(default=None, repr=False)
    limits: ModelLimits = dataclasses.field(default_factory=ModelLimits, repr=False)

    @property
    def kind(self) -> str:
        """``multi`` (all views at once), ``single`` (one view at a time), or another network's."""
        return str(self.spec.get("kind"))

    @property
    def inputs(self) -> dict[str, Any]:
        """What the model wants, as its spec says."""
        return dict(self.spec["inputs"])


def shipped_model_path(name: str = DEFAULT_MODEL) -> Path | None:
    """Where the wheel keeps the model ``name``, or None if it does not ship it."""
    path = Path(str(resources.files("gcar_models"))) / f"{name}.onnx"
    return path if path.is_file() else None


def read_model(
    path: Path, limits: ModelLimits | None = None, wanted: Mapping[str, Any] | None = None
) -> ModelFile:
    """Read and verify an ONNX file and the spec beside it; nothing of the model is run.

    Parameters
    ----------
    path : of the ``.onnx``; its ``.json`` and, where there is one, its ``.golden.npz`` lie beside
    limits : ModelLimits, optional
    wanted : what its spec must say of ``inputs``; by default those of a centre predictor

    Raises
    ------
    ModelError
        A file is missing, too large, not what its spec says, made for other inputs, or holds
        what a model of this project does not need (see ``onnx_guard``).
    """
    limits = limits or ModelLimits()
    spec_path = path.with_suffix(".json")
    data = _read("model file", path, limits.max_bytes)
    spec = _spec(spec_path, limits)
    digest = hashlib.sha256(data).hexdigest()
    if digest != spec.get("sha256"):
        raise ModelError(
            f"model file {path.name} was altered: its SHA-256 starts {digest[:12]}, "
            f"its spec says {str(spec.get('sha256'))[:12]}"
        )
    _check_inputs(path.name, spec, wanted)
    try:
        check_onnx(data, limits)
    except ValueError as error:
        raise ModelError(f"model file {path.name} {error}") from None
    return ModelFile(
        name=str(spec.get("name", path.stem)),
        spec=spec,
        sha256=digest,
        data=data,
        golden=read_golden(path, digest, limits),
        limits=limits,
    )


def _check_inputs(name: str, spec: dict[str, Any], wanted: Mapping[str, Any] | None) -> None:
    """Refuse a model that was made for other inputs than this version gives."""
    kind, inputs = spec.get("kind"), spec.get("inputs")
    inputs = inputs if isinstance(inputs, dict) else {}
    if wanted is None:
        if kind not in SHIPPED:
            raise ModelError(f"model {name} has kind = {kind!r}; known are {', '.join(SHIPPED)}")
        if kind == "single":
            _check_sizes(name, inputs)
        wanted = _WANTED[str(kind)]
    for key, value in wanted.items():
        if inputs.get(key) != value:
            raise ModelError(
                f"model {name} wants inputs.{key} = {inputs.get(key)!r}, this version gives {value}"
            )


def _check_sizes(name: str, inputs: dict[str, Any]) -> None:
    """Refuse sizes of the single-view predictor's picture and cells that make no sense."""
    for key, low, high in (("pixels", 16, 1024), ("alpha", 1, 64)):
        value = inputs.get(key)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise ModelError(
                f"model {name} wants inputs.{key} = {value!r}; a whole number in "
                f"{low} .. {high} is understood"
            )
    if inputs["pixels"] % inputs["alpha"]:
        raise ModelError(f"model {name}: inputs.pixels is no multiple of inputs.alpha")
    if not isinstance(inputs.get("pose"), bool):
        raise ModelError(f"model {name} wants inputs.pose = {inputs.get('pose')!r}, not a bool")


def _read(what: str, path: Path, max_bytes: int) -> bytes:
    try:
        return read_bounded(path, max_bytes)
    except ValueError as error:
        raise ModelError(f"{what} {path.name}: {error}") from None


def _spec(path: Path, limits: ModelLimits) -> dict[str, Any]:
    data = _read("model file", path, limits.max_spec_bytes)
    try:
        spec = read_json(data.decode("utf-8"))
    except (UnicodeDecodeError, GeometryError):
        raise ModelError(f"model spec {path.name} is not JSON") from None
    if not isinstance(spec, dict) or spec.get("schema") != SCHEMA:
        raise ModelError(f"model spec {path.name} is not of schema {SCHEMA}")
    return spec

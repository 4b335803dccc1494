"""A model never travels without its spec: what it expects, what it was made from, its hash."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from gcar_deploy.config import ModelLimits
from gcar_deploy.errors import GeometryError, ModelError
from gcar_deploy.files import read_bounded
from gcar_deploy.geometry.fields import read_json
from gcar_deploy.models.golden import Golden, read_golden

SCHEMA = "gcar-model/1"
_MAX_SPEC_BYTES = 64 * 2**10
_PLACE, _LIST = "gcar_models", "SHA256SUMS"


@dataclasses.dataclass(frozen=True)
class Kind:
    """What this version gives to models of one kind; the room that uses them says it.

    Attributes
    ----------
    name : str, what a spec calls the kind
    shipped : str, name of the model of this kind that comes along
    inputs : what a spec must say of ``inputs``
    unfit : says of a spec's ``inputs`` what else is not understood, as the end of the sentence
        "model NAME ..."; empty where all is
    """

    name: str
    shipped: str
    inputs: Mapping[str, float]
    unfit: Callable[[Mapping[str, Any]], str] | None = None

    @property
    def path(self) -> Path | None:
        """Where the model that comes along lies; None where it is not installed."""
        return shipped_model_path(self.shipped)


@dataclasses.dataclass(frozen=True)
class ModelFile:
    """The bytes of a verified model and its spec.

    Attributes
    ----------
    name : str
    spec : dict, the content of the ``.json`` beside the ``.onnx``
    sha256 : str of the ONNX file
    data : bytes of the ONNX file
    pinned : bool, the file comes along and has the hash that the release lists: neither walked by
        the guard nor held to its golden case as it is opened, both of which ``gcar doctor`` does
    golden : Golden or None, a small case with its answer, where there is one beside the model
    """

    name: str
    spec: dict[str, Any]
    sha256: str
    data: bytes = dataclasses.field(repr=False)
    pinned: bool = False
    golden: Golden | None = dataclasses.field(default=None, repr=False)

    @property
    def kind(self) -> str:
        """Which network it is, as its spec says; one of the kinds it was read for."""
        return str(self.spec.get("kind"))

    @property
    def inputs(self) -> dict[str, Any]:
        """What the model wants, as its spec says."""
        return dict(self.spec["inputs"])

    @property
    def label(self) -> dict[str, str]:
        """Name and SHA-256: what results say of it."""
        return {"name": self.name, "sha256": self.sha256}


def shipped_model_path(name: str) -> Path | None:
    """Where the wheel keeps the model ``name``, or None if it does not ship it."""
    path = Path(str(resources.files(_PLACE))) / f"{name}.onnx"
    return path if path.is_file() else None


def read_model(path: Path, kinds: Sequence[Kind], limits: ModelLimits | None = None) -> ModelFile:
    """Read and verify an ONNX file and the spec beside it; nothing of the model is run.

    A shipped file with the hash that the release lists is not walked again (see ``pinned``), unless
    other limits are asked for.

    Parameters
    ----------
    path : of the ``.onnx``; its ``.json`` and, where there is one, its ``.golden.npz`` lie beside
    kinds : of model that the caller can use
    limits : ModelLimits, optional

    Raises
    ------
    ModelError
        A file is missing, too large, not what its spec says, of another kind, made for other
        inputs, or holds what a model of this project does not need (see ``guard``).
    """
    limits = limits or ModelLimits()
    data = _read("model file", path, limits.max_bytes)
    spec = _spec(path.with_suffix(".json"))
    digest = hashlib.sha256(data).hexdigest()
    if digest != spec.get("sha256"):
        raise ModelError(
            f"model file {path.name} was altered: its SHA-256 starts {digest[:12]}, "
            f"its spec says {str(spec.get('sha256'))[:12]}"
        )
    _check_kind(path.name, spec, kinds)
    model = ModelFile(
        name=str(spec.get("name", path.stem)),
        spec=spec,
        sha256=digest,
        data=data,
        pinned=digest == _listed(path),
        golden=read_golden(path, digest, limits),
    )
    # The release was held to the usual limits alone.
    if not model.pinned or limits != ModelLimits():
        check_graph(path.name, data, limits)
    return model


def check_graph(name: str, data: bytes, limits: ModelLimits | None = None) -> None:
    """Refuse a file whose graph holds what a model of this project does not need; see ``guard``.

    Raises
    ------
    ModelError
    """
    from gcar_deploy.models.guard import check_onnx

    try:
        check_onnx(data, limits or ModelLimits())
    except ValueError as error:
        raise ModelError(f"model file {name} {error}") from None


def _listed(path: Path) -> str | None:
    """SHA-256 that the release lists for the file at ``path``; None for a file of others."""
    place = Path(str(resources.files(_PLACE)))
    try:
        if not path.parent.samefile(place):
            return None
        lines = (place / _LIST).read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError):
        return None
    return next((line[:64] for line in lines if line[64:].strip() == path.name), None)


def _check_kind(name: str, spec: dict[str, Any], kinds: Sequence[Kind]) -> None:
    """Refuse a model of another kind, or for other inputs than this version gives."""
    found, inputs = spec.get("kind"), spec.get("inputs")
    inputs = inputs if isinstance(inputs, dict) else {}
    kind = next((one for one in kinds if one.name == found), None)
    if kind is None:
        known = ", ".join(one.name for one in kinds)
        raise ModelError(f"model {name} has kind = {found!r}; known here: {known}")
    for key, value in kind.inputs.items():
        if inputs.get(key) != value:
            raise ModelError(
                f"model {name} wants inputs.{key} = {inputs.get(key)!r}, this version gives {value}"
            )
    unfit = kind.unfit(inputs) if kind.unfit else ""
    if unfit:
        raise ModelError(f"model {name} {unfit}")


def _read(what: str, path: Path, max_bytes: int) -> bytes:
    try:
        return read_bounded(path, max_bytes)
    except ValueError as error:
        raise ModelError(f"{what} {path.name or path}: {error}") from None


def _spec(path: Path) -> dict[str, Any]:
    data = _read("model file", path, _MAX_SPEC_BYTES)
    try:
        spec = read_json(data.decode("utf-8"))
    except (UnicodeDecodeError, GeometryError):
        raise ModelError(f"model spec {path.name} is not JSON") from None
    if not isinstance(spec, dict) or spec.get("schema") != SCHEMA:
        raise ModelError(f"model spec {path.name} is not of schema {SCHEMA}")
    return spec

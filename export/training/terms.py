"""Whose terms hold for a segmenter: those of its real pictures and of what it began from."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from gcar_deploy.errors import ModelError
from gcar_export.training.checkpoint import read_manifest

#: how the licence of what this project trains on its own pictures begins
OWN = "Apache-2.0"
#: keys of a manifest that name real pictures: its own, and those behind its first weights
_REAL = ("real", "real_before")


def license_of(training: Mapping[str, Any]) -> str:
    """Return the licence of a segmenter whose two networks were trained as this says.

    What the first weights of either brought along holds for it as well.
    """
    parts = {"training": training, "training.devices": training.get("devices") or {}}
    named = [f"{k}.{key}" for k, part in parts.items() for key in _REAL if part.get(key)]
    terms = [f"that of the pictures named in {' and '.join(named)}"] if named else []
    terms += [one for part in parts.values() for one in part.get("licenses_before", ())]
    return "; ".join(dict.fromkeys(terms)) or f"{OWN}; trained on {training.get('data')}"


def trained_as(path: Path, devices: bool = False) -> dict[str, Any]:
    """Return what the manifest of a checkpoint, or the spec of an ONNX model, says of a training.

    Terms that do not follow from it, such as those that somebody wrote into the spec, are added to
    its ``licenses_before``.

    Parameters
    ----------
    path : ``.safetensors`` or ``.onnx``
    devices : whether the network of lines is meant, of a model that holds two

    Raises
    ------
    ModelError
        The manifest, or the spec of the model, is missing or says nothing of it.
    """
    try:
        found, terms = _of_model(path, devices) if path.suffix == ".onnx" else _of_checkpoint(path)
        str(found["data"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ModelError(f"{path}: what it was trained on is not said ({error})") from None
    before = dict.fromkeys([*found.get("licenses_before", ()), *terms])
    return found | ({"licenses_before": list(before)} if before else {})


def _of_model(path: Path, devices: bool) -> tuple[dict[str, Any], list[str]]:
    spec = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    training = spec["training"]
    told = license_text(path.with_suffix(".json").name, spec, license_of(training))
    terms = [] if told == license_of(training) else [told]
    return dict(training["devices"] if devices else training), terms


def _of_checkpoint(path: Path) -> tuple[dict[str, Any], list[str]]:
    training = read_manifest(path)
    folder = (training.get("options") or {}).get("real")
    # A run of an earlier version names the folder alone.
    return training, [f"that of the pictures in {folder}"] * bool(folder and "real" not in training)


def license_text(name: str, spec: Mapping[str, Any], otherwise: str) -> str:
    """Return the licence that a spec tells.

    Raises
    ------
    ModelError
        It is no text: whoever wrote it meant something that would be lost.
    """
    told = spec.get("license", otherwise)
    if not isinstance(told, str):
        raise ModelError(f"{name}: license = {json.dumps(told)[:60]} is no text")
    return told


def begun(first: Path | None, data: str, devices: bool = False) -> dict[str, Any]:
    """Return what a manifest says of what was trained on, that of the first weights included.

    Parameters
    ----------
    first : checkpoint or ONNX model that its weights began from; None for random ones
    data : what it is trained on itself, part by part
    devices : whether it is the network of lines

    Returns
    -------
    ``data``; and, where there are any, ``real_before``, name to SHA-256 of real pictures, and
    ``licenses_before``, terms that do not follow from these

    Raises
    ------
    ModelError
        As ``trained_as``.
    """
    if first is None:
        return {"data": data}
    training = trained_as(first, devices)
    pieces = dict.fromkeys([*data.split("; "), *str(training["data"]).split("; ")])
    kept = {"real_before": dict(_pictures(training))}
    kept["licenses_before"] = training.get("licenses_before", [])
    return {"data": "; ".join(pieces)} | {key: value for key, value in kept.items() if value}


def _pictures(training: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Names and SHA-256 of all real pictures; of one name for two, the hash is in the second's."""
    seen: dict[str, str] = {}
    for key in _REAL:
        for name, digest in (training.get(key) or {}).items():
            same = seen.setdefault(name, digest) == digest
            yield (name if same else f"{name} ({digest[:8]})"), digest

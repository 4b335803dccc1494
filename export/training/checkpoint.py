"""Read a checkpoint that may come from anywhere: tensors only, nothing is ever run.

A checkpoint is ``NAME.safetensors``, a header of JSON and raw numbers, with ``manifest.json``
beside it. Pickled checkpoints (``.pt``, ``.pth``) are programs and are not read at all.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load

from gcar_deploy.errors import GeometryError, ModelError
from gcar_deploy.files import read_bounded
from gcar_deploy.geometry.fields import read_json

#: weights, their mean and the optimiser's two moments, in single precision, of some 60 M weights
MAX_BYTES = 2**30
MAX_MANIFEST_BYTES = 64 * 2**10
#: widest layer and most stages that a manifest may ask for
MAX_WIDTH = 4096
N = TypeVar("N", bound=torch.nn.Module)
#: what names of weights begin with, and of their mean (``mean_weights``) where one was kept
WEIGHTS, MEAN = "net.", "mean."
#: network of a manifest -> what its checkpoint is of, and what takes it
_TAKEN_BY = {
    "sparse": ("a predictor", "export"),
    "unet": ("a predictor", "export"),
    "mask-unet": ("the segmenter", "export-segmenter"),
    "line-net": ("the device network", "export-segmenter --devices"),
}


def read_tensors(path: Path) -> dict[str, torch.Tensor]:
    """Read all tensors of a ``.safetensors`` file.

    Raises
    ------
    ModelError
        Another kind of file, damaged, larger than ``MAX_BYTES``, or values not finite.
    """
    if path.suffix != ".safetensors":
        raise ModelError(f"checkpoint {path.name} is no .safetensors file; pickles are not read")
    try:
        tensors = load(read_bounded(path, MAX_BYTES))
    except (ValueError, KeyError, OverflowError, MemoryError, SafetensorError, RuntimeError) as e:
        raise ModelError(f"checkpoint {path.name} cannot be read: {_line(e)}") from None
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor.float()).all()):
            raise ModelError(f"checkpoint {path.name}: {name[:60]!r} holds values not finite")
    return tensors


def read_manifest(path: Path, networks: Sequence[str] = ()) -> dict[str, Any]:
    """Read the ``manifest.json`` beside the checkpoint ``path``, strictly.

    Parameters
    ----------
    path : of the checkpoint
    networks : that the caller can use; any without

    Raises
    ------
    ModelError
        Missing, not JSON, of another network, or sizes of the network out of range.
    """
    file = path.parent / "manifest.json"
    try:
        found = read_json(read_bounded(file, MAX_MANIFEST_BYTES).decode("utf-8"))
    except (ValueError, GeometryError) as error:
        raise ModelError(f"{file.name} of {path.name} cannot be read: {_line(error)}") from None
    if not isinstance(found, dict) or not isinstance(found.get("config"), dict):
        raise ModelError(f"{file.name} of {path.name} has no config")
    network = found.get("network", "sparse")
    if networks and network not in networks and network in _TAKEN_BY:
        what, verb = _TAKEN_BY[network]
        raise ModelError(f"{path} is a checkpoint of {what}: use it with {verb}")
    for key, value in found["config"].items():
        for size in value if isinstance(value, list) else [value]:
            whole = isinstance(size, int) and not isinstance(size, bool)
            if whole and not 0 <= size <= MAX_WIDTH:
                raise ModelError(f"{file.name}: config.{key[:40]} = {size} is not 0 .. {MAX_WIDTH}")
    return found


def weights(tensors: Mapping[str, torch.Tensor], prefix: str = WEIGHTS) -> dict[str, torch.Tensor]:
    """Return the entries of a checkpoint that begin with ``prefix``, without it."""
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def best_weights(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the mean of the weights where one was kept, else the weights."""
    return weights(tensors, MEAN) or weights(tensors)


def network_of(path: Path, networks: Mapping[str, Callable[..., N]]) -> N:
    """Build the network that a checkpoint is of, with its weights, ready to be asked.

    Parameters
    ----------
    path : ``.safetensors`` beside its ``manifest.json``
    networks : name in the manifest -> what makes the network of its ``config``

    Raises
    ------
    ModelError
        Either file is damaged, of another network, or they do not belong together.
    """
    manifest = read_manifest(path, tuple(networks))
    config = {k: tuple(v) if isinstance(v, list) else v for k, v in manifest["config"].items()}
    try:
        net = networks[manifest.get("network", "sparse")](**config)
    except (KeyError, TypeError, ValueError, RuntimeError, IndexError, ZeroDivisionError) as error:
        raise ModelError(f"manifest.json of {path.name}: no such network ({error})") from None
    filled(net, read_tensors(path), path.name)
    return net.eval()


def filled(module: torch.nn.Module, tensors: dict[str, torch.Tensor], name: str) -> None:
    """Put the weights into ``module``; names and shapes must be exactly its own.

    Raises
    ------
    ModelError
    """
    try:
        module.load_state_dict(best_weights(tensors))
    except RuntimeError as error:
        raise ModelError(f"{name} does not fit its manifest: {_line(error)}") from None


def _line(error: Exception) -> str:
    return re.sub(r"\s+", " ", str(error))[:200] or type(error).__name__

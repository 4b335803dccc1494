"""The weights of a multi-view predictor from its ONNX file: where a further training may begin.

The graph keeps each weight under the name that it had in torch, but for those of layers that act on
all views at once: their product with a transposed copy is found through the bias added to it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gcar_deploy.errors import ModelError
from gcar_deploy.models.spec import ModelFile, read_model
from gcar_deploy.predict.kinds import MULTI
from gcar_export.training.networks.sparse import SparseConfig, SparsePredictor
from gcar_export.training.terms import license_text

_PREFIX = "net."
#: licence of what was trained on no label volume
OWN_LICENSE = "Apache-2.0; trained on generated trees alone"
#: keys of a manifest that name label volumes: its own, and those behind its first weights
_LABELS = ("labels", "labels_before")


def license_of(training: Mapping[str, Any]) -> str:
    """Return the licence of what was trained as this manifest says.

    What its first weights brought along holds for it as well (``inherited``).
    """
    named = [f"training.{key}" for key in _LABELS if training.get(key)]
    terms = [f"that of the label volumes named in {' and '.join(named)}"] if named else []
    return "; ".join([*terms, *training.get("licenses_before", ())]) or OWN_LICENSE


def inherited(model: ModelFile) -> dict[str, Any]:
    """Return what a training that begins from a model has to keep in its manifest.

    Returns
    -------
    ``warm_start``: SHA-256 of the file; ``labels_before``: name to SHA-256 of all label volumes
    that it and the models before it were trained on; ``licenses_before``: terms that do not follow
    from these
    """
    training = model.spec.get("training", {})
    labels: dict[str, str] = {}
    for key in _LABELS:
        for name, digest in (training.get(key) or {}).items():
            same = labels.get(name, digest) == digest
            labels[name if same else f"{name} ({digest[:8]})"] = digest
    terms = list(training.get("licenses_before", ()))
    told = license_text(model.name, model.spec, OWN_LICENSE)
    if told not in (license_of(training), *terms):
        terms.append(told)
    return {"warm_start": model.sha256, "labels_before": labels, "licenses_before": terms}


def predictor_of(model: Path) -> tuple[SparsePredictor, ModelFile]:
    """Return the network that a model file was exported from, and the file.

    Raises
    ------
    ModelError
        Not a multi-view predictor of this version, damaged, or a weight that cannot be found.
    """
    import onnx

    file = read_model(model, (MULTI,))
    try:
        config = dict(file.spec["training"]["config"])
        net = SparsePredictor(SparseConfig(**{**config, "width": tuple(config["width"])}))
    except (KeyError, TypeError, ValueError):
        raise ModelError(f"{model.name} does not say which network it holds") from None
    graph = onnx.load_from_string(file.data).graph
    net.load_state_dict({name: _weight(graph, name, net) for name in net.state_dict()})
    return net, file


def _weight(graph: Any, name: str, net: SparsePredictor) -> torch.Tensor:
    from onnx import numpy_helper

    arrays = {entry.name: entry for entry in graph.initializer}
    own = arrays.get(_PREFIX + name)
    if own is not None:
        value = numpy_helper.to_array(own)
    else:
        value = numpy_helper.to_array(arrays[_factor(graph, name, set(arrays))]).T
    shape = tuple(net.state_dict()[name].shape)
    if value.shape != shape:
        raise ModelError(f"{name} has shape {value.shape} in the model, {shape} in the network")
    return torch.from_numpy(np.array(value, dtype=np.float32))


def _factor(graph: Any, name: str, constants: set[str]) -> str:
    """Name of the constant whose product is added to the bias beside the weight ``name``."""
    bias = _PREFIX + name.removesuffix("weight") + "bias"
    made_by = {output: node for node in graph.node for output in node.output}
    for node in graph.node:
        if node.op_type != "Add" or bias not in node.input:
            continue
        for product in node.input:
            maker = made_by.get(product)
            if maker is not None and maker.op_type == "MatMul" and maker.input[1] in constants:
                return str(maker.input[1])
    raise ModelError(f"the model holds no {name}")

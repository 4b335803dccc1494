"""The card of a model file: what it is, what it wants, what it was made from, how good it is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gcar_deploy.models.spec import ModelFile


def model_card(model: ModelFile) -> list[str]:
    """Return the card for people, one line a fact."""
    spec = model.spec
    training = spec.get("training", {})
    centers = "Gaussian centre predictor"
    what = {
        "multi": f"{centers} (all views at once: which hull points are vessel)",
        "paper": f"{centers} (the paper's: one view at a time, a depth and an offset per cell)",
        "segmenter": "segmenter (which pixels are vessel, their chords, which lines are devices)",
    }[model.kind]
    out = [
        f"{model.name}: {what}",
        f"  SHA-256 {model.sha256}, as its spec says",
        f"  {spec.get('parameters', 0):,} parameters, {len(model.data):,} bytes, "
        f"{spec.get('precision', 'float32')}, opset {spec.get('opset')}, "
        f"IR {spec.get('ir_version')}",
        "  wants: " + ", ".join(f"{k} {v}" for k, v in model.inputs.items()),
        f"  answers: {', '.join(spec.get('outputs', ()))}",
        f"  cells or pixels of {_range(spec.get('spacing_mm'))} mm at the isocentre"
        + (f"; {spec['geometry']}" if "geometry" in spec else ""),
        f"  trained on: {_trained(training)}",
    ]
    if "devices" in training:
        out.append(f"  devices: trained on {_trained(training['devices'])}")
    for key, whose in (("labels", ""), ("labels_before", ", of its first weights")):
        for name, digest in (training.get(key) or {}).items():
            out.append(f"    label volume {name} {digest[:12]}{whose}")
    for kind, scores in _by_kind(training.get("validation", {})).items():
        shown = ", ".join(f"{key} {value:.3f}" for key, value in scores.items())
        out.append(f"  {kind}, generated and held out: {shown}")
    out.append(f"  licence: {spec.get('license', 'unknown')}")
    out.append("  Research use only. Not a medical device.")
    return out


def _trained(training: Mapping[str, Any]) -> str:
    seed = training.get("seed", training.get("options", {}).get("seed", "?"))
    return f"{training.get('data', 'unknown')}; seed {seed}, {training.get('step', '?')} steps"


def _by_kind(validation: Mapping[str, Any]) -> Mapping[str, Mapping[str, float]]:
    """Scores by the kind of scene; those of the segmenter have one kind alone."""
    plain = all(isinstance(score, float) for score in validation.values())
    return {"pictures": validation} if validation and plain else validation


def _range(value: Any) -> str:
    return f"{value[0]:g} .. {value[1]:g}" if isinstance(value, list) and len(value) == 2 else "any"

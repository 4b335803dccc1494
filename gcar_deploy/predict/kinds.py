"""What the centre predictors are given, and so what the spec of a fitting model must say."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gcar_deploy.config import ModelLimits
from gcar_deploy.models import Kind, ModelFile, read_model
from gcar_deploy.predict.center_map import DEPTH_PIXELS, MAX_PATH_PIXELS, OFFSET_PIXELS
from gcar_deploy.predict.encoding import LEVELS, VIEW_FEATURES


def _unfit_picture(inputs: Mapping[str, Any]) -> str:
    """Say which sizes of the single-view predictor's picture and cells make no sense."""
    for key, low, high in (("pixels", 16, 1024), ("alpha", 1, 64)):
        value = inputs.get(key)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            return (
                f"wants inputs.{key} = {value!r}; whole numbers in {low} .. {high} are understood"
            )
    if inputs["pixels"] % inputs["alpha"]:
        return "has inputs.pixels that is no multiple of inputs.alpha"
    if not isinstance(inputs.get("pose"), bool):
        return f"wants inputs.pose = {inputs.get('pose')!r}, not a bool"
    directions = inputs.get("directions_deg")
    if not isinstance(directions, list) or not all(map(_is_direction, directions)):
        return f"wants inputs.directions_deg = {directions!r}, not pairs of angles"
    return ""


def _is_direction(value: Any) -> bool:
    if not isinstance(value, list) or len(value) != 2:
        return False
    return all(isinstance(x, int | float) and not isinstance(x, bool) for x in value) and (
        abs(value[0]) <= 180 and abs(value[1]) <= 90
    )


#: all views at once: which points of the hull are vessel
MULTI = Kind("multi", "gcp-multi", {"view_features": VIEW_FEATURES, "levels": LEVELS})
#: the paper's: one view at a time, a depth and an offset per cell
PAPER = Kind(
    "paper",
    "gcp-paper",
    {
        "depth_pixels": DEPTH_PIXELS,
        "offset_pixels": OFFSET_PIXELS,
        "max_path_pixels": MAX_PATH_PIXELS,
    },
    _unfit_picture,
)
#: by the name of their kind
PREDICTOR_KINDS = {kind.name: kind for kind in (MULTI, PAPER)}


def read_predictor(path: Path, limits: ModelLimits | None = None) -> ModelFile:
    """Read and verify a centre predictor of either kind; see ``models.read_model``."""
    return read_model(path, tuple(PREDICTOR_KINDS.values()), limits)

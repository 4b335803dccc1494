"""Which points are vessel: the hull of all views, networks that know depth, the decision."""

from gcar_deploy.predict.center_predictor import (
    Predictor,
    load_predictor,
    missing_predictor,
    open_predictor,
)
from gcar_deploy.predict.centers import (
    Centers,
    Evidence,
    Seen,
    find_centers,
    quick_tree,
    seen_by_all,
)
from gcar_deploy.predict.hull import bilinear
from gcar_deploy.predict.kinds import PREDICTOR_KINDS, read_predictor

__all__ = [
    "PREDICTOR_KINDS",
    "Centers",
    "Evidence",
    "Predictor",
    "Seen",
    "bilinear",
    "find_centers",
    "load_predictor",
    "missing_predictor",
    "open_predictor",
    "quick_tree",
    "read_predictor",
    "seen_by_all",
]

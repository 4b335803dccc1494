"""Which points are vessel: the hull of all views, networks that know depth, the decision."""

from gcar_deploy.predict.center_predictor import Predictor, load_predictor, missing_predictor
from gcar_deploy.predict.centers import (
    Centers,
    Evidence,
    Seen,
    find_centers,
    quick_tree,
    seen_by_all,
)

__all__ = [
    "Centers",
    "Evidence",
    "Predictor",
    "Seen",
    "find_centers",
    "load_predictor",
    "missing_predictor",
    "quick_tree",
    "seen_by_all",
]

"""Quality: whether a tree can honestly be made, and how far to trust it."""

from gcar_deploy.quality.gates import (
    check_candidates,
    check_consistency,
    check_order,
    check_poses,
    check_tree,
    check_views,
    disagreement_limits,
    with_hint,
)
from gcar_deploy.quality.status import Quality, ViewQuality, judge, unexplained

__all__ = [
    "Quality",
    "ViewQuality",
    "check_candidates",
    "check_consistency",
    "check_order",
    "check_poses",
    "check_tree",
    "check_views",
    "disagreement_limits",
    "judge",
    "unexplained",
    "with_hint",
]

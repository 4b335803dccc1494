"""Quality: whether a tree can honestly be made, and how far to trust it."""

from gcar_deploy.quality.gates import (
    check_agreement,
    check_asked,
    check_candidates,
    check_consistency,
    check_motion,
    check_order,
    check_poses,
    check_tree,
    check_views,
    disagreement_limits,
    kind_of,
    with_hint,
)
from gcar_deploy.quality.ghost_figures import FIGURES
from gcar_deploy.quality.ghosts import (
    GHOST_MM,
    PROBABLE,
    GhostModel,
    ghost_share,
)
from gcar_deploy.quality.gravity import Part, Remark
from gcar_deploy.quality.scale import check_gross_scale
from gcar_deploy.quality.status import (
    OK,
    Quality,
    ViewQuality,
    check_explained,
    doubted,
    judge,
    part_lengths_mm,
    unexplained,
)
from gcar_deploy.quality.too_much import check_found, check_length

__all__ = [
    "FIGURES",
    "GHOST_MM",
    "OK",
    "PROBABLE",
    "GhostModel",
    "Part",
    "Quality",
    "Remark",
    "ViewQuality",
    "check_agreement",
    "check_asked",
    "check_candidates",
    "check_consistency",
    "check_explained",
    "check_found",
    "check_gross_scale",
    "check_length",
    "check_motion",
    "check_order",
    "check_poses",
    "check_tree",
    "check_views",
    "disagreement_limits",
    "doubted",
    "ghost_share",
    "judge",
    "kind_of",
    "part_lengths_mm",
    "unexplained",
    "with_hint",
]

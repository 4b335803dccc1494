"""Gates between ``ok``, ``degraded`` and ``refused``."""

from __future__ import annotations

import dataclasses
from typing import Annotated, TypeAlias

from gcar_deploy.config.ranges import Angle, Length, Range, Share

#: a disagreement, 0 .. 1; below 0 every pair exceeds it, above 1 none does
Gate: TypeAlias = Annotated[float, Range(-1, 2)]


@dataclasses.dataclass(frozen=True, kw_only=True)
class QualityOptions:
    """Gates between ``ok``, ``degraded`` and ``refused``."""

    #: best angle between two views, folded to 0 .. 90: depth errors are 1/sin of it times the
    #: errors in the picture, 11-fold at 5 deg (not worth having), 2.4-fold at 25 deg
    min_separation_deg: Angle = 5.0
    good_separation_deg: Angle = 25.0
    #: two views of one tree hold the same vessel mass in every epipolar plane; disagreement of
    #: the two profiles after the best shift, 0 (equal) .. 1 (disjoint). Nine simulated trees:
    #: 0.01 to 0.02 between path-length views of one tree, from 0.11 between those of two
    good_disagreement: Gate = 0.05
    max_disagreement: Gate = 0.09
    #: the same where vessels had to be found in raw pictures, which adds errors of its own: nine
    #: simulated raw pairs of one tree lie at 0.06 .. 0.12 (seven) and 0.23, 0.28; those of two
    #: trees at 0.16 .. 0.62. So above the first figure the finished tree decides: it leaves more
    #: than a tenth of the vessels of a view unexplained in eight of nine pairs of two trees, in
    #: none of one
    good_disagreement_raw: Gate = 0.15
    max_disagreement_raw: Gate = 0.6
    #: above this, nine of ten raw pairs of one tree (up to 0.28) are ruled out, and the largest
    #: part of each picture is asked alone: what else was found may be background
    parts_disagreement_raw: Gate = 0.35
    #: two pictures that disagree less with each other's geometry than this multiple of their own
    #: disagreement: nobody can say that they are not swapped; and where they are asked to be
    order_ratio: Annotated[float, Range(0, 1e3)] = 1.3
    swapped_ratio: Annotated[float, Range(0, 1e3)] = 0.75
    #: share of a view's skeleton that the reprojected tree explains
    good_coverage: Share = 0.9
    min_coverage: Share = 0.3
    #: share of the reprojected tree that lies on the view's vessels: at 0.99 and more
    #: in 49 generated trees (clinical views, exact and moved) that came out right
    good_support: Share = 0.95
    min_support: Share = 0.3
    #: how near counts, pixels of the picture, but at least so many mm at the isocentre: half a
    #: lattice cell is not an error
    near_px: Length = 2.0
    near_mm: Length = 1.0
    #: a larger estimated correction between the runs is no small matter of breath or table
    good_shift_mm: Length = 5.0
    good_turn_deg: Length = 1.5
    #: less tree than this is not a coronary tree
    min_length_mm: Length = 20.0

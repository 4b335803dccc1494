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
    #: frames of two runs whose score is less ahead of that of another heart phase may show two
    #: phases: ``gcar-export frame-pairs``
    good_frame_margin: Gate = 0.03
    #: The gates below were judged by ``gcar-export gate-table``: 24 generated trees to choose on,
    #: 24 others to check, then ten real ones to look at; each as pairs of one tree and as pairs
    #: that contradict each other (two trees, a wrong sign of an angle, swapped pictures). None of
    #: those is ``ok``. They stay where the first trees offered nothing that the others confirmed.
    #:
    #: Two views of one tree hold the same vessel mass in every epipolar plane; disagreement of
    #: the two profiles after the best correction, 0 (equal) .. 1 (disjoint). Exact path lengths:
    #: at most 0.003 between views of one tree, moved and turned ones among them, and from 0.069
    #: on where they contradict each other. The room between is for pictures less exact
    good_disagreement: Gate = 0.05
    max_disagreement: Gate = 0.09
    #: the same where vessels had to be found in raw pictures, which adds errors of its own: up to
    #: 0.19 in nine of ten pairs of one tree (real trees: 0.12), 0.13 and more where two trees or a
    #: wrong sign contradict each other (real: 0.149). So above the first figure the finished tree
    #: decides: it leaves more than a tenth of a view's vessels unexplained in 91 of 103
    #: contradictory pairs. Chosen on the first trees
    good_disagreement_raw: Gate = 0.18
    max_disagreement_raw: Gate = 0.6
    #: above this raw pictures are never ``ok``: two real trees were at 0.149. From 0.12 on it takes
    #: ``ok`` from no pair of one tree
    sure_disagreement_raw: Gate = 0.12
    #: the same of masks, which show the wider of two vessels that overlap: 0.07 to 0.28 between
    #: views of one tree. By the rule of ``gcar-export gate-table``
    good_disagreement_mask: Gate = 0.25
    max_disagreement_mask: Gate = 0.6
    #: above this lines that no other view shows are left out of raw pictures
    parts_disagreement_raw: Gate = 0.1
    #: two pictures that disagree less with each other's geometry than this multiple of their own
    #: disagreement: nobody can say that they are not swapped. Without it 5, 7 and 1 swapped raw
    #: pairs of 24, 24 and 10 would be ``ok``; it takes ``ok`` from 0, 0 and 1 pairs of one tree
    order_ratio: Annotated[float, Range(0, 1e3)] = 1.2
    #: the same of masks: right pairs agree as well the other way round more often than raw ones
    order_ratio_mask: Annotated[float, Range(0, 1e3)] = 1.0
    #: below this (and ``good_disagreement``) people are asked whether they swapped them: all
    #: swapped path lengths, 33 of 58 swapped raw pairs, one of 540 others
    swapped_ratio: Annotated[float, Range(0, 1e3)] = 0.75
    #: raw pictures that disagree by more than this are asked by the network alone, whose word is
    #: taken where they then disagree so many times less
    alone_disagreement_raw: Share = 0.1
    alone_ratio: Annotated[float, Range(1, 1000)] = 1.2
    #: share of what a view shows of vessel that the reprojected tree explains, by path length: less
    #: than nine tenths is worth a word whatever the costs say. By pixels, thin ends that lie below
    #: a lattice cell took ``ok`` from right trees
    good_coverage: Share = 0.9
    #: Three and more masks or raw pictures that agree poorly may be of one tree from this share on,
    #: by pixels of each view: what suits three pictures by chance is little
    enough_coverage: Share = 0.7
    min_coverage: Share = 0.3
    #: share of the reprojected tree that lies on the view's vessels: 0.94 and more in pairs of
    #: path lengths of one tree, but 0.6 and more in raw ones, whose masks are what two methods
    #: agree on. Chosen on the first trees, at the strict end of what is cheap there
    good_support: Share = 0.9
    min_support: Share = 0.3
    #: how near counts, pixels of the picture, but at least so many mm at the isocentre: half a
    #: lattice cell is not an error
    near_px: Length = 2.0
    near_mm: Length = 1.0
    #: share of a tree's length that is to be expected in ghosts; ``gcar-export status-table`` tells
    #: what it costs. With the present model 0.10 names as many bad trees as 0.125 did with the one
    #: before, and no more of the good: of generated pairs, and of the real ones looked at
    good_ghost_share: Share = 0.1
    #: share of a tree that lies elsewhere once the scene is turned (``second_look``). Of 27
    #: generated masks that were ``ok`` three were at 0.14 and more (F at 2 mm 76 to 89 %), two at
    #: 0.07 and 0.08 (91 and 93 %), all others at most at 0.065 (94 % and more)
    good_second_look: Share = 0.07
    #: a larger estimated correction between the runs is no small matter of breath or table
    good_shift_mm: Length = 5.0
    good_turn_deg: Length = 1.5
    #: a larger motion of the heart between the runs, beyond a shift (root mean square of what two
    #: exact views see of it), leaves a tree bent by a millimetre and more
    good_motion_mm: Length = 0.5
    #: A view asks for another angle or scale (``pose/significance.py``) where that lowers the
    #: disagreement to this share of what the best shift leaves, by so much at least, and the
    #: squared difference so many times. Chosen on generated raw and mask pairs
    asked_ratio: Share = 0.9
    asked_least: Share = 0.005
    asked_gain: Annotated[float, Range(1, 1e6)] = 1.3
    #: and the scale is off by more than this share; for the angle ``good_turn_deg`` holds
    good_scale: Share = 0.02
    #: less tree than this is not a coronary tree
    min_length_mm: Length = 20.0
    #: and more is none: generated trees of one side with all their twigs reach 1150 mm
    max_length_mm: Length = 1500.0

"""Options of the pose between the views."""

from __future__ import annotations

import dataclasses
from typing import Annotated

from gcar_deploy.config.ranges import Angle, Count, Length, Range, Scale, Share, Step


@dataclasses.dataclass(frozen=True, kw_only=True)
class PoseOptions:
    """Table or breath shift and angle error between views, from epipolar consistency."""

    enabled: bool = True
    #: priors, one standard deviation: how far a patient moves between runs, how well angles are
    #: read; a direction the pictures say nothing about stays at zero
    offset_sigma_mm: Scale = 3.0
    angle_sigma_deg: Scale = 0.7
    #: how well magnifications are known: an error looks like a patient moved along the beam
    magnification_sigma: Scale = 0.005
    #: first search along the direction that two views see best, mm
    search_mm: Annotated[float, Range(0, 200)] = 12.0
    step_mm: Annotated[float, Range(0.1, 100)] = 1.0
    #: smoothing of the mass profiles, mm at the isocentre
    coarse_mm: Annotated[float, Range(0.01, 100)] = 1.5
    fine_mm: Annotated[float, Range(0.01, 100)] = 0.5
    #: how well two profiles of the same tree agree, as a share of their norm
    profile_noise: Annotated[float, Range(1e-6, 1e3)] = 0.05
    #: ... and how well at best in calibrated pictures (see ``profile_fit``)
    calibrated_noise: Annotated[float, Range(1e-6, 1e3)] = 0.002
    #: calibrated pictures that agree so well as they are told are left alone: pixels, not poses
    agreed_calibrated: Share = 0.002
    #: directions further apart than this are not compared: see ``estimate_poses``
    most_apart_deg: Angle = 150.0
    #: three and more views: directions nearer than this tell nothing of each other; and from how
    #: many starts their offsets are sought together
    least_apart_deg: Angle = 10.0
    joint_starts: Annotated[int, Range(1, 10000)] = 60
    #: more views than this are corrected pair by pair alone; pairs that disagree by no more than
    #: this as they are told, are left alone (four views of one tree, exactly placed, pixels of
    #: 1.4 mm: up to 0.08)
    joint_most_views: Annotated[int, Range(2, 16)] = 4
    agreed: Share = 0.09
    #: how well a person marks the same point in two views, mm at the isocentre
    landmark_sigma_mm: Scale = 0.5
    #: a correction must lower the disagreement to this share of what it was
    min_gain: Share = 0.85
    max_evaluations: Annotated[int, Range(1, 100_000)] = 40


@dataclasses.dataclass(frozen=True, kw_only=True)
class BundleOptions:
    """Offsets of three and more views from the tree they show (``pose/bundle_adjustment.py``)."""

    #: a tree and its views' poses are fitted to each other at most so often
    rounds: Annotated[int, Range(0, 100)] = 2
    #: breath and table: scale of the offset's prior, whose tails are heavy (Cauchy)
    offset_scale_mm: Scale = 3.0
    angle_sigma_deg: Scale = 0.7
    #: one standard deviation of a picture's centreline (neighbours err alike, so this is more
    #: than a single point's error), and of a point's step
    line_sigma_mm: Scale = 1.0
    point_sigma_mm: Scale = 2.0
    #: how well a person marks the same point in two views, mm at the isocentre
    landmark_sigma_mm: Scale = 0.5
    #: a picture's line counts for a point within this reach, which shrinks to the second
    reach_mm: Scale = 8.0
    near_mm: Scale = 2.0
    steps: Count = 25
    #: points of the tree this far apart, and how few say nothing
    spacing_mm: Step = 2.0
    least_points: Count = 20
    #: a tree that lies this near to all lines, in pixels, is left alone (16 generated scenes, moved
    #: and corrected by profiles: 0.2 .. 0.5); else the distance must fall to a share of what it was
    least_px: Length = 0.6
    min_gain: Share = 0.85

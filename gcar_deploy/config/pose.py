"""Options of the pose between the views."""

from __future__ import annotations

import dataclasses
from typing import Annotated

from gcar_deploy.config.ranges import Range


@dataclasses.dataclass(frozen=True, kw_only=True)
class PoseOptions:
    """Table or breath shift and angle error between views, from epipolar consistency."""

    enabled: bool = True
    #: smoothing of the mass profiles, mm at the isocentre
    coarse_mm: Annotated[float, Range(0.01, 100)] = 1.5
    fine_mm: Annotated[float, Range(0.01, 100)] = 0.5

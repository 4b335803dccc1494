"""What the stages of a reconstruction hand on, for whoever wants to watch."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from gcar_deploy.geometry.own_frame import OwnFrame
from gcar_deploy.imaging.vessels import Vessels
from gcar_deploy.pose import Registered
from gcar_deploy.predict import Centers, Seen
from gcar_deploy.tubes import Refined

#: in their order; all but the first are in the coordinates of that frame
Step: TypeAlias = OwnFrame | Vessels | Registered | Seen | Centers | Refined
OnStep: TypeAlias = Callable[[Step], None]

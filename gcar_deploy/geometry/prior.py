"""How far the geometry of a scene may be off, one standard deviation each; stated once.

Between two runs the table moves and the patient breathes, angles are read to a part of a degree,
and magnifications are known to some thousandths. Pose, bundle adjustment and the stated sigma of
the tree take it from here.
"""

from __future__ import annotations

#: how far a patient moves between runs, mm, and how well angles are read; a direction the pictures
#: say nothing about stays at zero
OFFSET_MM = 3.0
ANGLE_DEG = 0.7
#: share by which magnifications are off: it looks like a patient moved along the beam
MAGNIFICATION = 0.005
#: how well a person marks the same point in two views, mm at the isocentre
LANDMARK_MM = 0.5
#: what is left of offset and angle where the pictures have corrected them
LEFT_MM = 0.5
LEFT_DEG = 0.5

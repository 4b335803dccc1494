"""What is measured of a finished tree: inlets, lumen, names, angles, the view to take next."""

from gcar_deploy.measure.bridges import joined_over_lesions
from gcar_deploy.measure.inlet import from_inlets, idle_ostia, thin_ostia
from gcar_deploy.measure.lumen_tree import lumen_tree
from gcar_deploy.measure.measured import Measured, measured
from gcar_deploy.measure.naming import BranchName
from gcar_deploy.measure.sections import Sections, measure_sections, with_diameters
from gcar_deploy.measure.signals import read_signal

__all__ = [
    "BranchName",
    "Measured",
    "Sections",
    "from_inlets",
    "idle_ostia",
    "joined_over_lesions",
    "lumen_tree",
    "measure_sections",
    "measured",
    "read_signal",
    "thin_ostia",
    "with_diameters",
]

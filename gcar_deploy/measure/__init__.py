"""What is measured of a finished tree: inlets, lumen, names, angles, the view to take next."""

from gcar_deploy.measure.inlet import from_inlets
from gcar_deploy.measure.measured import Measured, measured
from gcar_deploy.measure.naming import BranchName

__all__ = ["BranchName", "Measured", "from_inlets", "measured"]

"""Pressure drop at an assumed flow, as an interval; and the same tree for a 0D solver."""

from gcar_deploy.flow.assumption import Assumption
from gcar_deploy.flow.model_0d import model_0d
from gcar_deploy.flow.pressure import PressureDrop, VesselPressure, doubts_of, pressure_drop
from gcar_deploy.flow.table import pressure_table

__all__ = [
    "Assumption",
    "PressureDrop",
    "VesselPressure",
    "doubts_of",
    "model_0d",
    "pressure_drop",
    "pressure_table",
]

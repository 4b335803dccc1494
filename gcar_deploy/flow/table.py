"""Pressure drop as plain values: the table of result.json, the report and ``gcar flow``."""

from __future__ import annotations

import math
from typing import Any

from gcar_deploy.flow.pressure import PressureDrop, VesselPressure


def pressure_table(drop: PressureDrop) -> dict[str, Any]:
    """Return the table.

    Values that are withheld are None; ``withheld`` of their branch says why, and is empty for the
    others. An interval holds the stated share of cases, ``coverage``.
    """
    assumed = drop.assumed
    return {
        "index": "Pd/Pa",
        "sentence": assumed.sentence(),
        "velocity_m_s": assumed.velocity_m_s if assumed.flow_ml_min is None else None,
        "inlet_flow_ml_min": drop.inlet_flow_ml_min,
        "flow_sigma": assumed.relative_flow_sigma,
        "split_exponent": assumed.split_exponent,
        "split_sigma": assumed.split_sigma,
        "aortic_pressure_mmhg": assumed.aortic_pressure_mmhg,
        "density_kg_m3": assumed.density_kg_m3,
        "viscosity_pa_s": assumed.viscosity_pa_s,
        "coverage": assumed.coverage,
        "samples": assumed.samples,
        "seed": assumed.seed,
        "branches": [
            {"branch": number, **_row(vessel)} for number, vessel in enumerate(drop.vessels, 1)
        ],
    }


def _row(vessel: VesselPressure) -> dict[str, Any]:
    """One branch; pressures at its far end."""
    told = not vessel.withheld
    ratio, low, high = vessel.end
    return {
        "from_mm": float(vessel.arc_mm[0]),
        "to_mm": float(vessel.arc_mm[-1]),
        "flow_ml_min": vessel.flow_ml_min if math.isfinite(ratio) else None,
        "pd_pa": ratio if told else None,
        "interval": [low, high] if told else None,
        "interval_diameter": list(vessel.from_diameter) if told else None,
        "interval_flow": list(vessel.from_flow) if told else None,
        "drop_mmhg": vessel.drop_mmhg if told else None,
        "withheld": vessel.withheld,
    }

"""What the pressure drop takes for granted: blood, aortic pressure, hyperaemic flow, its split."""

from __future__ import annotations

import dataclasses
import math

from gcar_deploy.errors import UsageError

PA_PER_MMHG = 133.322
#: m^3/s of 1 ml/min
M3_S_PER_ML_MIN = 1e-6 / 60.0
#: coefficient of the loss at an expansion (Young and Tsai, J Biomech 6:547, 1973)
EXPANSION_LOSS = 1.52
#: widest interval of Pd/Pa with which a value is still given
MOST_WIDTH = 0.1
#: between patients, where the flow is not measured: a guess, and on the low side
_FLOW_SIGMA = 0.2
_RANGES = {
    "velocity_m_s": (0.01, 3.0), "flow_ml_min": (1.0, 2000.0),
    "aortic_pressure_mmhg": (20.0, 250.0), "flow_sigma": (0.0, 1.0),
}  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class Assumption:
    """Boundary conditions and constants.

    Attributes
    ----------
    velocity_m_s : mean velocity at the inlet in hyperaemia (0.35: fixed-flow quantitative flow
        ratio, Tu et al., JACC Cardiovasc Interv 9:2024, 2016); not used where the flow is given
    flow_ml_min : flow through all inlets together, ml/min; None takes the velocity
    aortic_pressure_mmhg : mean pressure Pa at the inlet, mmHg
    flow_sigma : relative standard deviation of the inlet flow; None takes 0.2 with a velocity,
        0 with a given flow
    inlet_exponent, split_exponent : flow goes by diameter to these powers (Taylor et al., Front
        Physiol 13:871912, 2022), between several inlets and at a bifurcation
    split_sigma : standard deviation of the log of what a branch draws beside its sisters: patients
        differ, and branches are missed or made up
    density_kg_m3, viscosity_pa_s : blood, Newtonian
    coverage : share of cases that an interval is to hold
    samples, seed : of the Monte Carlo run
    """

    velocity_m_s: float = 0.35
    flow_ml_min: float | None = None
    aortic_pressure_mmhg: float = 90.0
    flow_sigma: float | None = None
    inlet_exponent: float = 2.15
    split_exponent: float = 2.38
    split_sigma: float = 0.5
    density_kg_m3: float = 1060.0
    viscosity_pa_s: float = 0.0035
    coverage: float = 0.9
    samples: int = 200
    seed: int = 0

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if value is None:
                continue
            if not (math.isfinite(value) and low <= value <= high):
                raise UsageError(f"{name} = {value:g} is not within {low:g} .. {high:g}")

    @property
    def relative_flow_sigma(self) -> float:
        """Relative standard deviation of the inlet flow."""
        if self.flow_sigma is not None:
            return self.flow_sigma
        return _FLOW_SIGMA if self.flow_ml_min is None else 0.0

    @property
    def aortic_pressure_pa(self) -> float:
        """Pressure at the inlet, Pa."""
        return self.aortic_pressure_mmhg * PA_PER_MMHG

    def sentence(self) -> str:
        """Say what was assumed, for people."""
        flow = (
            f"mean velocity {self.velocity_m_s:g} m/s at the inlet"
            if self.flow_ml_min is None
            else f"{self.flow_ml_min:g} ml/min at the inlet"
        )
        return (
            f"Assumed: {flow} (SD {self.relative_flow_sigma:.0%}), split by diameter^"
            f"{self.split_exponent:g} (SD of a share {self.split_sigma:.0%}), Pa "
            f"{self.aortic_pressure_mmhg:g} mmHg, rigid round vessels, steady flow. Not measured; "
            "not a fractional flow reserve. Where a branch is missed or joined wrongly, flow and "
            "loss at a narrowing may be several times another, outside the interval."
        )

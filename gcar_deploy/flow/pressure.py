"""Pd/Pa along each vessel, with an interval, or the reason why there is none.

Pd/Pa is pressure at a place over pressure at the inlet, at an assumed hyperaemic flow. It is no
fractional flow reserve: nothing of flow or pressure is measured.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from gcar_deploy.flow.assumption import (
    M3_S_PER_ML_MIN,
    MOST_WIDTH,
    PA_PER_MMHG,
    Assumption,
)
from gcar_deploy.flow.hydraulics import expansion_loss, expansions, piece_resistance
from gcar_deploy.flow.network import Network, flows, network_of, own_flows
from gcar_deploy.flow.spread import Draws, draw
from gcar_deploy.measure.lumen import BranchLumen
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Scalars

Interval = tuple[float, float]
#: flow by the split over its flow by the own calibre, or the reverse, with which a value is given
MOST_UNLIKE = 3.0


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class VesselPressure:
    """One branch.

    Attributes
    ----------
    arc_mm : (m,) distance of its points from the ostium
    ratio : (m,) Pd/Pa there; NaN where no flow can be told
    low, high : (m,) ends of the interval
    from_diameter, from_flow : interval at the far end, from either cause alone
    flow_m3_s : through it
    drop_pa : from its inlet to its far end
    withheld : why no value is given; empty where one is
    doubtful : nothing is told of any point, whatever the interval: tree, flow or result are in
        doubt
    """

    arc_mm: Scalars
    ratio: Scalars
    low: Scalars
    high: Scalars
    from_diameter: Interval
    from_flow: Interval
    flow_m3_s: float
    drop_pa: float
    withheld: str
    doubtful: bool

    @property
    def flow_ml_min(self) -> float:
        """Flow through it, ml/min."""
        return self.flow_m3_s / M3_S_PER_ML_MIN

    @property
    def drop_mmhg(self) -> float:
        """Pressure lost in it, mmHg."""
        return self.drop_pa / PA_PER_MMHG

    @property
    def end(self) -> tuple[float, float, float]:
        """Pd/Pa at the far end, and the ends of its interval."""
        return float(self.ratio[-1]), float(self.low[-1]), float(self.high[-1])

    @property
    def told(self) -> Array:
        """(m,) bool: points at which the interval is narrow enough for a value to be shown."""
        narrow = self.high - self.low <= MOST_WIDTH
        return np.zeros_like(narrow) if self.doubtful else narrow


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PressureDrop:
    """Pd/Pa of a tree: per branch, in its order."""

    assumed: Assumption
    network: Network
    vessels: tuple[VesselPressure, ...]

    @property
    def inlet_flow_ml_min(self) -> float:
        """Flow through all inlets, ml/min."""
        return sum(self.vessels[k].flow_ml_min for k in self.network.roots)


def pressure_drop(
    tree: Tree,
    lumens: Sequence[BranchLumen],
    assumed: Assumption | None = None,
    doubts: Mapping[int, str] | None = None,
    names: Sequence[str | None] = (),
) -> PressureDrop:
    """Work out Pd/Pa.

    Parameters
    ----------
    tree : Tree, mm, branches from their inlets (``measure.inlet``)
    lumens : its branches' lumens, with a section at each point (``measure.lumen_tree``)
    assumed : Assumption; None takes the usual one
    doubts : branch -> why nothing may be said of it and of what lies behind it
    names : of its branches, which tell a second artery from a piece that was torn off
    """
    assumed = assumed or Assumption()
    network = network_of(tree, lumens, names)
    if not tree.branches:
        return PressureDrop(assumed=assumed, network=network, vessels=())
    rng = np.random.default_rng(assumed.seed)
    draws = draw(tree, lumens, assumed.samples, rng)
    # A log-normal flow whose median is the flow assumed.
    scale = np.exp(rng.standard_normal(assumed.samples) * np.log1p(assumed.relative_flow_sigma))
    shape = assumed.samples, len(tree.branches)
    share = np.exp(rng.standard_normal(shape) * np.log1p(assumed.split_sigma))
    model = _Model(tree, network, assumed)
    still = model.still
    one = np.ones(shape)
    cases = {
        "nominal": model.ratios(still, one[:1, 0], one[:1]),
        "diameter": model.ratios(draws, one[:, 0], one),
        "flow": model.ratios(still, scale, share),
        "both": model.ratios(draws, scale, share),
    }
    return PressureDrop(
        assumed=assumed, network=network, vessels=_vessels(tree, model, cases, doubts or {})
    )


def doubts_of(
    status: str, branches: int, ghosts: Mapping[int, float] | None = None
) -> dict[int, str]:
    """Say of which branches nothing may be told.

    Parameters
    ----------
    status : of the result; nothing is told of a degraded one
    branches : how many there are
    ghosts : branch -> probability that it is one
    """
    if status == "degraded":
        return dict.fromkeys(range(branches), "the tree is degraded")
    return {k: f"it is a ghost with probability {p:.2f}" for k, p in (ghosts or {}).items()}


class _Model:
    """A tree made ready for many draws at once."""

    def __init__(self, tree: Tree, network: Network, assumed: Assumption) -> None:
        self.network, self.assumed = network, assumed
        self.radius_mm, self.owner = tree.radii(), tree.branch_index()
        self.length_mm = np.linalg.norm(np.diff(tree.points(), axis=0), axis=1)
        # From one branch to the next there is no vessel.
        self.length_mm[np.diff(self.owner) > 0] = 0.0
        sizes = [len(branch) for branch in tree.branches]
        #: the tree as it was measured
        self.still = Draws(points=np.zeros((1, sum(sizes))), branches=np.zeros((1, len(sizes))))
        self.last = np.cumsum(sizes) - 1
        self.first = self.last - np.array(sizes) + 1
        self.expansions = [
            (k, self.first[k] + e.throat, self.first[k] + e.behind)
            for k, branch in enumerate(tree.branches)
            for e in expansions(branch.radius_mm)
        ]

    def flows(self, draws: Draws, scale: Array, share: Array) -> Array:
        """(s, branches) flow in each draw, m^3 / s."""
        calibre = self.network.calibre_mm * np.exp(draws.branches)
        calibre = np.broadcast_to(calibre, share.shape)
        draw = share * self.network.draw
        return flows(self.network, calibre, draw, self.assumed) * scale[:, None]

    def losses(self, draws: Draws, flow: Array) -> Array:
        """(s, points) pressure lost since the inlet of each point's branch, Pa."""
        radius = self.radius_mm * np.exp(draws.points)
        own = flow[:, self.owner]
        step = np.zeros(own.shape)
        piece = piece_resistance(radius, self.length_mm, self.assumed.viscosity_pa_s)
        step[:, 1:] = piece * own[:, 1:]
        for k, throat, behind in self.expansions:
            S = expansion_loss(radius[:, throat], radius[:, behind], self.assumed.density_kg_m3)
            length = self.length_mm[throat:behind]
            share = length / max(length.sum(), 1e-9)
            # Lost in the jet on its way from the throat to where the vessel is wide again.
            step[:, throat + 1 : behind + 1] += (S * flow[:, k] ** 2)[:, None] * share
        total = np.cumsum(step, axis=1)
        return total - total[:, self.first[self.owner]]

    def ratios(self, draws: Draws, scale: Array, share: Array) -> Array:
        """(s, points) Pd/Pa; NaN in branches left out."""
        flow = self.flows(draws, scale, share)
        lost = self.losses(draws, flow)
        before = np.full(flow.shape, np.nan)
        for k in self.network.order:
            above = self.network.parent[k]
            before[:, k] = 0.0 if above is None else before[:, above] + lost[:, self.last[above]]
        out: Array = 1.0 - (before[:, self.owner] + lost) / self.assumed.aortic_pressure_pa
        return out


def _vessels(
    tree: Tree, model: _Model, cases: Mapping[str, Array], doubts: Mapping[int, str]
) -> tuple[VesselPressure, ...]:
    assumed, network = model.assumed, model.network
    tail = 0.5 * (1.0 - assumed.coverage)
    low, high = np.quantile(cases["both"], [tail, 1.0 - tail], axis=0)
    ends = {
        name: np.quantile(cases[name][:, model.last], [tail, 1.0 - tail], axis=0)
        for name in ("diameter", "flow")
    }
    flow = model.flows(model.still, np.ones(1), np.ones((1, len(tree.branches))))[0]
    nominal = cases["nominal"][0]
    own_flow = own_flows(network, network.calibre_mm, flow, assumed)
    inherited = {**_unlike(flow, own_flow), **doubts}
    for k in network.order:
        above = network.parent[k]
        if above is not None and above in inherited and k not in inherited:
            inherited[k] = f"branch {above + 1} before it: {inherited[above]}"
    out = []
    for k, branch in enumerate(tree.branches):
        own = slice(model.first[k], model.last[k] + 1)
        ratio = nominal[own]
        doubt = network.left_out.get(k) or inherited.get(k, "")
        out.append(
            VesselPressure(
                arc_mm=network.from_mm[k] + branch.arc_mm,
                ratio=ratio, low=low[own], high=high[own],
                from_diameter=(float(ends["diameter"][0, k]), float(ends["diameter"][1, k])),
                from_flow=(float(ends["flow"][0, k]), float(ends["flow"][1, k])),
                flow_m3_s=float(flow[k]),
                drop_pa=float((ratio[0] - ratio[-1]) * assumed.aortic_pressure_pa),
                withheld=doubt
                or _too_much(float(ratio[-1]), float(low[own][-1]), float(high[own][-1]), assumed),
                doubtful=bool(doubt),
            )
        )  # fmt: skip
    return tuple(out)


def _unlike(split: Array, own: Array) -> dict[int, str]:
    """Branches whose flow hangs on what else was found, and why nothing is told of them."""
    return {
        k: f"the flow hangs on the branches found beside it: {a / M3_S_PER_ML_MIN:.0f} ml/min by "
        f"the split, {b / M3_S_PER_ML_MIN:.0f} by its own calibre"
        for k, (a, b) in enumerate(zip(split, own, strict=True))
        if max(a, b) > MOST_UNLIKE * min(a, b) > 0
    }


def _too_much(ratio: float, low: float, high: float, assumed: Assumption) -> str:
    """Why an end value is not given; empty where it is."""
    if ratio <= 0.0:
        return "the assumed flow would need more than the aortic pressure"
    if high - low > MOST_WIDTH:
        return (
            f"the {assumed.coverage:.0%} interval {max(low, 0.0):.2f} .. {high:.2f} is wider than "
            f"{MOST_WIDTH:g}"
        )
    return ""

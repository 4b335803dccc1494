"""The same tree as an input of svZeroDSolver (SimVascular): JSON, cgs units.

Each branch is cut at the wide places behind its narrowings, ``branch3_seg0`` and so on by the
number of every other file, so that a solver tells the pressure between lesions. A flow enters at
the inlet; each outlet is a resistance to 0 mmHg that passes the assumed flow at its pressure.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from gcar_deploy.errors import UsageError
from gcar_deploy.flow.hydraulics import expansion_loss, expansions, piece_resistance
from gcar_deploy.flow.pressure import PressureDrop
from gcar_deploy.tree.tree import Branch, Tree

#: 1 Pa s / m^3 in dyn s / cm^5, 1 Pa s^2 / m^6 in dyn s^2 / cm^8, 1 Pa in dyn / cm^2
_R_CGS, _S_CGS = 1e-5, 1e-11
_ML_S = 1e6


def model_0d(tree: Tree, drop: PressureDrop) -> dict[str, Any]:
    """Return the content of ``model_0d.json``.

    Parameters
    ----------
    tree : Tree that ``drop`` was worked out of
    drop : PressureDrop

    Raises
    ------
    UsageError
        The tree has no branch, or the assumed flow would need more than the aortic pressure.
    """
    network = drop.network
    if not network.order:
        raise UsageError("a tree without a branch makes no 0D model")
    vessels: list[dict[str, Any]] = []
    conditions: list[dict[str, Any]] = []
    ends: dict[int, tuple[int, int]] = {}
    for k in network.order:
        pieces = _pieces(tree.branches[k], k, drop)
        for piece in pieces:
            piece["vessel_id"] = len(vessels)
            vessels.append(piece)
        ends[k] = (pieces[0]["vessel_id"], pieces[-1]["vessel_id"])
    for number, k in enumerate(network.roots, start=1):
        name = f"INFLOW_{number}" if len(network.roots) > 1 else "INFLOW"
        flow = drop.vessels[k].flow_m3_s * _ML_S
        conditions.append(_condition(name, "FLOW", {"Q": [flow, flow], "t": [0.0, 1.0]}))
        vessels[ends[k][0]].setdefault("boundary_conditions", {})["inlet"] = name
    for number, k in enumerate(network.outlets, start=1):
        vessel = drop.vessels[k]
        pressure = float(vessel.ratio[-1]) * drop.assumed.aortic_pressure_pa
        if pressure <= 0.0:
            raise UsageError(
                f"no 0D model: in branch {k + 1} the assumed flow would need more than the aortic "
                "pressure; lower --velocity or --flow"
            )
        R = pressure / vessel.flow_m3_s * _R_CGS
        name = f"OUTLET_{number}"
        conditions.append(_condition(name, "RESISTANCE", {"R": R, "Pd": 0.0}))
        vessels[ends[k][1]].setdefault("boundary_conditions", {})["outlet"] = name
    return {
        "description": {"made by": "gcar", "units": "cgs", "assumed": drop.assumed.sentence()},
        "simulation_parameters": {
            "number_of_cardiac_cycles": 2, "number_of_time_pts_per_cardiac_cycle": 5,
            "density": drop.assumed.density_kg_m3 * 1e-3,
            "viscosity": drop.assumed.viscosity_pa_s * 10.0,
        },
        "boundary_conditions": conditions,
        "junctions": _junctions(drop, ends),
        "vessels": vessels,
    }  # fmt: skip


def _pieces(branch: Branch, number: int, drop: PressureDrop) -> list[dict[str, Any]]:
    """Vessels of one branch, cut behind each narrowing."""
    found = expansions(branch.radius_mm)
    cuts = [0, *(e.behind for e in found if e.behind < len(branch) - 1), len(branch) - 1]
    length = np.linalg.norm(np.diff(branch.points_mm, axis=0), axis=1)
    R = piece_resistance(branch.radius_mm, length, drop.assumed.viscosity_pa_s)
    out = []
    for k, (a, b) in enumerate(itertools.pairwise(cuts)):
        S = sum(
            float(expansion_loss(branch.radius_mm[e.throat], branch.radius_mm[e.behind],
                                 drop.assumed.density_kg_m3))
            for e in found if a < e.behind <= b
        )  # fmt: skip
        out.append(
            {
                "vessel_name": f"branch{number + 1}_seg{k}",
                "vessel_length": float(length[a:b].sum()) * 0.1,
                "zero_d_element_type": "BloodVessel",
                "zero_d_element_values": {
                    "R_poiseuille": float(R[a:b].sum()) * _R_CGS,
                    "stenosis_coefficient": S * _S_CGS,
                },
            }
        )
    return out


def _junctions(drop: PressureDrop, ends: dict[int, tuple[int, int]]) -> list[dict[str, Any]]:
    pairs: list[tuple[int, list[int]]] = []
    for k in drop.network.order:
        first, last = ends[k]
        pairs += [(v, [v + 1]) for v in range(first, last)]
        below = [ends[child][0] for child in drop.network.children[k]]
        if below:
            pairs.append((last, below))
    return [
        {
            "junction_name": f"J{number}", "junction_type": "NORMAL_JUNCTION",
            "inlet_vessels": [above], "outlet_vessels": below,
        }
        for number, (above, below) in enumerate(pairs)
    ]  # fmt: skip


def _condition(name: str, kind: str, values: dict[str, Any]) -> dict[str, Any]:
    return {"bc_name": name, "bc_type": kind, "bc_values": values}

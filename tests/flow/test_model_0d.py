"""svZeroDSolver on its own published cases, and on our trees: an oracle that is not ours."""

from __future__ import annotations

import pytest

from gcar_deploy.errors import UsageError
from gcar_deploy.flow import model_0d
from gcar_deploy.measure import from_inlets
from tests.flow.trees import drop_of, solved, stenosed, stenosed_fork
from tests.measure.test_naming import left_tree


def vessel(number, resistance, stenosis=0.0, **ends):
    return {
        "boundary_conditions": ends, "vessel_id": number, "vessel_length": 10.0,
        "vessel_name": f"branch{number}_seg0", "zero_d_element_type": "BloodVessel",
        "zero_d_element_values": {
            "R_poiseuille": resistance, "stenosis_coefficient": stenosis
        },
    }  # fmt: skip


def outlet(name):
    return {"bc_name": name, "bc_type": "RESISTANCE", "bc_values": {"Pd": 100.0, "R": 100.0}}


INFLOW = {"bc_name": "INFLOW", "bc_type": "FLOW", "bc_values": {"Q": [5.0, 5.0], "t": [0.0, 1.0]}}
STEPS = {"number_of_cardiac_cycles": 2, "number_of_time_pts_per_cardiac_cycle": 5}


def test_the_solver_on_its_published_stenosis():
    """svZeroDSolver's case steadyFlow_stenosis_R: 3600 in, 600 out, by its own analysis."""
    found = solved({
        "simulation_parameters": STEPS, "boundary_conditions": [INFLOW, outlet("OUT")],
        "vessels": [vessel(0, 100.0, 100.0, inlet="INFLOW", outlet="OUT")],
    })  # fmt: skip
    assert found["branch0_seg0"] == pytest.approx((5.0, 3600.0, 600.0), rel=1e-6)
    # The law of ours, dp = R Q + S Q |Q|, says the same.
    assert 600.0 + 100.0 * 5.0 + 100.0 * 5.0**2 == 3600.0


def test_the_solver_on_its_published_bifurcation():
    """Its case steadyFlow_bifurcationR_R1: 1100 at the inlet, 600 at the junction, 350 out."""
    found = solved({
        "simulation_parameters": STEPS,
        "boundary_conditions": [INFLOW, outlet("OUT1"), outlet("OUT2")],
        "junctions": [{"inlet_vessels": [0], "junction_name": "J0", "outlet_vessels": [1, 2],
                       "junction_type": "NORMAL_JUNCTION"}],
        "vessels": [vessel(0, 100.0, inlet="INFLOW"), vessel(1, 100.0, outlet="OUT1"),
                    vessel(2, 100.0, outlet="OUT2")],
    })  # fmt: skip
    assert found["branch0_seg0"] == pytest.approx((5.0, 1100.0, 600.0), rel=1e-6)
    assert found["branch1_seg0"] == pytest.approx((2.5, 600.0, 350.0), rel=1e-6)


@pytest.mark.parametrize(
    "tree", [stenosed(60.0), stenosed_fork(60.0), from_inlets(left_tree())], ids=str.__class__
)
def test_the_solver_agrees_on_our_trees(tree):
    drop = drop_of(tree)
    found = solved(model_0d(tree, drop))
    for k in drop.network.order:
        own = drop.vessels[k]
        pieces = [name for name in found if name.startswith(f"branch{k + 1}_seg")]
        pascal = 10 * drop.assumed.aortic_pressure_pa * own.ratio
        assert found[pieces[0]][0] == pytest.approx(own.flow_m3_s * 1e6, rel=0.01)
        assert found[pieces[0]][1] == pytest.approx(pascal[0], rel=0.01)
        assert found[pieces[-1]][2] == pytest.approx(pascal[-1], rel=0.01)


def test_pieces_end_behind_the_narrowing():
    tree = stenosed(60.0)
    content = model_0d(tree, drop_of(tree))
    names = [v["vessel_name"] for v in content["vessels"]]
    assert names == ["branch1_seg0", "branch1_seg1"]
    loss = [v["zero_d_element_values"]["stenosis_coefficient"] for v in content["vessels"]]
    assert loss[0] > 0 and loss[1] == 0
    assert sum(v["vessel_length"] for v in content["vessels"]) == pytest.approx(6.0)


def test_an_impossible_flow_makes_no_model():
    tree = stenosed(85.0)
    with pytest.raises(UsageError, match="aortic pressure"):
        model_0d(tree, drop_of(tree))

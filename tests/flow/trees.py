"""Trees whose pressure can be worked out by hand, and a solver that is not ours."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.flow import pressure_drop
from gcar_deploy.measure.lumen import tree_lumens
from gcar_deploy.tree.tree import Branch, Tree
from tests.tree.shapes import branch, fork

#: blood as the room takes it
MU, RHO, MMHG = 0.0035, 1060.0, 133.322


def drop_of(tree, **assumed):
    from gcar_deploy.flow import Assumption

    return pressure_drop(tree, tree_lumens(tree), Assumption(**assumed))


def straight(radius_mm, length_mm=60.0):
    """One branch along x."""
    radius = np.atleast_1d(np.asarray(radius_mm, float))
    count = len(radius) if len(radius) > 1 else 61
    points = np.zeros((count, 3))
    points[:, 0] = np.linspace(0, length_mm, count)
    return Tree(nodes_mm=points[[0, -1]], branches=(branch(points, radius),))


def stenosed(percent=60.0, healthy_mm=1.5, width_mm=5.0, length_mm=60.0, count=241):
    """One branch with a raised cosine in its middle."""
    s = np.linspace(0, length_mm, count)
    off = np.clip(np.abs(s - length_mm / 2) / width_mm, 0, 1)
    return straight(healthy_mm * (1 - percent / 100 * 0.5 * (1 + np.cos(np.pi * off))), length_mm)


def stenosed_fork(percent=60.0):
    """Trunk and two daughters, the first with a narrowing."""
    tree = fork()
    trunk, left, right = (_fine(b) for b in tree.branches)
    s = left.arc_mm / left.length_mm
    off = np.clip(np.abs(s - 0.5) / 0.2, 0, 1)
    narrow = left.radius_mm * (1 - percent / 100 * 0.5 * (1 + np.cos(np.pi * off)))
    left = dataclasses.replace(left, radius_mm=narrow)
    return dataclasses.replace(tree, branches=(trunk, left, right))


def _fine(own: Branch) -> Branch:
    at = np.linspace(0, own.length_mm, 81)
    points = np.stack([np.interp(at, own.arc_mm, c) for c in own.points_mm.T], axis=1)
    return branch(points, np.interp(at, own.arc_mm, own.radius_mm), own.start, own.end)


def solver():
    return pytest.importorskip("svzerod", reason="needs svzerod (gcar[test])")


def solved(content):
    """Last time step of svZeroDSolver, by vessel: (flow, pressure in, pressure out), cgs."""
    found = solver().simulate(content)
    last = found[found["time"] == found["time"].max()]
    return {
        row["name"]: (row["flow_in"], row["pressure_in"], row["pressure_out"])
        for _, row in last.iterrows()
    }

"""What flow solvers take: open surface with caps, centreline, 0D model, and the pressure table.

====================== ==========================================================================
``surface_open.vtp``   wall and flat caps; ``ModelFaceID`` (SimVascular) and ``FaceName`` per cell
``surface_open.stl``   the same as one named solid a face, for snappyHexMesh and others
``centerline.vtp``     tracts with the arrays of VMTK's branch extractor
``model_0d.json``      input of svZeroDSolver
``pressure.json``      the table, and what is known of the surface
``pressure.svg``       Pd/Pa against mm from the ostium
====================== ==========================================================================

Face ``outlet-3`` of the surface is ``OUTLET_3`` of the 0D model and centreline 2 of the tracts.
Parts that are not joined to an artery's inlet are left out.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from gcar_deploy.errors import UsageError
from gcar_deploy.flow import PressureDrop, model_0d, pressure_table
from gcar_deploy.output.folder import write_folder
from gcar_deploy.output.pressure_plot import pressure_svg
from gcar_deploy.output.tracts import tracts_vtp
from gcar_deploy.output.vtp import triangle_data
from gcar_deploy.plain import plain
from gcar_deploy.tree.open_surface import End, OpenSurface, open_surface
from gcar_deploy.tree.tree import Tree

SCHEMA = "gcar-handover/1"
#: lattice of the surface over the smallest radius, and its bounds, mm
_EDGE_PER_RADIUS, _EDGE_BOUNDS_MM = 0.4, (0.25, 0.5)


def write_handover(tree: Tree, drop: PressureDrop, out: Path, *, force: bool = False) -> list[str]:
    """Write the folder, all or nothing.

    Returns
    -------
    sentences for the user: what is missing in it, and why

    Raises
    ------
    UsageError
        The tree has no branch; the folder is as ``output.folder.check_target`` refuses it.
    """
    files, notes = handover_files(tree, drop)
    write_folder(out, files, force=force)
    return notes


def handover_files(tree: Tree, drop: PressureDrop) -> tuple[dict[str, bytes], list[str]]:
    """File name -> content, and what is missing; see ``write_handover``."""
    if not drop.network.order:
        raise UsageError("the result has no vessel to hand over")
    notes = []
    surface = artery_surface(tree, drop)
    if surface.left_round:
        notes.append(
            f"{', '.join(surface.left_round)} stays round, without a cap: a vessel is too near"
        )
    if not any(name.startswith("inlet") for name in (*surface.names, *surface.left_round)):
        notes.append("the artery begins where two vessels meet: the surface has no inlet to cut")
    skipped = len(tree.branches) - len(drop.network.order)
    if skipped:
        notes.append(f"{skipped} branches are not joined to an artery's inlet and are left out")
    files = {
        "surface_open.vtp": surface_vtp(surface),
        "surface_open.stl": surface_stl(surface),
        "centerline.vtp": tracts_vtp(tree, drop),
        "pressure.svg": pressure_svg(drop).encode("utf-8"),
    }
    try:
        files["model_0d.json"] = _json(model_0d(tree, drop))
    except UsageError as error:
        notes.append(str(error))
    reasons: dict[str, str] = {}
    edge, angle = surface.least()
    body = {
        "schema": SCHEMA,
        "pressure": pressure_table(drop),
        "surface": {
            "faces": list(surface.names),
            "left_round": list(surface.left_round),
            "triangles": len(surface.face),
            "shortest_edge_mm": edge,
            "smallest_angle_deg": angle,
        },
        "notes": notes,
    }
    files["pressure.json"] = _json(plain(body, "", reasons))
    return files, notes


def artery_surface(tree: Tree, drop: PressureDrop) -> OpenSurface:
    """Surface of the artery, cut at its inlet and at every outlet."""
    network, degrees = drop.network, tree.degrees
    order = list(network.order)
    artery = dataclasses.replace(tree, branches=tuple(tree.branches[k] for k in order))
    place = {k: i for i, k in enumerate(order)}
    roots = [k for k in network.roots if degrees[tree.branches[k].start] == 1]
    names = ["inlet"] if len(roots) == 1 else [f"inlet-{n + 1}" for n in range(len(roots))]
    ends = [End(name, place[k], True) for name, k in zip(names, roots, strict=True)]
    ends += [End(f"outlet-{n}", place[k], False) for n, k in enumerate(network.outlets, start=1)]
    least = min(float(branch.radius_mm.min()) for branch in artery.branches)
    return open_surface(artery, ends, float(np.clip(_EDGE_PER_RADIUS * least, *_EDGE_BOUNDS_MM)))


def surface_vtp(surface: OpenSurface) -> bytes:
    """Wall and caps; ``ModelFaceID`` is 1 on the wall and counts the caps from 2."""
    return triangle_data(
        surface.surface.vertices_mm, surface.surface.faces,
        {
            "ModelFaceID": (surface.face + 1).astype(np.int32),
            "FaceName": [surface.names[k] for k in surface.face],
        },
    )  # fmt: skip


def surface_stl(surface: OpenSurface) -> bytes:
    """ASCII STL: one solid a face, since binary STL has no names."""
    corners = surface.surface.vertices_mm[surface.surface.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    facet = (
        "facet normal %.6g %.6g %.6g\nouter loop\n" + 3 * "vertex %.7g %.7g %.7g\n"
        + "endloop\nendfacet"
    )  # fmt: skip
    out = []
    for k, name in enumerate(surface.names):
        own = surface.face == k
        rows = np.concatenate([normals[own], corners[own].reshape(-1, 9)], axis=1).tolist()
        out.append(
            "\n".join([f"solid {name}", *(facet % tuple(r) for r in rows), f"endsolid {name}"])
        )
    return ("\n".join(out) + "\n").encode("ascii")


def _json(value: Any) -> bytes:
    return (json.dumps(value, indent=1, allow_nan=False) + "\n").encode("utf-8")

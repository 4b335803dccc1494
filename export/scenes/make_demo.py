"""Make the demo case of ``gcar demo`` from a centreline file with radii.

    python -m gcar_export.scenes.make_demo lca_cl.vtp gcar_deploy/data/demo

The file is read as LPS millimetres; its lines start in the aorta and are cut where the radius
first falls below 3 mm (nearer to the ostium the inscribed spheres still reach into the aorta).
Pictures are exact path lengths through the union of capsules, averaged over each pixel (3 x 3
rays), as 16-bit PNG.
"""

from __future__ import annotations

import json
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.types import Array
from gcar_export.scenes.render import occupancy, path_lengths

AORTA_RADIUS_MM = 3.0
MM_PER_COUNT = 0.001
#: rays along each edge of a pixel
SUBPIXELS = 3
SIDE = 512
SPACING_MM = 0.35
#: (primary, secondary, SOD, SDD)
VIEWS = ((-30.0, -20.0, 765.0, 1100.0), (45.0, 25.0, 765.0, 1060.0))
GRID_MM = 128.0
GRID_SHAPE = 128


def main(arguments: Sequence[str] | None = None) -> int:
    """Write view1.png, view2.png, geom.json and truth.npz into a folder."""
    source, out = map(Path, sys.argv[1:] if arguments is None else arguments)
    out.mkdir(parents=True, exist_ok=True)
    starts, ends, radii, lines = read_capsules(source)
    for number, carm in enumerate(carms(), start=1):
        path = _averaged(carm, starts, ends, radii)
        counts = np.rint(path / MM_PER_COUNT).astype(np.uint16)
        cv2.imwrite(str(out / f"view{number}.png"), counts, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    (out / "geom.json").write_text(json.dumps(_geometry(), indent=1) + "\n")
    grid = Grid(
        center_mm=(0.0, 0.0, 0.0), size_mm=(GRID_MM,) * 3, shape=(GRID_SHAPE,) * 3
    )  # fmt: skip
    index = _near(grid, starts, ends, radii)
    share, _, _ = occupancy(
        grid.index2world(index), GRID_MM / GRID_SHAPE, starts, ends, radii, sub=6
    )
    full = share > 0
    # Voxels as 8-bit shares beside their flat indices: a few tens of kilobytes.
    np.savez_compressed(
        out / "truth.npz",
        shape=np.array(grid.shape),
        voxel=np.ravel_multi_index(tuple(index[full].T), grid.shape).astype(np.int32),
        share=np.rint(share[full] * 255).astype(np.uint8),
        centreline_mm=np.concatenate(lines).astype(np.float32),
    )
    return 0


def carms() -> list[CArm]:
    """Return the two views."""
    return [
        CArm(
            primary_angle_deg=primary, secondary_angle_deg=secondary, sod_mm=sod, sdd_mm=sdd,
            rows=SIDE, columns=SIDE, pixel_spacing_mm=(SPACING_MM, SPACING_MM),
        )
        for primary, secondary, sod, sdd in VIEWS
    ]  # fmt: skip


def read_capsules(path: Path) -> tuple[Array, Array, Array, list[Array]]:
    """Read centrelines from a text VTP file, centred on the middle of their box.

    Returns
    -------
    starts, ends : (n, 3) mm
    radii : (n,) mm
    lines : (m, 3) points of each line
    """
    piece = ElementTree.parse(path).getroot().find(".//Piece")  # noqa: S314 - our own file
    points = _numbers(piece, "Points/DataArray").reshape(-1, 3)
    radius = _numbers(piece, "PointData/DataArray[@Name='MaximumInscribedSphereRadius']")
    order = _numbers(piece, "Lines/DataArray[@Name='connectivity']").astype(int)
    stops = _numbers(piece, "Lines/DataArray[@Name='offsets']").astype(int)
    lines, sizes = [], []
    for first, last in zip([0, *stops[:-1]], stops, strict=True):
        line = order[first:last]
        line = line[np.argmax(radius[line] < AORTA_RADIUS_MM) :]
        lines.append(points[line])
        sizes.append(radius[line])
    every = np.concatenate(lines)
    middle = (every.min(axis=0) + every.max(axis=0)) / 2
    lines = [line - middle for line in lines]
    starts = np.concatenate([line[:-1] for line in lines])
    ends = np.concatenate([line[1:] for line in lines])
    radii = np.concatenate([(r[:-1] + r[1:]) / 2 for r in sizes])
    # Lines run together along the trunk: each capsule once.
    _, once = np.unique(np.round(np.hstack([starts, ends]), 4), axis=0, return_index=True)
    return starts[once], ends[once], radii[once], lines


def _numbers(piece: ElementTree.Element | None, where: str) -> Array:
    found = None if piece is None else piece.find(where)
    if found is None or not found.text:
        raise ValueError(f"{where} is not in the file as text")
    return np.array(found.text.split(), dtype=np.float64)


def _averaged(carm: CArm, starts: Array, ends: Array, radii: Array) -> Array:
    fine = carm.resized(carm.rows * SUBPIXELS, carm.columns * SUBPIXELS)
    path = path_lengths(fine, starts, ends, radii)
    return cv2.resize(path, (carm.columns, carm.rows), interpolation=cv2.INTER_AREA)


def _near(grid: Grid, starts: Array, ends: Array, radii: Array) -> Array:
    """(n, 3) indices of voxels that a capsule may touch."""
    reach = int(np.ceil(radii.max() / grid.spacing_mm.min())) + 1
    mask = np.zeros(grid.shape, np.uint8)
    for points in (starts, ends):
        mask[tuple(np.rint(grid.world2index(points)).astype(int).T)] = 1
    from scipy import ndimage

    return np.argwhere(ndimage.distance_transform_edt(mask == 0) <= reach + 1)


def _geometry() -> dict[str, object]:
    intensity = {"kind": "path_length", "polarity": "bright", "mm_per_count": MM_PER_COUNT}
    views = [
        {
            "id": str(number), "primary_angle_deg": a, "secondary_angle_deg": b, "sod_mm": sod,
            "sdd_mm": sdd, "rows": SIDE, "columns": SIDE,
            "pixel_spacing_mm": [SPACING_MM, SPACING_MM], "intensity": intensity,
        }
        for number, (a, b, sod, sdd) in enumerate(VIEWS, start=1)
    ]  # fmt: skip
    volume = {"center_mm": [0, 0, 0], "size_mm": [GRID_MM] * 3, "shape": [GRID_SHAPE] * 3}
    return {"schema": "gcar-geometry/1", "frame": "LPS", "views": views, "volume": volume}


if __name__ == "__main__":
    sys.exit(main())

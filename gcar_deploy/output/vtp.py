"""XML PolyData for VMTK, ParaView and 3D Slicer: points, polylines, triangles with their data."""

from __future__ import annotations

import base64
import struct
from collections.abc import Mapping, Sequence

import numpy as np

from gcar_deploy.types import Array, Points

_TYPES = {"float64": "Float64", "float32": "Float32", "int64": "Int64", "int32": "Int32"}


def poly_data(
    points_mm: Points,
    sizes: Sequence[int] | None,
    point_data: Mapping[str, Array],
    cell_data: Mapping[str, Array | Sequence[str]],
) -> bytes:
    """Write points as a VTP file.

    Parameters
    ----------
    points_mm : (n, 3) mm LPS
    sizes : points of each polyline, in their order; None where every point stands alone
    point_data : name -> (n,) or (n, k) numbers; the first is what a viewer shows
    cell_data : name -> one number or text (ASCII) for each polyline, or for each lone point
    """
    count, kind = len(points_mm), "Verts" if sizes is None else "Lines"
    ends = np.arange(1, count + 1) if sizes is None else np.cumsum(np.asarray(sizes, np.int64))
    return _file(points_mm, (kind, np.arange(count, dtype=np.int64), ends), point_data, cell_data)


def triangle_data(
    vertices_mm: Points, faces: Array, cell_data: Mapping[str, Array | Sequence[str]]
) -> bytes:
    """Write triangles as a VTP file.

    Parameters
    ----------
    vertices_mm : (v, 3) mm LPS
    faces : (f, 3) vertex numbers
    cell_data : name -> one number or text (ASCII) for each triangle
    """
    ends = 3 * np.arange(1, len(faces) + 1)
    return _file(vertices_mm, ("Polys", faces.reshape(-1), ends), {}, cell_data)


def _file(
    points_mm: Points,
    cells: tuple[str, Array, Array],
    point_data: Mapping[str, Array],
    cell_data: Mapping[str, Array | Sequence[str]],
) -> bytes:
    """XML of points and cells: their kind, the points they join, and where each ends."""
    kind, joined, ends = cells
    counts = dict.fromkeys(("Verts", "Lines", "Strips", "Polys"), 0) | {kind: len(ends)}
    active = f' Scalars="{next(iter(point_data))}"' if point_data else ""
    out = [
        '<?xml version="1.0"?>',
        '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt32">',
        "<PolyData>",
        f'<Piece NumberOfPoints="{len(points_mm)}" '
        + " ".join(f'NumberOf{name}="{many}"' for name, many in counts.items())
        + ">",
        f"<PointData{active}>",
        *(
            _data_array(name, values, 1 if values.ndim == 1 else values.shape[1])
            for name, values in point_data.items()
        ),
        "</PointData>",
        "<CellData>",
        *(_cell_array(name, values) for name, values in cell_data.items()),
        "</CellData>",
        "<Points>",
        _data_array("Points", np.asarray(points_mm, np.float64).reshape(-1, 3), components=3),
        "</Points>",
        f"<{kind}>",
        _data_array("connectivity", joined.astype(np.int64)),
        _data_array("offsets", ends.astype(np.int64)),
        f"</{kind}>",
        "</Piece>",
        "</PolyData>",
        "</VTKFile>",
    ]
    return ("\n".join(out) + "\n").encode("ascii")


def _cell_array(name: str, values: Array | Sequence[str]) -> str:
    return _data_array(name, values) if isinstance(values, np.ndarray) else _texts(name, values)


def _texts(name: str, values: Sequence[str]) -> str:
    """Texts as VTK writes them: codes of the characters, each text ended by 0."""
    codes = " ".join(str(code) for text in values for code in (*text.encode("ascii"), 0))
    return (
        f'<Array type="String" Name="{name}" NumberOfTuples="{len(values)}" format="ascii">'
        f"{codes}</Array>"
    )


def _data_array(name: str, values: Array, components: int = 1) -> str:
    """Inline base64 block: its size in bytes as uint32, then the values."""
    # Binary because VTK's text reader stops at "nan", the value of an unknown sigma.
    raw = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<")).tobytes()
    text = base64.b64encode(struct.pack("<I", len(raw)) + raw).decode("ascii")
    kind = _TYPES[values.dtype.newbyteorder("=").name]
    return (
        f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{components}" '
        f'format="binary">{text}</DataArray>'
    )

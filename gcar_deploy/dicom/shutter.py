"""What shutters and collimator left open: pixels outside carry no picture."""

from __future__ import annotations

import cv2
import numpy as np

from gcar_deploy.dicom.header import Header
from gcar_deploy.types import Mask


def open_field(header: Header, frame: int = 0) -> Mask | None:
    """(rows, columns) bool, true where the picture is; None where nothing is said.

    Honours rectangular, circular and polygonal shutters and collimators (PS3.3 C.7.6.11, C.8.7.3);
    their rows and columns count from 1. A shutter that would leave nothing is not believed.
    """
    inside = np.ones((header.rows, header.columns), bool)
    found = False
    for kind in ("Shutter", "Collimator"):
        shapes = header.find(f"{kind}Shape", frame)
        if shapes is None:
            continue
        for shape in [shapes] if isinstance(shapes, str) else list(shapes):
            one = _shape(header, kind, str(shape).strip().upper(), frame)
            if one is not None:
                inside, found = inside & one, True
    return inside if found and inside.mean() > 0.05 and not inside.all() else None


def _shape(header: Header, kind: str, shape: str, frame: int) -> Mask | None:
    row, column = np.indices((header.rows, header.columns)) + 1
    if shape == "RECTANGULAR":
        edges = [
            header.number(f"{kind}{edge}Edge", frame)
            for edge in ("LeftVertical", "RightVertical", "UpperHorizontal", "LowerHorizontal")
        ]
        if any(edge is None for edge in edges):
            return None
        left, right, upper, lower = (float(edge or 0.0) for edge in edges)
        inside: Mask = (column > left) & (column < right) & (row > upper) & (row < lower)
        return inside
    if shape == "CIRCULAR":
        center = header.pair(f"CenterOfCircular{kind}", frame)
        radius = header.number(f"RadiusOfCircular{kind}", frame)
        if center is None or radius is None:
            return None
        within: Mask = np.hypot(row - center[0], column - center[1]) <= radius
        return within
    if shape == "POLYGONAL":
        flat = header.numbers(f"VerticesOfThePolygonal{kind}", frame)
        if flat is None or len(flat) < 6 or len(flat) % 2:
            return None
        corners = np.array(flat).reshape(-1, 2)[:, ::-1] - 1
        canvas = np.zeros((header.rows, header.columns), np.uint8)
        cv2.fillPoly(canvas, [np.clip(np.rint(corners), -9999, 9999).astype(np.int32)], 1)
        return canvas.astype(bool)
    return None

"""surface.glb: the lumen surface as binary glTF 2.0, for viewers and headsets.

One mesh, one material: 28 bytes of header and a small JSON, hence no library.
"""

from __future__ import annotations

import json
import struct

import numpy as np

from gcar_deploy.tree.surface import Surface

_MAGIC, _VERSION, _JSON, _BIN = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_FLOAT, _UINT32, _VERTICES, _INDICES = 5126, 5125, 34962, 34963
_RED = [0.75, 0.12, 0.12, 1.0]
#: column-major: mm patient LPS to metres with y up (head) and z forward (anterior)
_LPS_TO_GLTF = [0.001, 0, 0, 0, 0, 0, -0.001, 0, 0, 0.001, 0, 0, 0, 0, 0, 1]


def glb_bytes(surface: Surface) -> bytes:
    """Encode a surface; positions stay mm LPS, the node's matrix makes metres of them.

    A surface without a triangle becomes a scene without a mesh.
    """
    asset = {"version": "2.0", "generator": "gcar", "copyright": "Research use only"}
    document = {"asset": asset, "scene": 0, "scenes": [{"nodes": []}]}
    if not len(surface.faces):
        return _packed(document, b"")
    points = surface.vertices_mm.astype("<f4")
    normals = vertex_normals(surface).astype("<f4")
    faces = surface.faces.astype("<u4")
    blocks = [points.tobytes(), normals.tobytes(), faces.tobytes()]
    starts = np.cumsum([0, *(len(block) for block in blocks)]).tolist()
    document.update(
        scenes=[{"nodes": [0]}],
        nodes=[{"name": "lumen", "mesh": 0, "matrix": _LPS_TO_GLTF}],
        meshes=[
            {
                "name": "lumen",
                "primitives": [
                    {"attributes": {"POSITION": 0, "NORMAL": 1}, "indices": 2, "material": 0}
                ],
                "extras": {"frame": "positions are mm, patient LPS, origin at the isocentre"},
            }
        ],
        materials=[
            {"pbrMetallicRoughness": {
                "baseColorFactor": _RED, "metallicFactor": 0.0, "roughnessFactor": 0.6,
            }}
        ],
        buffers=[{"byteLength": starts[-1]}],
        bufferViews=[
            {"buffer": 0, "byteOffset": start, "byteLength": len(block), "target": target}
            for start, block, target in zip(
                starts, blocks, (_VERTICES, _VERTICES, _INDICES), strict=False
            )
        ],
        accessors=[
            {"bufferView": 0, "componentType": _FLOAT, "count": len(points), "type": "VEC3",
             "min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()},
            {"bufferView": 1, "componentType": _FLOAT, "count": len(points), "type": "VEC3"},
            {"bufferView": 2, "componentType": _UINT32, "count": faces.size, "type": "SCALAR"},
        ],
    )  # fmt: skip
    return _packed(document, b"".join(blocks))


def vertex_normals(surface: Surface) -> np.ndarray:
    """(v, 3) unit normals, means of the triangles round each vertex weighted by area."""
    corners = surface.vertices_mm[surface.faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(surface.vertices_mm)
    for k in range(3):
        np.add.at(total, surface.faces[:, k], area)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    # A vertex whose triangles have no area points anywhere; glTF wants unit length.
    return np.where(length > 0, total / np.maximum(length, 1e-30), [0.0, 0.0, 1.0])


def _packed(document: dict, binary: bytes) -> bytes:
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode("ascii")
    chunks = [(_JSON, text + b" " * (-len(text) % 4))]
    if binary:
        chunks.append((_BIN, binary + b"\0" * (-len(binary) % 4)))
    body = b"".join(struct.pack("<II", len(data), kind) + data for kind, data in chunks)
    return struct.pack("<III", _MAGIC, _VERSION, 12 + len(body)) + body

"""Minimal readers of NRRD and MetaImage masks: numpy and zlib only.

They cover what mask files use (raw or gzip data, attached or detached); everything else is
refused by name. SimpleITK would read more, at 264 MB.
"""

from __future__ import annotations

import gzip
import re
import zlib
from pathlib import Path

import numpy as np

from gcar_deploy.errors import UsageError
from gcar_deploy.types import Array

_NRRD_TYPES = {
    "signed char": "i1", "int8": "i1", "int8_t": "i1",
    "uchar": "u1", "unsigned char": "u1", "uint8": "u1", "uint8_t": "u1",
    "short": "i2", "signed short": "i2", "int16": "i2", "int16_t": "i2",
    "ushort": "u2", "unsigned short": "u2", "uint16": "u2", "uint16_t": "u2",
    "int": "i4", "signed int": "i4", "int32": "i4", "int32_t": "i4",
    "uint": "u4", "unsigned int": "u4", "uint32": "u4", "uint32_t": "u4",
    "int64": "i8", "longlong": "i8", "uint64": "u8", "ulonglong": "u8",
    "float": "f4", "double": "f8",
}  # fmt: skip
_META_TYPES = {
    "MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2",
    "MET_INT": "i4", "MET_UINT": "u4", "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4", "MET_DOUBLE": "f8",
}  # fmt: skip
#: sign of each RAS axis in the space a NRRD header names.
_NRRD_SPACES = {
    "left-posterior-superior": (-1, -1, 1),
    "lps": (-1, -1, 1),
    "right-anterior-superior": (1, 1, 1),
    "ras": (1, 1, 1),
    "left-anterior-superior": (-1, 1, 1),
    "las": (-1, 1, 1),
}
_MAX_VOXELS = 2**30


def read_nrrd(path: Path) -> tuple[Array, Array]:
    """Read a 3D NRRD.

    Returns
    -------
    array : (n0, n1, n2), first axis fastest in the file
    index2ras : (4, 4) voxel index to mm RAS; a header without a space is taken as LPS.

    Raises
    ------
    UsageError
        On anything that is not a plain 3D NRRD with raw or gzip data.
    """
    blob = path.read_bytes()
    match = re.search(rb"\r?\n\r?\n", blob)
    if not blob.startswith(b"NRRD") or (match is None and path.suffix.lower() != ".nhdr"):
        raise UsageError(f"{path}: not a NRRD file")
    head, data = (blob, b"") if match is None else (blob[: match.start()], blob[match.end() :])
    fields = {}
    for line in head.decode("ascii", "replace").splitlines()[1:]:
        key, colon, value = line.partition(":")
        if colon and not line.startswith("#"):
            fields[key.strip().lower()] = value.lstrip("=").strip()
    try:
        shape = tuple(int(n) for n in fields["sizes"].split())
        dtype = np.dtype(_NRRD_TYPES[fields["type"].lower()])
    except (KeyError, ValueError):
        raise UsageError(f"{path}: NRRD header lacks a usable 'sizes' or 'type'") from None
    if fields.get("endian", "little").lower() == "big":
        dtype = dtype.newbyteorder(">")
    detached = fields.get("data file", fields.get("datafile"))
    if detached is not None:
        data = _beside(path, detached).read_bytes()
    encoding = fields.get("encoding", "raw").lower()
    if encoding in ("gzip", "gz"):
        data = gzip.decompress(data)
    elif encoding != "raw":
        raise UsageError(f"{path}: NRRD encoding '{encoding}' is not supported (raw, gzip are)")
    return _shaped(path, data, dtype, shape), _nrrd_affine(path, fields)


def read_metaimage(path: Path) -> tuple[Array, Array]:
    """Read a 3D MetaImage (.mha, .mhd); returns and raises as ``read_nrrd``."""
    blob = path.read_bytes()
    fields: dict[str, str] = {}
    at = 0
    while "ElementDataFile" not in fields:
        end = blob.find(b"\n", at)
        if end < 0 or at > 65536:
            raise UsageError(f"{path}: not a MetaImage (no ElementDataFile)")
        key, _, value = blob[at:end].decode("ascii", "replace").partition("=")
        fields[key.strip()] = value.strip()
        at = end + 1
    try:
        shape = tuple(int(n) for n in fields["DimSize"].split())
        dtype = np.dtype(_META_TYPES[fields["ElementType"]])
        spacing = _floats(fields.get("ElementSpacing", "1 1 1"))
        origin = _floats(fields.get("Offset", fields.get("Position", "0 0 0")))
        directions = _floats(fields.get("TransformMatrix", "1 0 0 0 1 0 0 0 1")).reshape(3, 3)
    except (KeyError, ValueError):
        raise UsageError(f"{path}: MetaImage header lacks usable sizes, type or frame") from None
    if fields.get("BinaryDataByteOrderMSB", "False").lower() == "true":
        dtype = dtype.newbyteorder(">")
    name = fields["ElementDataFile"]
    data = blob[at:] if name == "LOCAL" else _beside(path, name).read_bytes()
    if fields.get("CompressedData", "False").lower() == "true":
        data = zlib.decompress(data)
    affine = np.eye(4)
    # Rows of TransformMatrix are the axes' directions, in LPS.
    affine[:3, :3] = np.diag([-1, -1, 1]) @ (directions.T * spacing)
    affine[:3, 3] = origin * (-1, -1, 1)
    return _shaped(path, data, dtype, shape), affine


def _nrrd_affine(path: Path, fields: dict[str, str]) -> Array:
    space = fields.get("space", "left-posterior-superior").lower()
    if space not in _NRRD_SPACES:
        raise UsageError(f"{path}: NRRD space '{space}' is not supported")
    signs = np.array(_NRRD_SPACES[space])
    affine = np.eye(4)
    vectors = re.findall(r"\(([^)]*)\)", fields.get("space directions", ""))
    try:
        if vectors:
            directions = np.array([_floats(v.replace(",", " ")) for v in vectors]).T
        else:
            directions = np.diag(_floats(fields.get("spacings", "1 1 1")))
        origin = _floats(fields.get("space origin", "(0,0,0)").strip("()").replace(",", " "))
        affine[:3, :3] = signs[:, None] * directions
        affine[:3, 3] = signs * origin
    except ValueError:
        raise UsageError(f"{path}: NRRD header has an unusable frame") from None
    return affine


def _shaped(path: Path, data: bytes, dtype: np.dtype, shape: tuple[int, ...]) -> Array:
    count = int(np.prod(shape))
    if len(shape) != 3 or not 0 < count <= _MAX_VOXELS:
        raise UsageError(f"{path}: a label volume has 3 axes and up to 2^30 voxels, not {shape}")
    if len(data) < count * dtype.itemsize:
        raise UsageError(f"{path}: the file ends before its {count} voxels do")
    return np.frombuffer(data, dtype, count).reshape(shape, order="F")


def _beside(path: Path, name: str) -> Path:
    """Return the data file beside a header; a name with a folder in it is refused."""
    if Path(name).name != name:
        raise UsageError(f"{path}: its data file must lie beside it, not at {name!r}")
    return path.with_name(name)


def _floats(text: str) -> Array:
    return np.array([float(x) for x in text.split()])

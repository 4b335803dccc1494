"""The header of an NPY file, read by its own grammar.

numpy evaluates it as Python, which warns on stderr of what Python 2 wrote and of what is nearly
Python, and ends in any error at all where it is damaged.
"""

from __future__ import annotations

import re
import struct

import numpy as np

SIGNATURE = b"\x93NUMPY"
#: how the length of the header is written, by version
_LENGTHS = {b"\x01\x00": "<H", b"\x02\x00": "<I"}
#: numpy reads no longer ones
_MOST_CHARACTERS = 10_000
#: a type by name, a list of fields, a truth value, or whole numbers, as Python 2 writes them too
_VALUE = (
    r"'[^'\\]*'|\"[^\"\\]*\"|\[[^{}]*\]|True|False"
    r"|\((?:\s*\d{1,18}L?\s*,)*(?:\s*\d{1,18}L?)?\s*\)"
)
_ITEM = re.compile(rf"\s*['\"](\w+)['\"]\s*:\s*({_VALUE})\s*(?:,|(?=\}}))")
#: names of plain numbers; others may be deprecated, or whole structures
_NUMBERS = re.compile(r"[<>=|]?(?:[biuf]\d{1,2}|[?BHfd]|bool|u?int\d{1,2}|float\d{1,2})")


def read_header(data: bytes) -> tuple[np.dtype | None, bool, tuple[int, ...], int]:
    """Read the header of an NPY file.

    Returns
    -------
    dtype : of plain numbers; None for another
    fortran : whether columns come first
    shape
    start : of the values, in bytes

    Raises
    ------
    ValueError
        It is damaged, or of an unknown version.
    """
    form = _LENGTHS.get(data[6:8])
    if form is None or len(data) < 8 + struct.calcsize(form):
        raise ValueError("unknown version")
    (length,) = struct.unpack_from(form, data, 8)
    start = 8 + struct.calcsize(form) + length
    text = data[start - length : start].decode("latin-1").strip()
    if start > len(data) or length > _MOST_CHARACTERS or text[:1] != "{":
        raise ValueError("no header")
    values, at = {}, 1
    while item := _ITEM.match(text, at):
        values[item[1]], at = item[2], item.end()
    if text[at:].strip() != "}" or sorted(values) != ["descr", "fortran_order", "shape"]:
        raise ValueError("other keys")
    name, order, shape = values["descr"], values["fortran_order"], values["shape"]
    if name[0] not in "'\"[" or order not in ("True", "False") or shape[0] != "(":
        raise ValueError("values of other kinds")
    try:
        dtype = np.dtype(name[1:-1]) if _NUMBERS.fullmatch(name[1:-1]) else None
    except TypeError:
        dtype = None
    return dtype, order == "True", tuple(int(n) for n in re.findall(r"\d+", shape)), start

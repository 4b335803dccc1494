"""Whether the strips or tiles of a TIFF unpack to its pixels, held before a decoder sees them.

Of 8 bit, OpenCV takes what unpacks to too little or to nonsense, and fills in the rest. Here data
are inflated, or their codes are counted, against the size that the directory promises. Functions
raise ``ValueError`` with the end of a sentence.
"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Callable

import numpy as np

from gcar_deploy.types import Array

Tags = dict[int, tuple[int, ...]]
#: TIFF compressions
_NONE, _LZW, _PACKBITS, _DEFLATE = 1, 5, 32773, (8, 32946)
_TRUNCATED = "is truncated; copy or export it again"
_DAMAGED = "is truncated or cannot be decoded (its data are damaged); copy or export it again"
#: LZW codes that stand for no string, and how many strings there can be
_CLEAR, _END, _STRINGS = 256, 257, 4096


def check_data(data: bytes, tags: Tags, rows: int, columns: int) -> None:
    """Refuse the data of a page that are not there, or are not its pixels."""
    starts = tags.get(273) or tags.get(324) or ()
    counts = tags.get(279) or tags.get(325) or ()
    if not starts or len(starts) != len(counts):
        raise ValueError("has no picture data; export it again")
    for start, count in zip(starts, counts, strict=True):
        if start + count > len(data):
            raise ValueError(_TRUNCATED)
    sizes = _sizes(tags, rows, columns)
    if len(starts) < len(sizes):
        raise ValueError(_TRUNCATED)
    compression, bits = one(tags, 259, _NONE), tags.get(258, (1,))[0]
    for start, count, (least, full) in zip(starts, counts, sizes, strict=False):
        if compression == _NONE:
            if count < least:
                raise ValueError(_TRUNCATED)
            continue
        unpacked = _unpacked_by(compression)
        if bits > 8 and compression not in _DEFLATE:
            return  # of more bits, the decoder fails where it cannot read on
        if unpacked is None:
            raise ValueError(
                f"is compressed in a way that cannot be checked (TIFF compression {compression}); "
                "export it with LZW, deflate or none, or as PNG"
            )
        # The last strip may be filled up to the size of the others.
        if unpacked(data[start : start + count], full) not in (least, full):
            raise ValueError(_DAMAGED)


def one(tags: Tags, tag: int, default: int) -> int:
    """Return the first value of a tag."""
    values = tags.get(tag, ())
    return values[0] if values else default


def _sizes(tags: Tags, rows: int, columns: int) -> list[tuple[int, int]]:
    """Bytes of each strip or tile: those of its rows in the picture, and those of all its rows."""
    samples, bits = one(tags, 277, 1), tags.get(258, (1,))[0]
    apart = one(tags, 284, 1) == 2
    planes, per_pixel = (samples, bits) if apart else (1, samples * bits)
    if tags.get(324):
        high, wide = one(tags, 323, 0), one(tags, 322, 0)
        if high < 1 or wide < 1:
            raise ValueError("has no picture data; export it again")
        size = high * -(-wide * per_pixel // 8)
        return [(size, size)] * (planes * -(-rows // high) * -(-columns // wide))
    high = min(max(one(tags, 278, rows), 1), rows)
    line = -(-columns * per_pixel // 8)
    return [(line * min(high, rows - top), line * high) for top in range(0, rows, high)] * planes


def _unpacked_by(compression: int) -> Callable[[bytes, int], int] | None:
    """Return what tells the bytes that packed data unpack to, or more than ``most``."""
    if compression in _DEFLATE:
        return _inflated
    return {_LZW: _from_lzw, _PACKBITS: _from_packbits}.get(compression)


def _inflated(packed: bytes, most: int) -> int:
    inflater = zlib.decompressobj()
    try:
        size = len(inflater.decompress(packed, most + 1))
        # The checksum stands behind the last byte.
        size += len(inflater.decompress(inflater.unconsumed_tail, 1))
    except zlib.error:
        return -1
    return size if inflater.eof else -1


def _from_packbits(packed: bytes, most: int) -> int:
    at = size = 0
    while at < len(packed) and size <= most:
        head = packed[at]
        if head == 128:  # means nothing
            at += 1
        elif head > 128:
            at, size = at + 2, size + 257 - head
        else:
            at, size = at + 2 + head, size + 1 + head
    return size if at <= len(packed) else -1


def _from_lzw(packed: bytes, most: int) -> int:
    """Bytes of LZW data (TIFF 6.0, section 13): the lengths of the strings, never the strings."""
    widths, offsets = _lzw_places()
    padded = np.frombuffer(packed + bytes(4), np.uint8).astype(np.uint32)
    size, bit, bits = 0, 0, 8 * len(packed)
    while bit < bits and size <= most:
        inside = int(np.searchsorted(offsets + widths, bits - bit, "right"))
        at = bit + offsets[:inside]
        first = at >> 3
        three = padded[first] << 16 | padded[first + 1] << 8 | padded[first + 2]
        found = (three >> (24 - (at & 7) - widths[:inside])) & ((1 << widths[:inside]) - 1)
        stops = np.flatnonzero((found == _CLEAR) | (found == _END))
        count = int(stops[0]) if len(stops) else inside
        if bit == 0 and count:
            return -1  # it begins with a clear table
        lengths = [1] * 256 + [0, 0]
        for code in found[:count].tolist():
            if code >= len(lengths) or size > most:
                return -1
            size += lengths[code]
            lengths.append(lengths[code] + 1)
        if not len(stops):
            return size if inside < len(widths) else -1  # a table must not overflow
        if found[count] == _END:
            return size
        bit += int(offsets[count] + widths[count])
    return size


@functools.cache
def _lzw_places() -> tuple[Array, Array]:
    """Bits of the codes that follow a clear table, and bits before them."""
    strings = 257 + np.arange(_STRINGS - 257)
    # One code early: the string that would need the next bit is not there yet.
    widths = 9 + (strings > 510).astype(np.int64) + (strings > 1022) + (strings > 2046)
    return widths, np.cumsum(widths) - widths

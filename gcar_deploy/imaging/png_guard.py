"""What a PNG or TIFF file claims, checked before any decoder sees its bytes.

Decoders allocate what a header asks for; a file of a few hundred bytes can ask for
gigabytes. Here every length is compared with the bytes that are really there, PNG data are
inflated against the size that the header promises, and everything that would turn, animate
or map the grey values is refused. Functions raise ``ValueError`` with the end of a sentence;
``read`` puts the name of the file in front.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

from gcar_deploy.imaging.tiff_data import check_data, one

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
TIFF_SIGNATURES = (b"II*\x00", b"MM\x00*")
MAX_CHUNK_BYTES = 16 * 2**20
_ANIMATION = {b"acTL", b"fcTL", b"fdAT"}
_CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}
#: TIFF sample formats, and what is read of them
_UNSIGNED, _FLOATING = 1, 3
_TIFF_KINDS = "8 or 16 bit grey, or 32 bit floating-point grey, is needed"
#: JPEG as a TIFF compression, old and new
_JPEG = (6, 7)
_TURNED = "asks to be turned (orientation tag); export it the right way up"
_MAX_TIFF_ENTRIES = 256
_TIFF_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8}


def check_sides(rows: int, columns: int, smallest: int, largest: int) -> None:
    """Refuse a picture whose sides are outside ``smallest`` .. ``largest`` pixels."""
    if not (smallest <= rows <= largest and smallest <= columns <= largest):
        raise ValueError(
            f"is {columns} x {rows} pixels (columns x rows); each side must be "
            f"{smallest} .. {largest}"
        )


def check_png(data: bytes, smallest: int, largest: int, *, binary: bool = False) -> int:
    """Walk the chunks of a PNG file; return the bit depth that it decodes to.

    ``binary``: grey of 1 bit, as masks are kept, is taken as well; it decodes to 8.

    Raises
    ------
    ValueError
        Not a PNG, truncated, checksum wrong, animated, palette, transparent, turned by its
        orientation, bit depth other than 8 or 16, sides out of range, or data that inflate to
        another size than promised.
    """
    header: tuple[int, int, int, int, int] | None = None
    pixels = bytearray()
    ended = False
    for kind, body in _chunks(data):
        if header is None:
            if kind != b"IHDR" or len(body) != 13:
                raise ValueError("does not begin with a PNG header; export the picture again")
            header = _png_header(body, smallest, largest, binary)
        elif kind in _ANIMATION:
            raise ValueError("is an animated PNG; export one frame as an ordinary PNG")
        elif kind == b"tRNS":
            raise ValueError("has transparent pixels; export it without transparency")
        elif kind == b"eXIf":
            _check_upright(body)
        elif kind == b"IDAT":
            pixels += body
        elif kind == b"IEND":
            ended = True
            break
    if header is None or not ended:
        raise ValueError("is truncated; copy or export it again")
    _check_inflated(bytes(pixels), *header)
    return max(header[2], 8)


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = len(PNG_SIGNATURE)
    while at < len(data):
        if at + 12 > len(data):
            raise ValueError("is truncated; copy or export it again")
        (length,) = struct.unpack_from(">I", data, at)
        kind = data[at + 4 : at + 8]
        if length > MAX_CHUNK_BYTES or at + 12 + length > len(data):
            raise ValueError("is truncated or damaged (a chunk is longer than the file)")
        body = data[at + 8 : at + 8 + length]
        (crc,) = struct.unpack_from(">I", data, at + 8 + length)
        if zlib.crc32(kind + body) != crc:
            raise ValueError("is damaged (a PNG checksum is wrong); copy it again")
        yield kind, body
        at += 12 + length


def _png_header(
    body: bytes, smallest: int, largest: int, binary: bool
) -> tuple[int, int, int, int, int]:
    columns, rows, depth, colour, compression, filtering, interlace = struct.unpack(
        ">IIBBBBB", body
    )
    check_sides(rows, columns, smallest, largest)
    if colour == 3:
        raise ValueError("uses a colour palette; export it as 8 or 16 bit grey")
    if colour not in _CHANNELS or compression or filtering or interlace > 1:
        raise ValueError("has an invalid PNG header; export it again")
    if depth not in (8, 16) and not (binary and (depth, colour) == (1, 0)):
        raise ValueError(f"has {depth} bits per pixel; 8 or 16 bit grey is needed")
    return rows, columns, depth, colour, interlace


def _check_upright(exif: bytes) -> None:
    """Refuse a picture whose EXIF data ask to be turned; what cannot be read asks nothing."""
    if exif[:4] not in TIFF_SIGNATURES:
        return
    order = "<" if exif[:2] == b"II" else ">"
    try:
        tags, _ = _tiff_directory(exif, order, _first_page(exif, order))
    except ValueError:
        return
    if one(tags, 274, 1) != 1:
        raise ValueError(_TURNED)


def _check_inflated(
    packed: bytes, rows: int, columns: int, depth: int, colour: int, interlace: int
) -> None:
    pixel_bits = _CHANNELS[colour] * depth
    if interlace:
        # Adam7: (first column, first row, column step, row step) of the seven passes.
        steps: tuple[tuple[int, int, int, int], ...]
        steps = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4))
        steps += ((1, 0, 2, 2), (0, 1, 1, 2))
        expected = 0
        for x, y, dx, dy in steps:
            wide, high = -((x - columns) // dx), -((y - rows) // dy)
            expected += high * (1 + -(-wide * pixel_bits // 8)) if wide > 0 and high > 0 else 0
    else:
        expected = rows * (1 + -(-columns * pixel_bits // 8))
    inflater = zlib.decompressobj()
    try:
        size = len(inflater.decompress(packed, expected + 1))
    except zlib.error:
        raise ValueError("is damaged (its data do not inflate); copy it again") from None
    if size != expected:
        raise ValueError("is damaged (more or fewer pixels than its header says); copy it again")


def check_tiff(data: bytes, smallest: int, largest: int, *, binary: bool = False) -> int:
    """Read the only directory of a TIFF file; return the bit depth that it decodes to.

    ``binary``: as of ``check_png``.

    Raises
    ------
    ValueError
        Truncated, several pages, JPEG, turned by an orientation tag, neither 8 or 16 bit unsigned
        nor 32 bit floating-point grey, a palette or inverted grey, sides out of range.
    """
    order = "<" if data[:2] == b"II" else ">"
    tags, next_page = _tiff_directory(data, order, _first_page(data, order))
    if next_page:
        raise ValueError("holds several pages; export the one frame to be used")
    return _check_tiff_page(data, tags, smallest, largest, binary)[0]


def check_tiff_pages(
    data: bytes, smallest: int, largest: int, most: int
) -> tuple[int, tuple[int, int], int]:
    """Read all directories of a TIFF file; return bit depth, (rows, columns) and their number.

    Raises
    ------
    ValueError
        As ``check_tiff`` of any page; more than ``most`` pages, or pages that differ in size.
    """
    order = "<" if data[:2] == b"II" else ">"
    at, seen, kinds = _first_page(data, order), 0, set()
    while at:
        seen += 1
        if seen > most:
            raise ValueError(f"holds more than {most} pages, or runs in a circle")
        tags, at = _tiff_directory(data, order, at)
        kinds.add(_check_tiff_page(data, tags, smallest, largest))
    if len(kinds) != 1:
        raise ValueError("holds pages of several sizes; export the frames of one run alone")
    ((depth, size),) = kinds
    return depth, size, seen


def has_pages(data: bytes) -> bool:
    """Tell whether a TIFF file names more than one page; it may be damaged otherwise."""
    try:
        order = "<" if data[:2] == b"II" else ">"
        return bool(_tiff_directory(data, order, _first_page(data, order))[1])
    except ValueError:
        return False


def _first_page(data: bytes, order: str) -> int:
    if len(data) < 8:
        raise ValueError("is truncated or damaged; copy or export it again")
    (at,) = struct.unpack_from(order + "I", data, 4)
    return int(at)


def _check_tiff_page(
    data: bytes, tags: dict[int, tuple[int, ...]], smallest: int, largest: int, binary: bool = False
) -> tuple[int, tuple[int, int]]:
    """Return bit depth and (rows, columns) of one page."""
    rows, columns = one(tags, 257, 0), one(tags, 256, 0)
    check_sides(rows, columns, smallest, largest)
    if one(tags, 259, 1) in _JPEG:
        raise ValueError(
            "holds a JPEG picture: its compression loses thin vessels; export it without, or as PNG"
        )
    depths, formats = set(tags.get(258, (1,))), set(tags.get(339, (_UNSIGNED,)))
    if len(depths) != 1 or not depths <= {8, 16, 32, *([1] if binary else [])}:
        raise ValueError(f"has {sorted(depths)} bits per sample; {_TIFF_KINDS}")
    if formats != {_FLOATING if 32 in depths else _UNSIGNED}:
        kinds = {1: "unsigned", 2: "signed", 3: "floating-point"}
        kind = " and ".join(kinds.get(one_of, "odd") for one_of in sorted(formats))
        raise ValueError(f"holds {kind} samples of {max(depths)} bit; {_TIFF_KINDS}")
    if one(tags, 262, -1) not in (1, 2):
        raise ValueError("is not plain grey (black is zero); export it as 8 or 16 bit grey")
    if one(tags, 274, 1) != 1:
        raise ValueError(_TURNED)
    if not 1 <= one(tags, 277, 1) <= (1 if 32 in depths else 4):
        raise ValueError("has an invalid number of channels; export it as 8 or 16 bit grey")
    check_data(data, tags, rows, columns)
    return max(*depths, 8), (rows, columns)


def _tiff_directory(data: bytes, order: str, at: int) -> tuple[dict[int, tuple[int, ...]], int]:
    """Return the tags of the directory at ``at``, and where the next one is (0: none)."""
    try:
        (entries,) = struct.unpack_from(order + "H", data, at)
        if entries > _MAX_TIFF_ENTRIES:
            raise ValueError("is damaged (too many TIFF tags); export it again")
        tags: dict[int, tuple[int, ...]] = {}
        for i in range(entries):
            tag, kind, count = struct.unpack_from(order + "HHI", data, at + 2 + 12 * i)
            # Of a tag that stands twice, the first counts, as for the decoder.
            tags.setdefault(tag, _tiff_values(data, order, at + 10 + 12 * i, kind, count))
        (next_page,) = struct.unpack_from(order + "I", data, at + 2 + 12 * entries)
    except struct.error:
        raise ValueError("is truncated or damaged; copy or export it again") from None
    return tags, next_page


def _tiff_values(data: bytes, order: str, at: int, kind: int, count: int) -> tuple[int, ...]:
    if kind not in (1, 3, 4):  # only whole numbers matter here
        return ()
    size = _TIFF_SIZES[kind] * count
    if size > len(data):
        raise ValueError("is truncated or damaged; copy or export it again")
    if size > 4:
        (at,) = struct.unpack_from(order + "I", data, at)
    return struct.unpack_from(f"{order}{count}{ {1: 'B', 3: 'H', 4: 'I'}[kind] }", data, at)

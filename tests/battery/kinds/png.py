"""Pictures: PNG above all, some TIFF and NPY; bytes, chunks, headers, bombs."""

from __future__ import annotations

import io
import random
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np

from gcar_deploy.imaging.png_guard import PNG_SIGNATURE
from gcar_deploy.imaging.read import read_picture
from tests.battery.damage import damaged
from tests.battery.kinds.common import generator, outcome
from tests.battery.pool import Case, FoundError

_Chunks = list[tuple[bytes, bytes]]


def make(seed: int) -> Case:
    """Return the fuzz case of pictures."""
    originals = _originals()

    def case(index: int, folder: Path) -> str:
        rng = generator("png", seed, index)
        suffix, data = rng.choice(originals)
        if suffix == ".png" and rng.random() < 0.6:
            data = _restructured(data, rng)
        if suffix != ".png" or rng.random() < 0.6:
            data = damaged(data, rng)
            if suffix == ".png" and rng.random() < 0.5:
                data = _repaired(data)
        path = folder / f"p{suffix}"
        path.write_bytes(data)
        return outcome(folder, (3,), lambda: _read(path))

    return case


def _read(path: Path) -> str:
    pixels, _, _ = read_picture(path)
    if not np.isfinite(pixels).all() or pixels.ndim != 2 or min(pixels.shape) < 16:
        raise FoundError(f"read as {pixels.shape}, or not finite")
    return "read"


def _originals() -> list[tuple[str, bytes]]:
    grey = (np.add.outer(np.arange(24), np.arange(32)) * 5 % 251).astype(np.uint8)
    deep = grey.astype(np.uint16) * 257
    colour = np.repeat(grey[..., None], 3, axis=2)
    out = [(".png", _encoded(".png", a)) for a in (grey, deep, colour)] * 3
    out += [(".tif", _encoded(".tif", a)) for a in (grey, deep)]
    for array in (grey, deep, grey.astype(np.float32)):
        stream = io.BytesIO()
        np.save(stream, array)
        out.append((".npy", stream.getvalue()))
    return out


def _encoded(suffix: str, array: np.ndarray) -> bytes:
    return cv2.imencode(suffix, array)[1].tobytes()


def _split(data: bytes) -> _Chunks:
    chunks, at = [], len(PNG_SIGNATURE)
    while at + 12 <= len(data):
        (size,) = struct.unpack_from(">I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    return chunks


def _joined(chunks: _Chunks) -> bytes:
    out = PNG_SIGNATURE
    for kind, body in chunks:
        crc = zlib.crc32(kind + body)
        out += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", crc)
    return out


def _repaired(data: bytes) -> bytes:
    """Make checksums right again, so that damage gets past them."""
    return _joined(_split(data)) if data.startswith(PNG_SIGNATURE) else data


def _restructured(data: bytes, rng: random.Random) -> bytes:
    chunks = _split(data)
    for _ in range(rng.randint(1, 3)):
        if not chunks:
            break
        at = rng.randrange(len(chunks))
        action = rng.randrange(6)
        if action == 0:
            kinds = (b"acTL", b"fcTL", b"fdAT", b"tEXt", b"zTXt", b"eXIf", b"tRNS", b"PLTE",
                     b"gAMA", b"iCCP", b"sBIT", b"IDAT", b"IHDR", b"IEND", b"abcd")  # fmt: skip
            body = rng.randbytes(rng.choice((0, 1, 2, 6, 8, 13, 26, 300)))
            chunks.insert(at, (rng.choice(kinds), body))
        elif action == 1:
            del chunks[at]
        elif action == 2:
            chunks.insert(at, chunks[rng.randrange(len(chunks))])
        elif action == 3:
            chunks[at] = _other_header(chunks[at], rng)
        elif action == 4:
            bomb = zlib.compress(bytes(rng.choice((10, 10**5, 3 * 10**6))))
            chunks = [(k, bomb if k == b"IDAT" else b) for k, b in chunks]
        else:
            rng.shuffle(chunks)
    return _joined(chunks)


def _other_header(chunk: tuple[bytes, bytes], rng: random.Random) -> tuple[bytes, bytes]:
    kind, body = chunk
    if kind != b"IHDR" or len(body) != 13:
        return kind, body[: len(body) // 2]
    fields = list(struct.unpack(">IIBBBBB", body))
    at = rng.randrange(len(fields))
    sizes = (0, 1, 15, 16, 4096, 4097, 65535, 2**31 - 1, 2**32 - 1)
    fields[at] = rng.choice(sizes) if at < 2 else rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
    return kind, struct.pack(">IIBBBBB", *fields)

"""Pictures of tubes whose path lengths are known in closed form."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.types import Mask

#: of the pictures below, at the isocentre
PIXEL_MM = 0.3


def carm(rows: int, columns: int, pixel_mm: float = PIXEL_MM) -> CArm:
    spacing = pixel_mm * 1000 / 750
    return CArm(
        primary_angle_deg=30, secondary_angle_deg=20, sod_mm=750, sdd_mm=1000,
        rows=rows, columns=columns, pixel_spacing_mm=(spacing, spacing),
    )  # fmt: skip


def angiogram(pixels, kind="raw", view_id="2", pixel_mm=PIXEL_MM, **intensity) -> Angiogram:
    pixels = np.asarray(pixels, np.float32)
    return Angiogram(
        view_id=view_id, carm=carm(*pixels.shape, pixel_mm), pixels=pixels, bit_depth=8,
        intensity=Intensity(kind=kind, **intensity), sha256="0" * 64,
    )  # fmt: skip


def tube_paths(size=256, radius_mm=1.5, pixel_mm=PIXEL_MM, oversample=4):
    """(size, size) mean chord, mm, through a Y of round tubes in the plane of the detector."""
    n = size * oversample
    row, column = (np.indices((n, n), dtype=np.float32) + 0.5) / oversample - 0.5
    lines = [((40, 30), (128, 120)), ((128, 120), (225, 150)), ((128, 120), (150, 225))]
    path = np.zeros((n, n), np.float32)
    scale = size / 256
    for a, b in lines:
        a, b = np.array(a) * scale, np.array(b) * scale
        along = (b - a) / np.linalg.norm(b - a)
        t = (column - a[0]) * along[0] + (row - a[1]) * along[1]
        t = np.clip(t, 0, np.linalg.norm(b - a))
        gap = np.hypot(column - a[0] - t * along[0], row - a[1] - t * along[1]) * pixel_mm
        path = np.maximum(path, 2 * np.sqrt(np.clip(radius_mm**2 - gap**2, 0, None)))
    return cv2.resize(path, (size, size), interpolation=cv2.INTER_AREA)


def raw_picture(path_mm, gain=0.06, noise=1.5, seed=0, ramp=40.0):
    """Beer's law over a sloping background: grey counts of an 8-bit linear detector."""
    columns = path_mm.shape[1]
    light = 150 + ramp * np.linspace(-1, 1, columns)[None, :] + 0 * path_mm
    grey = light * np.exp(-gain * path_mm)
    grey = grey + noise * np.random.default_rng(seed).standard_normal(path_mm.shape)
    return np.clip(np.round(grey), 0, 255).astype(np.float32)


def png_chunk(kind: bytes, body: bytes) -> bytes:
    crc = zlib.crc32(kind + body)
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", crc)


def png(rows=32, columns=32, depth=8, colour=0, data=None, before=(), interlace=0) -> bytes:
    """Write a PNG by hand, so that every byte of it can be wrong."""
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colour]
    if data is None:
        data = b"".join(b"\0" + bytes(columns * channels * depth // 8) for _ in range(rows))
    header = struct.pack(">IIBBBBB", columns, rows, depth, colour, 0, 0, interlace)
    parts = [png_chunk(b"IHDR", header), *before]
    parts += [png_chunk(b"IDAT", zlib.compress(data)), png_chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def dice(a: Mask, b: Mask) -> float:
    return 2 * float((a & b).sum()) / float(a.sum() + b.sum())

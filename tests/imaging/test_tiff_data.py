"""Packed TIFF of 8 bit: what other programs write is read, what is damaged is told by one line."""

from __future__ import annotations

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from gcar_deploy.config import DicomLimits
from gcar_deploy.errors import ImageError
from gcar_deploy.imaging.read import read_picture, read_stack
from gcar_deploy.imaging.tiff_data import check_data

_PACKED = ("tiff_lzw", "tiff_adobe_deflate", "tiff_deflate", "packbits")
#: what a detector gives: smooth, with noise; LZW fills its table more than once
_GREY = np.clip(
    np.add.outer(np.arange(211), np.arange(157)) / 2
    + np.random.default_rng(2).normal(0, 4, (211, 157)),
    0,
    255,
).astype(np.uint8)


def _tiff(picture, compression, **how):
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "TIFF", compression=compression, **how)
    return stream.getvalue()


@pytest.mark.parametrize("compression", _PACKED)
@pytest.mark.parametrize("picture", [_GREY, np.zeros_like(_GREY), np.tile(_GREY, (3, 3))])
@pytest.mark.parametrize("strip_bytes", [1, 2**13, 2**24])
@pytest.mark.req("REQ-07")
def test_packed_pictures_of_another_program(tmp_path, compression, picture, strip_bytes):
    path = tmp_path / "p.tif"
    path.write_bytes(_tiff(picture, compression, strip_size=strip_bytes))
    np.testing.assert_array_equal(read_picture(path)[0], picture)


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize(
    ("channels", "how"),
    [
        (1, {"tile": (64, 48)}),
        (3, {"tile": (64, 48)}),
        (1, {"rowsperstrip": 13}),
        (3, {"planarconfig": "separate", "rowsperstrip": 13}),
    ],
)
def test_tiles_and_planes(tmp_path, compression, channels, how):
    axis = 0 if "planarconfig" in how else -1
    picture = _GREY if channels == 1 else np.stack([_GREY] * 3, axis)
    kind = "minisblack" if channels == 1 else "rgb"
    path = tmp_path / "p.tif"
    tifffile.imwrite(path, picture, compression=compression, photometric=kind, **how)
    np.testing.assert_array_equal(read_picture(path)[0], _GREY)


@pytest.mark.parametrize("compression", _PACKED[:3])
@pytest.mark.parametrize("strip_bytes", [2**13, 2**24])
@pytest.mark.req("REQ-08")
def test_of_a_damaged_picture_one_line_tells(tmp_path, compression, strip_bytes, capfd):
    data = bytearray(_tiff(_GREY, compression, strip_size=strip_bytes))
    middle = len(data) // 2
    data[middle : middle + 40] = bytes(40)
    (tmp_path / "p.tif").write_bytes(data)
    with pytest.raises(ImageError, match=r"^p\.tif: is truncated or cannot be decoded"):
        read_picture(tmp_path / "p.tif")
    assert capfd.readouterr().err == ""


def test_pages_are_held_to_it_too(tmp_path, capfd):
    stream = io.BytesIO()
    first, second = (Image.fromarray(p) for p in (_GREY, 255 - _GREY))
    first.save(stream, "TIFF", compression="tiff_lzw", save_all=True, append_images=[second])
    (tmp_path / "p.tif").write_bytes(stream.getvalue())
    pages, depth, _ = read_stack(tmp_path / "p.tif", DicomLimits())
    assert depth == 8
    np.testing.assert_array_equal(pages, [_GREY, 255 - _GREY])
    data = bytearray(stream.getvalue())
    data[-2000:-1960] = bytes(40)
    (tmp_path / "p.tif").write_bytes(data)
    with pytest.raises(ImageError, match=r"^p\.tif: is truncated or cannot be decoded"):
        read_stack(tmp_path / "p.tif", DicomLimits())
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("compression", [1, 5, 8, 32773])
def test_a_strip_that_holds_too_little(compression):
    """As many bytes in all are there, but one strip has less than its rows."""
    picture = np.full((32, 32), 7, np.uint8)
    name = {1: "raw", 5: "tiff_lzw", 8: "tiff_adobe_deflate", 32773: "packbits"}[compression]
    with tifffile.TiffFile(io.BytesIO(_tiff(picture[:15], name))) as short:
        (start,), (count,) = short.pages[0].dataoffsets, short.pages[0].databytecounts
        data = short.filehandle.read_segments([start], [count])
        strip = next(iter(data))[0]
    sizes = {256: (32,), 257: (32,), 258: (8,), 259: (compression,), 278: (16,)}
    tags = {**sizes, 273: (0, 0), 279: (len(strip), len(strip))}
    with pytest.raises(ValueError, match="truncated"):
        check_data(strip, tags, 32, 32)
    with pytest.raises(ValueError, match="truncated"):  # one strip for two
        check_data(strip, {**tags, 273: (0,), 279: (len(strip),)}, 30, 32)
    check_data(strip, {**tags, 278: (15,)}, 30, 32)


def test_the_checksum_is_behind_the_last_byte():
    packed = zlib.compress(bytes(256))
    tags = {256: (16,), 257: (16,), 258: (8,), 259: (8,), 273: (0,), 279: (len(packed),)}
    check_data(packed, tags, 16, 16)
    for damaged, count in ((packed[:-1] + b"\7", len(packed)), (packed[:-4], len(packed) - 4)):
        with pytest.raises(ValueError, match="cannot be decoded"):
            check_data(damaged, {**tags, 279: (count,)}, 16, 16)


def test_a_kind_that_cannot_be_checked_is_refused(tmp_path):
    """Of fax codes, the decoder fills in what it cannot read, and says nothing."""
    mask = _GREY > 100
    (tmp_path / "m.tif").write_bytes(_tiff(mask, "group4"))
    with pytest.raises(ImageError, match="cannot be checked"):
        read_picture(tmp_path / "m.tif", binary=True)
    (tmp_path / "m.tif").write_bytes(_tiff(mask, "tiff_lzw"))
    np.testing.assert_array_equal(read_picture(tmp_path / "m.tif", binary=True)[0] > 0, mask)


def test_odd_tags_are_no_news(tmp_path, capfd):
    """Tags out of order, one that nobody knows: the picture is whole, and nothing is printed."""
    tags = {256: 32, 257: 32, 258: 8, 259: 1, 262: 1, 273: 200, 277: 1, 278: 32, 279: 1024}
    entries = [*reversed(tags.items()), (51234, 5)]
    body = struct.pack("<H", len(entries))
    body += b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in entries)
    head = b"II*\0" + struct.pack("<I", 8) + body + bytes(4)
    (tmp_path / "p.tif").write_bytes(head.ljust(200, b"\0") + _GREY[:32, :32].tobytes())
    level = cv2.utils.logging.getLogLevel()
    np.testing.assert_array_equal(read_picture(tmp_path / "p.tif")[0], _GREY[:32, :32])
    assert capfd.readouterr().err == "" and cv2.utils.logging.getLogLevel() == level

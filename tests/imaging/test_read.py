from __future__ import annotations

import hashlib
import io
import os
import struct

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gcar_deploy.config import DicomLimits, PictureLimits
from gcar_deploy.errors import ImageError
from gcar_deploy.imaging.read import read_picture, read_stack
from tests.imaging.phantoms import png, png_chunk

_quick = settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
_shapes = hnp.array_shapes(min_dims=2, max_dims=2, min_side=16, max_side=40)


@_quick
@given(data=st.data(), suffix=st.sampled_from([".png", ".tif", ".npy"]))
@pytest.mark.req("REQ-07")
def test_round_trip_keeps_every_count(tmp_path, data, suffix):
    dtype = data.draw(st.sampled_from([np.uint8, np.uint16]))
    picture = data.draw(hnp.arrays(dtype, _shapes))
    path = tmp_path / f"p{suffix}"
    if suffix == ".npy":
        np.save(path, picture)
    else:
        path.write_bytes(cv2.imencode(suffix, picture)[1].tobytes())
    before = path.read_bytes()
    pixels, depth, sha256 = read_picture(path)
    assert pixels.dtype == np.float32
    assert depth == 8 * np.dtype(dtype).itemsize
    np.testing.assert_array_equal(pixels, picture)
    assert sha256 == hashlib.sha256(before).hexdigest()
    assert path.read_bytes() == before


@_quick
@given(hnp.arrays(np.float64, _shapes, elements=st.floats(0, 1e6)), st.booleans())
def test_floating_npy(tmp_path, picture, fortran):
    np.save(tmp_path / "p.npy", np.asfortranarray(picture) if fortran else picture)
    pixels, depth, _ = read_picture(tmp_path / "p.npy")
    assert depth == 64
    np.testing.assert_allclose(pixels, picture, rtol=1e-6, atol=1e-37)


@_quick
@given(hnp.arrays(np.float32, _shapes, elements=st.floats(0, 1e6, width=32)), st.booleans())
def test_floating_tiff_is_read_like_npy(tmp_path, picture, packed):
    how = [cv2.IMWRITE_TIFF_COMPRESSION, 5 if packed else 1]  # LZW, none
    (tmp_path / "p.tif").write_bytes(cv2.imencode(".tif", picture, how)[1].tobytes())
    np.save(tmp_path / "p.npy", picture)
    tiff, npy = (read_picture(tmp_path / name) for name in ("p.tif", "p.npy"))
    np.testing.assert_array_equal(tiff[0], npy[0])
    assert tiff[1] == npy[1] == 32


def test_grey_stored_as_colour_is_grey(tmp_path):
    grey = np.arange(400, dtype=np.uint16).reshape(20, 20)
    colour = np.stack([grey] * 3, -1)
    opaque = np.dstack([colour, np.full_like(grey, 65535)])
    for picture in (colour, opaque):
        cv2.imwrite(str(tmp_path / "p.png"), picture)
        np.testing.assert_array_equal(read_picture(tmp_path / "p.png")[0], grey)


@pytest.mark.req("REQ-07")
def test_exif_rotation_is_not_obeyed(tmp_path):
    tags = struct.pack(">HHHIHH", 1, 0x0112, 3, 1, 6, 0) + bytes(4)
    exif = png_chunk(b"eXIf", b"MM\x00*\x00\x00\x00\x08" + tags)
    (tmp_path / "p.png").write_bytes(png(rows=20, columns=40, before=[exif]))
    with pytest.raises(ImageError, match=r"p.png: asks to be turned \(orientation tag\)"):
        read_picture(tmp_path / "p.png")
    upright = png_chunk(b"eXIf", exif[8:-4].replace(b"\x00\x06", b"\x00\x01"))
    for harmless in (upright, png_chunk(b"eXIf", b"MM\x00*\xff"), png_chunk(b"eXIf", b"")):
        (tmp_path / "p.png").write_bytes(png(rows=20, columns=40, before=[harmless]))
        assert read_picture(tmp_path / "p.png")[0].shape == (20, 40)


def test_a_mask_of_one_bit_is_taken_where_a_mask_is_asked_for(tmp_path):
    """The commonest thing that a segmentation gives."""
    truth = np.random.default_rng(3).random((20, 21)) > 0.5
    rows = np.packbits(truth, axis=1)
    packed = b"".join(b"\0" + row.tobytes() for row in rows)
    (tmp_path / "m.png").write_bytes(png(20, 21, depth=1, data=packed))
    bits = {"t256": 21, "t257": 20, "t258": 1, "t278": 20, "t279": rows.size}
    (tmp_path / "m.tif").write_bytes(_tiff(**bits)[:200] + rows.tobytes())
    np.save(tmp_path / "m.npy", truth)
    for name in ("m.png", "m.tif", "m.npy"):
        with pytest.raises(ImageError):
            read_picture(tmp_path / name)
        pixels, depth, _ = read_picture(tmp_path / name, binary=True)
        np.testing.assert_array_equal(pixels > 0, truth)
        assert depth == 8
    (tmp_path / "m.png").write_bytes(png(20, 21, depth=1, data=packed + b"\0"))
    with pytest.raises(ImageError, match="more or fewer pixels"):
        read_picture(tmp_path / "m.png", binary=True)
    (tmp_path / "m.tif").write_bytes(_tiff(**{**bits, "t279": rows.size - 1})[:200] + bytes(99))
    with pytest.raises(ImageError, match="truncated"):
        read_picture(tmp_path / "m.tif", binary=True)


@pytest.mark.parametrize("size", [(16, 16), (17, 33), (23, 19)])
def test_interlaced(tmp_path, size):
    rows, columns = size
    passes = [(0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2)]
    truth = np.random.default_rng(1).integers(0, 256, size).astype(np.uint8)
    data = b""
    for x, y, dx, dy in [*passes, (0, 1, 1, 2)]:
        data += b"".join(b"\0" + line.tobytes() for line in truth[y::dy, x::dx] if line.size)
    (tmp_path / "p.png").write_bytes(png(rows, columns, data=data, interlace=1))
    np.testing.assert_array_equal(read_picture(tmp_path / "p.png")[0], truth)


def _encoded(suffix, picture, *how):
    return cv2.imencode(suffix, picture, how)[1].tobytes()


def _npy(array, **kwargs):
    stream = io.BytesIO()
    np.save(stream, array, **kwargs)
    return stream.getvalue()


def _headed(header, array):
    """NPY file with a header as other programs, or damage, make it."""
    text = header.encode("latin-1").ljust(118) + b"\n"
    values = array.tobytes()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + values


def _tiff(**changes):
    """A 16x16 8-bit TIFF by hand; changes: tag number with t in front -> value."""
    tags = {256: 16, 257: 16, 258: 8, 259: 1, 262: 1, 273: 200, 277: 1, 278: 16, 279: 256}
    next_page = changes.pop("next_page", 0)
    tags |= {int(key[1:]): value for key, value in changes.items()}
    body = struct.pack("<H", len(tags))
    for tag, value in sorted(tags.items()):
        body += struct.pack("<HHII", tag, 4, 1, value)
    head = b"II*\0" + struct.pack("<I", 8) + body + struct.pack("<I", next_page)
    return head.ljust(200, b"\0") + bytes(range(256))


_GREY = np.arange(1024, dtype=np.uint8).reshape(32, 32)
_COLOUR = np.dstack([_GREY, _GREY, 255 - _GREY])
_GLASS = np.dstack([_GREY] * 3 + [_GREY])
_BAD = {
    "empty.png": (b"", "is empty"),
    "empty.npy": (b"", "is empty"),
    "text.png": (b"hello", "is not a PNG file"),
    "tiff.png": (_encoded(".tiff", _GREY), "is a TIFF file though"),
    "png.tif": (png(), "is a PNG file though"),
    "jpeg.png": (_encoded(".jpg", _GREY), "JPEG picture: its compression loses"),
    "name.jpg": (_encoded(".jpg", _GREY), "export PNG, TIFF, NPY or DICOM"),
    "noname": (png(), "unknown kind of name"),
    "half.png": (_encoded(".png", _GREY)[:120], "truncated"),
    "signature.png": (png()[:8], "truncated"),
    "noend.png": (png()[:-12], "truncated"),
    "crc.png": (png()[:20] + b"\1" + png()[21:], "checksum"),
    "onebit.png": (png(depth=1, data=b"\0" * 160), "bits per pixel"),
    "palette.png": (png(colour=3), "palette"),
    "colour.png": (_encoded(".png", _COLOUR), "colour picture"),
    "alpha.png": (_encoded(".png", _GLASS), "transparent"),
    "trns.png": (png(before=[png_chunk(b"tRNS", b"\0\0")]), "transparent"),
    "animated.png": (png(before=[png_chunk(b"acTL", bytes(8))]), "animated"),
    "frame.png": (png(before=[png_chunk(b"fcTL", bytes(26))]), "animated"),
    "tiny.png": (png(1, 1), "each side must be"),
    "zero.png": (png(0, 16, data=b"\0"), "each side must be"),
    "huge.png": (png(60000, 60000, data=b"\0"), "each side must be"),
    "bomb.png": (png(64, 64, data=bytes(10**7)), "more or fewer pixels"),
    "short.png": (png(64, 64, data=bytes(100)), "more or fewer pixels"),
    "chunk.png": (png()[:33] + b"\x7f\xff\xff\xffIDAT" + bytes(50), "longer than the file"),
    "noise.png": (png()[:33] + png_chunk(b"IDAT", b"abc") + png()[-12:], "do not inflate"),
    "second.png": (b"\x89PNG\r\n\x1a\n" + png_chunk(b"IDAT", b""), "does not begin"),
    "pages.tif": (_tiff(next_page=8), "several pages"),
    "turned.tif": (_tiff(t274=6), "orientation"),
    "inverted.tif": (_tiff(t262=0), "plain grey"),
    "jpeg.tif": (_encoded(".tiff", _GREY, cv2.IMWRITE_TIFF_COMPRESSION, 7), "holds a JPEG"),
    "old_jpeg.tif": (_tiff(t259=6), "loses thin vessels"),
    "deep.tif": (_tiff(t258=64), "bits per sample"),
    "long.tif": (_tiff(t258=32), "holds unsigned samples of 32 bit"),
    "bigtiff.tif": (b"II+\x00\x08\x00\x00\x00" + bytes(40), "is a BigTIFF file"),
    "float.tif": (_tiff(t339=3), "floating-point"),
    "floats.tif": (_tiff(t258=32, t339=3, t277=3), "channels"),
    "nan.tif": (_encoded(".tiff", np.full((16, 16), np.nan, np.float32)), "non-finite"),
    "minus.tif": (_encoded(".tiff", np.full((16, 16), -1, np.float32)), "negative"),
    "double.tif": (_encoded(".tiff", np.ones((16, 16))), "bits per sample"),
    "big.tif": (_tiff(t256=100000), "each side must be"),
    "cut.tif": (_tiff()[:300], "truncated"),
    "head.tif": (b"II*\0\x08", "truncated or damaged"),
    "more.tif": (_tiff(t257=64), "truncated"),
    "object.npy": (_npy(np.array([[{}] * 16] * 16), allow_pickle=True), "other values"),
    "int.npy": (_npy(np.zeros((16, 16), np.int64)), "other values"),
    "complex.npy": (_npy(np.zeros((16, 16), complex)), "other values"),
    "cube.npy": (_npy(np.zeros((16, 16, 3), np.uint8)), "3 dimensions"),
    "nan.npy": (_npy(np.full((16, 16), np.nan)), "non-finite"),
    "minus.npy": (_npy(np.full((16, 16), -1.0)), "negative"),
    "large.npy": (_npy(np.full((16, 16), 1e300)), "single precision"),
    "cut.npy": (_npy(np.zeros((16, 16)))[:-1], "truncated"),
    "spare.npy": (_npy(np.zeros((16, 16))) + b"\0", "to spare"),
    "small.npy": (_npy(np.zeros((2, 2))), "each side must be"),
    "fields.npy": (_npy(np.zeros((16, 16), [("a", "u1"), ("b", "u1")])), "other values"),
    "tuple.npy": (
        _headed("{'descr': (), 'fortran_order': False, 'shape': (16, 16)}", _GREY),
        "NPY",
    ),
    "pair.npy": (
        _headed("{'descr': ('<u2',), 'fortran_order': False, 'shape': ((),)}", _GREY),
        "NPY",
    ),
    "is.npy": (
        _headed("{'descr': '<u2', 'fortran_order': 1is 1, 'shape': (16, 16)}", _GREY),
        "NPY",
    ),
    "deep.npy": (_headed("{'descr': '|u1', 'shape': " + "(" * 9000, _GREY), "damaged NPY"),
    "alias.npy": (_headed("{'descr': 'a', 'fortran_order': False, 'shape': (2,)}", _GREY), "other"),
    "magic.npy": (b"\x93NUMPY\x09\x00" + bytes(99), "damaged NPY"),
    "eval.npy": (b"\x93NUMPY\x01\x00\x10\x00__import__('os')", "damaged NPY"),
}


@pytest.mark.parametrize("name", sorted(_BAD))
@pytest.mark.req("REQ-08")
def test_bad_files_have_one_clear_line(tmp_path, name, recwarn):
    data, words = _BAD[name]
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(ImageError) as caught:
        read_picture(path)
    message = str(caught.value)
    assert message.startswith(f"{name}: ") and words in message
    assert "\n" not in message and str(tmp_path) not in message
    assert path.read_bytes() == data and len(list(tmp_path.iterdir())) == 1
    assert not recwarn.list


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '|u1', 'fortran_order': False, 'shape': (32L, 32L), }",  # Python 2
        "{'descr': '|u1', 'fortran_order': False, 'shape': (32, 32)}",
        '{"shape": (32,32), "fortran_order": False, "descr": "uint8",}',
        "{'shape':(32, 32,),'descr':'<u1','fortran_order':False}  \n",
    ],
)
def test_npy_of_other_writers(tmp_path, header, recwarn):
    (tmp_path / "p.npy").write_bytes(_headed(header, _GREY))
    np.testing.assert_array_equal(read_picture(tmp_path / "p.npy")[0], _GREY)
    np.save(tmp_path / "big.npy", _GREY.astype(">u2"))  # the other byte order
    np.testing.assert_array_equal(read_picture(tmp_path / "big.npy")[0], _GREY)
    assert not recwarn.list


def test_of_a_damaged_tiff_only_the_error_tells(tmp_path, capfd):
    level = cv2.utils.logging.getLogLevel()
    noise = np.random.default_rng(0).integers(0, 65535, (64, 64), np.uint16)
    for name, encoded, read in (
        ("a.tif", cv2.imencode(".tif", noise)[1], read_picture),
        ("b.tif", cv2.imencodemulti(".tif", [noise, noise])[1], read_stack),
    ):
        # The first strip lies between the header and the directory.
        encoded[8 : int(encoded[4:8].view("<u4")[0])] = 255
        (tmp_path / name).write_bytes(encoded.tobytes())
        with pytest.raises(ImageError, match="cannot be decoded"):
            read(tmp_path / name, DicomLimits())
    assert capfd.readouterr().err == "" and cv2.utils.logging.getLogLevel() == level


@pytest.mark.req("REQ-09")
def test_missing_folder_pipe_and_size(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "folder.png").mkdir()
    for name, words in (("none.png", "no such file"), ("pipe.png", "regular file")):
        with pytest.raises(ImageError, match=words):
            read_picture(tmp_path / name)
    with pytest.raises(ImageError):
        read_picture(tmp_path / "folder.png")
    with pytest.raises(ImageError):
        read_picture("a\0b.png")
    (tmp_path / "p.png").write_bytes(png())
    with pytest.raises(ImageError, match="larger"):
        read_picture(tmp_path / "p.png", PictureLimits(max_bytes=20))


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.data())
@pytest.mark.req("REQ-08")
def test_flipped_bytes_give_a_picture_or_an_image_error(tmp_path, data):
    suffix, original = data.draw(
        st.sampled_from([(".png", png()), (".tif", _tiff()), (".npy", _npy(_GREY))])
    )
    damaged = bytearray(original)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / f"p{suffix}"
    path.write_bytes(bytes(damaged))
    try:
        pixels, _, _ = read_picture(path)
    except ImageError as error:
        assert "\n" not in str(error)
    else:
        assert np.isfinite(pixels).all()


@pytest.mark.parametrize("suffix", [".npy", ".tiff"])
def test_noise_about_zero_is_no_fault_of_a_difference(tmp_path, suffix):
    """A subtracted picture is as often below 0 as above it where there is no vessel."""
    picture = np.random.default_rng(5).normal(0, 0.1, (32, 48)).astype(np.float32)
    picture[10:14] += 2
    path = tmp_path / f"view{suffix}"
    path.write_bytes(_npy(picture) if suffix == ".npy" else _encoded(suffix, picture))
    with pytest.raises(ImageError, match="negative"):
        read_picture(path)
    pixels, depth, _ = read_picture(path, subtracted=True)
    np.testing.assert_array_equal(pixels, np.maximum(picture, 0))
    assert depth == 32
    # As far below as above is no noise: vessels are dark in it, say.
    path.write_bytes(_npy(-picture) if suffix == ".npy" else _encoded(suffix, -picture))
    with pytest.raises(ImageError, match="negative"):
        read_picture(path, subtracted=True)

"""What is read, and what is refused before a pixel is touched."""

import subprocess
import sys

import numpy as np
import pytest

pydicom = pytest.importorskip("pydicom", reason="needs the dicom extra")

from pydicom.encaps import encapsulate  # noqa: E402

from gcar_deploy.config import DicomLimits  # noqa: E402
from gcar_deploy.dicom.frames import Frames, stream_size  # noqa: E402
from gcar_deploy.dicom.header import is_dicom, read_header  # noqa: E402
from gcar_deploy.errors import ImageError  # noqa: E402
from tests.dicom.files import (  # noqa: E402
    SIDE,
    as_bytes,
    classic,
    jpeg_lossless,
    save,
    vessel_frames,
)


def refused(tmp_path, data, match, limits=None):
    path = tmp_path / "run.dcm"
    path.write_bytes(data)
    with pytest.raises(ImageError, match=match) as error:
        Frames(read_header(path, limits)).decode(0)
    assert "\n" not in str(error.value) and str(error.value).startswith("run.dcm: ")


def test_pixels_come_out_as_they_went_in(tmp_path):
    frames = vessel_frames(3, 1)
    run = Frames(read_header(save(classic(frames), tmp_path / "a.dcm")))
    assert len(run) == 3
    for k in range(3):
        np.testing.assert_array_equal(run.decode(k), frames[k])


def test_memory_that_runs_out_is_no_damage(tmp_path, monkeypatch):
    def full(*args, **kwargs):
        raise MemoryError

    path = save(classic(vessel_frames(1)), tmp_path / "a.dcm")
    header = read_header(path)
    run = Frames(header)
    monkeypatch.setattr(run._decoder, "as_array", full)
    monkeypatch.setattr(header.dataset, "get", full)
    monkeypatch.setattr(pydicom, "dcmread", full)
    for work in (lambda: read_header(path), lambda: header.find("Rows"), lambda: Frames(header),
                 lambda: run.decode(0)):  # fmt: skip
        with pytest.raises(MemoryError):
            work()


def test_jpeg_lossless(tmp_path):
    frames = vessel_frames(3, 1)
    plain = save(classic(frames), tmp_path / "a.dcm")
    packed = jpeg_lossless(plain, tmp_path / "b.dcm")
    run = Frames(read_header(packed))
    for k in range(3):
        np.testing.assert_array_equal(run.decode(k), frames[k])
    # A stream of another size than the header says never reaches the decoder.
    ds = pydicom.dcmread(packed)
    ds.Rows = ds.Columns = SIDE // 2
    refused(tmp_path, as_bytes(ds), "cannot be decoded")


def test_a_fragment_that_is_no_jpeg(tmp_path, capfd):
    """Its decoder would say so on stderr, beside the one line."""
    packed = jpeg_lossless(save(classic(vessel_frames(3, 1)), tmp_path / "a.dcm"), tmp_path / "b")
    ds = pydicom.dcmread(packed)
    ds.PixelData = encapsulate([b"no JPEG at all!!"] * 3)
    refused(tmp_path, as_bytes(ds), "cannot be decoded")
    assert capfd.readouterr().err == ""


def test_twelve_bits_and_an_overlay_above_them(tmp_path):
    frames = vessel_frames(2).astype(np.uint16) * 10
    ds = classic(frames | 0x8000, BitsStored=12, HighBit=11)
    run = Frames(read_header(save(ds, tmp_path / "a.dcm")))
    np.testing.assert_array_equal(run.decode(1), frames[1])


def test_twelve_bits_at_the_upper_end_and_an_overlay_below_them(tmp_path):
    frames = vessel_frames(2).astype(np.uint16) * 10
    ds = classic(frames << 4 | 0x5, BitsStored=12, HighBit=15)
    run = Frames(read_header(save(ds, tmp_path / "a.dcm")))
    np.testing.assert_array_equal(run.decode(1), frames[1])
    del ds.HighBit
    run = Frames(read_header(save(ds, tmp_path / "a.dcm")))
    np.testing.assert_array_equal(run.decode(1), (frames[1].astype(int) << 4 | 5) & 0xFFF)


def test_monochrome1_is_turned_round(tmp_path):
    frames = vessel_frames()
    ds = classic(frames, PhotometricInterpretation="MONOCHROME1")
    run = Frames(read_header(save(ds, tmp_path / "a.dcm")))
    np.testing.assert_array_equal(run.decode(0), 255.0 - frames[0])


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"SOPClassUID": "1.2.840.10008.5.1.4.1.1.2"}, "CT Image Storage; X-ray angiography"),
        ({"NumberOfFrames": 2001}, "2001 frames"),
        ({"NumberOfFrames": 0, "Rows": 8}, "64 x 8 pixels"),
        ({"Rows": 5000}, "64 x 5000"),
        ({"NumberOfFrames": -3}, "-3 frames"),
        ({"NumberOfFrames": 2}, "truncated"),
        ({"SamplesPerPixel": 3}, "colour"),
        ({"PixelRepresentation": 1}, "signed"),
        ({"BitsAllocated": 32, "BitsStored": 32}, "32 bits"),
        ({"BitsStored": 9}, "colour or signed"),
        ({"PhotometricInterpretation": "PALETTE COLOR"}, "colour or signed"),
        ({"HighBit": 6}, r"HighBit \(0028,0102\) = 6; for 8 bits stored it must be 7"),
        ({"HighBit": 8}, "HighBit"),
        ({"PhotometricInterpretation": ""}, r"has no PhotometricInterpretation \(0028,0004\)"),
    ],
)
@pytest.mark.req("REQ-10")
def test_out_of_bounds(tmp_path, changes, match):
    refused(tmp_path, as_bytes(classic(**changes)), match)


@pytest.mark.req("REQ-10")
def test_limits_on_bytes_and_on_all_pixels(tmp_path):
    data = as_bytes(classic())
    refused(tmp_path, data, "KiB that are read", DicomLimits(max_bytes=1000))
    refused(tmp_path, data, "million pixels", DicomLimits(max_pixels=100))


def test_damage(tmp_path):
    data = as_bytes(classic())
    refused(tmp_path, b"", "empty")
    refused(tmp_path, b"\x89PNG" + data[4:128] + b"NOPE" + data[132:], "not a DICOM file")
    refused(tmp_path, data[:-100], "truncated|no readable pixels")
    for end in range(280, data.index(b"\xe0\x7f\x10\x00"), 9):  # wherever the header is cut
        refused(tmp_path, data[:end], "ends before its pixels|damaged header")
    refused(tmp_path, data[:400], "truncated")
    silent = classic()
    del silent.PixelRepresentation
    refused(tmp_path, as_bytes(silent), r"has no PixelRepresentation \(0028,0103\)")
    deflated = classic()
    deflated.file_meta.TransferSyntaxUID = "1.2.840.10008.1.2.1.99"
    refused(tmp_path, as_bytes(deflated), "deflated")
    video = classic()
    video.PixelData = encapsulate([video.PixelData])
    video["PixelData"].VR = "OB"
    video.file_meta.TransferSyntaxUID = "1.2.840.10008.1.2.4.102"
    refused(tmp_path, as_bytes(video), "MPEG-4.*not supported")


@pytest.mark.parametrize("seed", range(40))
@pytest.mark.req("REQ-10")
def test_random_damage_is_one_line(tmp_path, seed):
    """Bytes turned over at random: read after all, or refused in one line; nothing else."""
    data = bytearray(as_bytes(classic(vessel_frames(2))))
    rng = np.random.default_rng(seed)
    for at in rng.integers(132, 1200, 6):
        data[at] = rng.integers(256)
    path = tmp_path / "run.dcm"
    path.write_bytes(bytes(data))
    from gcar_deploy.config import DicomOptions
    from gcar_deploy.dicom.scene import read_views
    from gcar_deploy.errors import GcarError

    try:
        read_views([path, path], DicomOptions())
    except GcarError as error:
        assert "\n" not in str(error) and len(str(error)) < 400


def test_stream_sizes():
    sof = b"\xff\xd8\xff\xe0\x00\x04ab\xff\xc3\x00\x0b\x08\x00\x20\x00\x40"
    assert stream_size(sof + b"\0" * 9) == (32, 64)
    siz = b"\xff\x4f\xff\x51\x00\x29\x00\x00" + b"".join(
        n.to_bytes(4, "big") for n in (70, 40, 6, 8)
    )
    assert stream_size(siz) == (32, 64)
    assert stream_size(b"\0\0run length") is None
    with pytest.raises(ValueError, match="frame header"):
        stream_size(b"\xff\xd8\xff\xd9")


def test_told_by_name_or_by_mark(tmp_path):
    path = save(classic(), tmp_path / "IM1")
    assert is_dicom(path) and is_dicom("missing.dcm")
    assert not is_dicom("missing") and not is_dicom(tmp_path)
    assert not is_dicom(path.rename(tmp_path / "a.png"))


def test_without_the_extra_one_line_names_it(tmp_path):
    path = save(classic(), tmp_path / "a.dcm")
    code = (
        "import sys; sys.modules['pydicom'] = None\n"
        "from gcar_deploy.cli.main import main\n"
        f"main(['geometry', 'from-dicom', {str(path)!r}, {str(path)!r}])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and "pip install 'gcar[dicom]'" in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.req("REQ-10")
def test_lengths_that_do_not_fit_their_kind_are_damage(tmp_path):
    """A number of three bytes, and a run whose pixels are an empty element."""
    data = as_bytes(classic())
    at = data.index(b"\x28\x00\x10\x00US\x02\x00")  # Rows
    odd = tmp_path / "odd.dcm"
    odd.write_bytes(
        data[: at + 6] + b"\x03\x00" + data[at + 8 : at + 10] + b"\x00" + data[at + 10 :]
    )
    with pytest.raises(ImageError, match="damaged header"):
        read_header(odd)
    at = data.index(b"\xe0\x7f\x10\x00")
    empty = tmp_path / "empty.dcm"
    empty.write_bytes(data[: at + 8] + b"\x00\x00\x00\x00")
    with pytest.raises(ImageError, match="pixels"):
        Frames(read_header(empty))

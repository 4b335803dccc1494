"""Decode single frames, after a look at what the compressed stream itself promises."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from io import BytesIO
from typing import Any

import numpy as np

from gcar_deploy.dicom.header import JPEG, Header
from gcar_deploy.errors import ImageError
from gcar_deploy.types import Image

#: JPEG markers that open a frame (SOF) carry its size; not DHT, JPG, DAC
_SOF = {*range(0xC0, 0xD0), 0xF7} - {0xC4, 0xC8, 0xCC}
#: how a stream of JPEG or JPEG-LS begins, one of JPEG 2000, and that as a file
_STREAMS = (b"\xff\xd8", b"\xff\x4f\xff\x51", b"\0\0\0\x0cjP  ")


class Frames:
    """Frames of one run, decoded one at a time.

    Parameters
    ----------
    header : Header
    check : called before each frame is decoded; what it raises ends the reading

    Raises
    ------
    ImageError
        There are no pixels, or fewer than the header promises.
    """

    def __init__(self, header: Header, check: Callable[[], None] | None = None) -> None:
        import pydicom
        from pydicom.pixels import get_decoder

        self.header, self._check = header, check
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self._dataset = pydicom.dcmread(BytesIO(header.data))
                self._decoder: Any = get_decoder(self._dataset.file_meta.TransferSyntaxUID)
                size = len(self._dataset.PixelData)
        except MemoryError:
            raise
        except Exception:  # noqa: BLE001 - pydicom's errors share no base class
            raise ImageError(f"{header.name}: has no readable pixels; export it again") from None
        self._packed = bool(self._decoder.is_encapsulated)
        promised = header.rows * header.columns * header.frames * header.bits // 8
        if not self._packed and size < promised:
            raise ImageError(
                f"{header.name}: is truncated ({size} of {promised} bytes of pixels); "
                "copy or export it again"
            )
        if not self._decoder.is_available:
            raise ImageError(
                f"{header.name}: no decoder for {self._decoder.UID.name} is installed; "
                "pip install 'gcar[dicom]'"
            )

    def __len__(self) -> int:
        return self.header.frames

    def decode(self, index: int) -> Image:
        """Return one frame (from 0) as (rows, columns) float32 counts.

        MONOCHROME1 is turned round, so that more counts are always brighter on the screen.

        Raises
        ------
        ImageError
            The frame is damaged or of another size than the header says.
        """
        if self._check is not None:
            self._check()
        header = self.header
        stored = int(self._dataset.BitsStored)
        high = self._dataset.get("HighBit")
        above = 0 if high is None else int(high) + 1 - stored
        try:
            if self._packed:
                self._check_stream(index)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                # Its own correction of unused bits cuts at the top, whatever HighBit says.
                pixels, _ = self._decoder.as_array(
                    self._dataset, index=index, raw=True, correct_unused_bits=False
                )
            pixels = np.asarray(pixels).astype(np.int64)
        except (ImageError, MemoryError):
            raise
        except Exception:  # noqa: BLE001 - pydicom's errors share no base class
            raise ImageError(
                f"{header.name}: frame {index + 1} cannot be decoded (damaged); export it again"
            ) from None
        if pixels.shape != (header.rows, header.columns):
            raise ImageError(f"{header.name}: frame {index + 1} has another size than its header")
        # Bits above those stored, and below them, may hold an overlay.
        pixels = (pixels >> above) & ((1 << stored) - 1)
        if header.text("PhotometricInterpretation") == "MONOCHROME1":
            pixels = (1 << stored) - 1 - pixels
        return pixels.astype(np.float32)

    def _check_stream(self, index: int) -> None:
        """Refuse a stream of another size before a decoder allocates for it."""
        from pydicom.encaps import get_frame

        stream = get_frame(self._dataset.PixelData, index, number_of_frames=self.header.frames)
        # Of what is none at all, the decoder writes to stderr before it fails.
        if self.header.syntax.startswith(JPEG) and not stream.startswith(_STREAMS):
            raise ValueError("no JPEG")
        size = stream_size(stream)
        if size is not None and size != (self.header.rows, self.header.columns):
            raise ValueError("size")


def stream_size(stream: bytes) -> tuple[int, int] | None:
    """(rows, columns) that a JPEG, JPEG-LS or JPEG 2000 stream announces; None if it does not.

    Raises
    ------
    ValueError
        A JPEG stream without a frame header.
    """
    if stream[:4] == b"\xff\x4f\xff\x51":  # JPEG 2000: SIZ follows at once
        x1, y1, x0, y0 = (int.from_bytes(stream[k : k + 4], "big") for k in (8, 12, 16, 20))
        return y1 - y0, x1 - x0
    if stream[:2] != b"\xff\xd8":
        return None
    at = 2
    while at + 9 <= len(stream):
        if stream[at] != 0xFF:
            break
        marker = stream[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker in _SOF:
            return (
                int.from_bytes(stream[at + 5 : at + 7], "big"),
                int.from_bytes(stream[at + 7 : at + 9], "big"),
            )
        at += 2 + int.from_bytes(stream[at + 2 : at + 4], "big")
    raise ValueError("a JPEG stream without a frame header")

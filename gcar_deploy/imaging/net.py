"""A small network that finds vessels: its input, its session, and lines from its answer.

The network sees the picture at a known pixel size, flattened twice and scaled, beside the ridge
response of the classical method: three channels that look much alike in generated and real
pictures, whatever the display did to the grey values. It answers how probably a pixel is vessel
and how long the chord through vessel is there, in pixel edges: a vessel's width is in the picture,
and a round vessel is as deep as it is wide.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from gcar_deploy.config import SEGMENTERS
from gcar_deploy.config.ranges import check_choice
from gcar_deploy.errors import ModelError
from gcar_deploy.imaging import enhance
from gcar_deploy.models import Kind, Session, read_model
from gcar_deploy.types import Array, Image, Mask

#: sides of the network's input are multiples of this
STRIDE = 16
#: what the spec of a fitting model says of its input
INPUT = {"channels": 3, "stride": STRIDE}
KIND = Kind("segmenter", "segmenter", INPUT)
#: finding where ``auto`` has no network
MISSING = f"{KIND.shipped}.onnx is not installed: vessels were found by the classical method alone"
OUTPUTS = ("probability", "chord")
#: the second flattening is this much wider than the first: borders of lung and heart stay
_WIDER = 4.0


def net_input(picture: Image, holes: Mask, pixel_mm: float) -> Array:
    """Make the network's input from a picture at working size.

    Parameters
    ----------
    picture : (rows, cols) float32, vessels bright
    holes : (rows, cols) bool, pixels without picture
    pixel_mm : float, pixel size at the isocentre

    Returns
    -------
    (3, rows, cols) float32
        asinh of the picture without what varies slowly and without what varies very slowly, in
        robust standard deviations, and the ridge response in units of its 99th percentile, 0 .. 2;
        0 where there is no picture. A gain or an offset of ``picture`` changes nothing.
    """
    filled = enhance.fill_holes(picture, holes)
    sigma = enhance.FLATTEN_SIGMA_MM / pixel_mm
    flat = enhance.flatten(filled, sigma)
    response = np.where(holes, np.float32(0), enhance.ridges(flat, pixel_mm).response)
    inside = ~holes if not holes.all() else np.ones_like(holes)
    low, middle = np.percentile(flat[inside], [16, 50])
    top = float(np.percentile(response[inside], 99))
    # Vessels are in the upper tail: the spread is that of what lies below the median.
    scale = np.float32(max(float(middle - low), 1e-9))
    near = np.arcsinh((flat - np.float32(middle)) / scale)
    wide = enhance.flatten(filled, _WIDER * sigma)
    far = np.arcsinh((wide - np.float32(np.median(wide[inside]))) / scale)
    ridge = np.clip(response / max(top, 1e-9), 0.0, 2.0)
    out = np.stack([near / 2, far / 2, ridge]).astype(np.float32)
    out[:, holes] = 0.0
    return out


@dataclasses.dataclass(frozen=True, eq=False)
class Seen:
    """Answer of the network.

    Attributes
    ----------
    probability : (rows, cols) float32, 0 .. 1, that the pixel is coronary vessel
    chord : (rows, cols) float32, >= 0, through vessel along the pixel's ray, pixel edges
    """

    probability: Image
    chord: Image


@dataclasses.dataclass(frozen=True, eq=False)
class Segmenter:
    """The segmentation network; safe to share between threads.

    Attributes
    ----------
    session : models.Session of it
    should_stop : ends a running inference, see ``models.Session.run``; None lets it run
    """

    session: Session
    should_stop: Callable[[], bool] | None = None

    def watched(self, should_stop: Callable[[], bool] | None) -> Segmenter:
        """Return the same network, whose inference ends soon after ``should_stop`` says so."""
        return dataclasses.replace(self, should_stop=should_stop)

    def look(self, channels: Array) -> Seen:
        """Return what the network sees in a picture.

        Parameters
        ----------
        channels : (3, rows, cols) float32, from ``net_input``

        Raises
        ------
        ModelError, NumericalError, CancelledError
            As ``models.Session.run``.
        """
        _, rows, cols = channels.shape
        down, right = -rows % STRIDE, -cols % STRIDE
        padded = np.stack(
            [cv2.copyMakeBorder(c, 0, down, 0, right, cv2.BORDER_REPLICATE) for c in channels]
        )
        shape = (1, 1, rows + down, cols + right)
        maps = self.session.run(
            {"channels": padded[None]}, [shape] * len(OUTPUTS),
            outputs=OUTPUTS, should_stop=self.should_stop,
        )  # fmt: skip
        return Seen(*(np.ascontiguousarray(m[0, 0, :rows, :cols], np.float32) for m in maps))


def open_segmenter(path: Path, *, threads: int = 2) -> Segmenter:
    """Read, verify and open a segmentation network.

    Raises
    ------
    ModelError
        As ``models.read_model`` and ``models.Session``.
    """
    model = read_model(path, (KIND,))
    return Segmenter(Session(model, ["channels"], threads=threads, arena=False))


def load_segmenter(wanted: str, threads: int = 2) -> Segmenter | None:
    """Open the shipped network where ``wanted`` needs it; None where ``auto`` finds none.

    Raises
    ------
    UsageError
        Nobody of that name finds vessels.
    ModelError
        ``net`` is wanted and the network is missing, or it is altered.
    """
    check_choice("segmenter", wanted, SEGMENTERS)
    path = KIND.path
    if wanted == "classic" or (path is None and wanted == "auto"):
        return None
    if path is None:
        raise ModelError("no segmentation network is installed with this version; use classic")
    return open_segmenter(path, threads=threads)

"""A small network that finds vessels: its input, its session, and lines from its answer.

The network sees the picture at a known pixel size, flattened twice and scaled, beside the ridge
response of the classical method: three channels that look much alike in generated and real
pictures, whatever the display did to the grey values. It answers how probably a pixel is vessel
and how long the chord through vessel is there, in pixel edges: a vessel's width is in the picture,
and a round vessel is as deep as it is wide.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from gcar_deploy.config import ImagingOptions
from gcar_deploy.errors import ModelError, NumericalError
from gcar_deploy.imaging import enhance
from gcar_deploy.types import Array, Image, Mask

#: sides of the network's input are multiples of this
STRIDE = 16
#: what the spec of a fitting model says of its input
INPUT = {"channels": 3, "stride": STRIDE}
OUTPUTS = ("probability", "chord")
#: the second flattening is this much wider than the first: borders of lung and heart stay
_WIDER = 4.0


def net_input(picture: Image, holes: Mask, pixel_mm: float, options: ImagingOptions) -> Array:
    """Make the network's input from a picture at working size.

    Parameters
    ----------
    picture : (rows, cols) float32, vessels bright
    holes : (rows, cols) bool, pixels without picture
    pixel_mm : float, pixel size at the isocentre
    options : ImagingOptions

    Returns
    -------
    (3, rows, cols) float32
        asinh of the picture without what varies slowly and without what varies very slowly, in
        robust standard deviations, and the ridge response in units of its 99th percentile, 0 .. 2;
        0 where there is no picture. A gain or an offset of ``picture`` changes nothing.
    """
    filled = enhance.fill_holes(picture, holes)
    sigma = options.flatten_sigma_mm / pixel_mm
    flat = enhance.flatten(filled, sigma)
    response = np.where(holes, np.float32(0), enhance.ridges(flat, pixel_mm, options).response)
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


class Segmenter:
    """A warm session of the segmentation network; safe to share between threads.

    Parameters
    ----------
    data : bytes of the ONNX file
    name : str, for messages
    threads : int, within one inference
    """

    def __init__(self, data: bytes, name: str, *, threads: int = 2) -> None:
        import onnxruntime as ort

        self.name = name
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        options.enable_cpu_mem_arena = False
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session: Any = ort.InferenceSession(
                data, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # noqa: BLE001 - ONNX Runtime's errors share no base class
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
            raise ModelError(f"model {name} does not load: {reason}") from None

    def run(self, outputs: Sequence[str] | None, feed: Mapping[str, Array]) -> list[Array]:
        """Run the graph on named inputs.

        Raises
        ------
        ModelError
            It cannot run on them.
        """
        try:
            found: list[Array] = self._session.run(outputs, dict(feed))
        except Exception as error:  # noqa: BLE001 - ONNX Runtime's errors share no base class
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
            raise ModelError(f"model {self.name} fails: {reason}") from None
        return found

    def output_names(self) -> list[str]:
        """Names of the graph's outputs."""
        return [node.name for node in self._session.get_outputs()]

    def look(self, channels: Array) -> Seen:
        """Return what the network sees in a picture.

        Parameters
        ----------
        channels : (3, rows, cols) float32, from ``net_input``

        Raises
        ------
        NumericalError
            The model returned what is not finite.
        """
        _, rows, cols = channels.shape
        down, right = -rows % STRIDE, -cols % STRIDE
        padded = np.stack(
            [cv2.copyMakeBorder(c, 0, down, 0, right, cv2.BORDER_REPLICATE) for c in channels]
        )
        maps = self.run(list(OUTPUTS), {"channels": padded[None]})
        for out in maps:
            if out.shape != (1, 1, rows + down, cols + right) or not np.isfinite(out).all():
                raise NumericalError(f"model {self.name} returned values that are not finite")
        return Seen(*(np.ascontiguousarray(m[0, 0, :rows, :cols], np.float32) for m in maps))

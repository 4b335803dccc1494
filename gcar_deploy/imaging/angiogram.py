"""Angiogram and VesselImage: pixels that never travel without their C-arm."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from gcar_deploy.errors import ImageError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging.chosen_frame import ChosenFrame
from gcar_deploy.types import Image, Mask

if TYPE_CHECKING:  # only a name in annotations: pictures need no scene file
    from gcar_deploy.geometry.scene import Intensity

#: longer side of the field at the isocentre where nothing is known of a picture, mm
DEFAULT_FIELD_MM = 150.0
#: kinds of intensity whose counts may be of any scale
_ANY_SCALE = ("attenuation", "raw")
#: largest counts between 2 to the minus this power and 2 to this power stay as they are
MOST_EXPONENT = 32


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Angiogram:
    """One picture as it was read, with the view that took it.

    Attributes
    ----------
    view_id : str
        Name of the view in the scene.
    carm : CArm
        The view; its rows and columns are those of ``pixels``.
    pixels : (rows, cols) float32
        Grey values in counts, finite.
    bit_depth : int
        Of the file: 8 or 16, 32 or 64 for floating-point arrays.
    intensity : Intensity
        What a count means.
    sha256 : str
        Of the bytes of the file.
    valid : (rows, cols) bool or None
        Where the file itself says that there is a picture (shutters); None for everywhere.
    mask : (rows, cols) bool or None
        Vessel as the user says; it wins over anything found in the pixels.
    mask_sha256 : str
        Of the bytes of the mask's file; empty without one.
    erased, painted : (rows, cols) bool or None
        What the user takes from, and adds to, the vessels that are found.
    frame : ChosenFrame or None
        Which frame of a run it is, where the program chose it.
    bare : tuple of (rows, cols) float32
        Frames of the same run before contrast came; what is a line there is no vessel.
    file : str
        Name of the file that it was read from; empty for an array.
    enlarged : float
        How many times as many rows it has as the geometry says; below 1 it was made smaller. On
        square pixels that are finer than those that came, as many times more.
    """

    view_id: str
    carm: CArm
    pixels: Image
    bit_depth: int
    intensity: Intensity
    sha256: str
    valid: Mask | None = None
    mask: Mask | None = None
    erased: Mask | None = None
    painted: Mask | None = None
    frame: ChosenFrame | None = None
    bare: tuple[Image, ...] = ()
    file: str = ""
    enlarged: float = 1.0
    mask_sha256: str = ""

    def __post_init__(self) -> None:
        _check_shape(self.view_id, self.carm, self.pixels)
        for array in (self.valid, self.mask, self.erased, self.painted, *self.bare):
            if array is not None:
                _check_shape(self.view_id, self.carm, array)

    def in_range(self) -> Angiogram:
        """Return the picture with counts whose squares single precision holds.

        Only counts whose scale says nothing are scaled, and only where they need it; by a power
        of two, so that each keeps its digits.
        """
        if self.intensity.kind not in _ANY_SCALE:
            return self
        exponent = math.frexp(max(float(one.max()) for one in (self.pixels, *self.bare)))[1]
        if abs(exponent) <= MOST_EXPONENT:
            return self
        pixels, *bare = (np.ldexp(one, -exponent) for one in (self.pixels, *self.bare))
        return dataclasses.replace(self, pixels=pixels, bare=tuple(bare))

    @classmethod
    def without_geometry(
        cls,
        view_id: str,
        picture: tuple[Image, int, str],
        intensity: Intensity,
        pixel_mm: float | None = None,
    ) -> Angiogram:
        """Wrap what ``read_picture`` gave for looking at one picture alone.

        The view is frontal; ``pixel_mm`` is the pixel size at the isocentre, by default that
        of a field of ``DEFAULT_FIELD_MM``.
        """
        pixels, bit_depth, sha256 = picture
        rows, columns = pixels.shape
        at_detector = (pixel_mm or DEFAULT_FIELD_MM / max(rows, columns)) * 4 / 3
        carm = CArm(
            primary_angle_deg=0.0,
            secondary_angle_deg=0.0,
            sod_mm=750.0,
            sdd_mm=1000.0,
            rows=rows,
            columns=columns,
            pixel_spacing_mm=(at_detector, at_detector),
        )
        return cls(
            view_id=view_id,
            carm=carm,
            pixels=pixels,
            bit_depth=bit_depth,
            intensity=intensity,
            sha256=sha256,
        )

    @property
    def label(self) -> str:
        """Which view it is, and of which file: for messages."""
        return f"view {self.view_id} ({self.file})" if self.file else f"view {self.view_id}"


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class VesselImage:
    """What is vessel in one view, and how much of it each ray crosses.

    Attributes
    ----------
    view_id : str
    carm : CArm
        Its rows and columns are those of the arrays.
    path_mm : (rows, cols) float32
        Millimetres of vessel along the ray of each pixel (mean over the pixel), 0 away from
        vessels. An estimate unless ``calibrated``.
    path_error : float
        Relative standard deviation of a path; 0 only for ``path_length`` pictures, whose scale
        was given: these are ``calibrated``.
    noise_mm : float
        Deviation of the noise of a ``path_length`` picture's pixel; 0 where it does not matter.
    others : tuple of VesselImage
        What each method alone sees, where this is a fusion of several.
    mask, skeleton, valid : (rows, cols) bool
        Vessel as an observer draws it, at times less than ``path_mm`` covers; its
        one-pixel-wide centreline; pixels that carry a picture (no collimator).
    kind : str
        ``path_length``, ``attenuation``, ``raw`` or ``mask``.
    vesselness : (rows, cols) float32 or None
        Ridge response; None where the picture needed no enhancement.
    catheter : (rows, cols) bool or None
        What was taken for a catheter and left out of the mask; None where nobody looked.
    catheter_mm : float
        Length of its line.
    device : (rows, cols) float32 or None
        Probability of catheter, lead or wire; None where no network was asked.
    by_network : bool
        Whether the network's word is in it.
    painted : (rows, cols) bool or None
        Vessel that a person drew: as wide as drawn, whatever the picture shows.
    kept : callable or None
        Gives the same with nothing taken for a device, where something was: few pairs ask. It is
        made once, however often it is asked for.
    enlarged : float
        As of the ``Angiogram``, for ``calibrated`` ones.
    """

    view_id: str
    carm: CArm
    path_mm: Image
    path_error: float
    mask: Mask
    skeleton: Mask
    valid: Mask
    kind: str
    vesselness: Image | None = None
    catheter: Mask | None = None
    catheter_mm: float = 0.0
    device: Image | None = None
    by_network: bool = False
    painted: Mask | None = None
    noise_mm: float = 0.0
    others: tuple[VesselImage, ...] = ()
    kept: Callable[[], VesselImage] | None = None
    enlarged: float = 1.0

    def __post_init__(self) -> None:
        masks = (self.mask, self.skeleton, self.valid, self.catheter, self.painted)
        for array in (self.path_mm, *masks, self.device):
            if array is not None:
                _check_shape(self.view_id, self.carm, array)
        if self.kept is not None and not hasattr(self.kept, "cache_info"):
            object.__setattr__(self, "kept", functools.cache(self.kept))

    @property
    def calibrated(self) -> bool:
        """Whether paths are true millimetres."""
        return self.path_error == 0


def _check_shape(view_id: str, carm: CArm, array: Image | Mask) -> None:
    if array.shape != (carm.rows, carm.columns):
        raise ImageError(
            f"view {view_id}: the picture has {array.shape} (rows, columns), the geometry says "
            f"{(carm.rows, carm.columns)}"
        )

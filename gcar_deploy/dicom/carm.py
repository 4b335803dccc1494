"""The geometry of one frame: attributes of the header to a CArm, with what is worth saying.

DICOM's positioner angles are the contract's (LAO and cranial positive), ``ImagerPixelSpacing`` is
the spacing at the detector. ``PixelSpacing`` is a calibration in the patient and never used.
"""

from __future__ import annotations

import math

from gcar_deploy.config import DicomOptions
from gcar_deploy.dicom.header import Header, tag
from gcar_deploy.errors import GeometryError
from gcar_deploy.geometry.carm import CArm

#: tilt of the detector against the beam: said above the first, refused above the second
_GOOD_TILT_DEG, _MAX_TILT_DEG = 0.1, 1.0
#: share by which SDD / SOD may differ from the file's own magnification factor
_MAGNIFICATION_SHARE = 0.02
#: share by which a given spacing may differ from that of the field of view, told in whole mm
_FIELD_SHARE = 0.1
_WAY_OUT = "give the geometry with --geom"


def frame_carm(header: Header, frame: int, options: DicomOptions) -> tuple[CArm, list[str]]:
    """Read the C-arm of one frame.

    Parameters
    ----------
    header : Header
    frame : int, from 0
    options : DicomOptions; what they supply is used only where the file is silent

    Returns
    -------
    carm : CArm of the frame as ``scene.read_run`` hands its pixels on (horizontal flip undone)
    notes : sentences, without the file's name

    Raises
    ------
    GeometryError
        An attribute is missing (named with the option that supplies it), out of range, or says
        that the beam is no cone that meets the detector at a right angle.
    """
    try:
        notes: list[str] = []
        primary, secondary = _angles(header, frame, notes)
        sod, sdd = _distances(header, frame, options, notes)
        spacing = _spacing(header, frame, options, notes)
        _check_tilt(header, frame, notes)
        rotation = _rotation(header, frame, notes)
        carm = CArm(
            primary_angle_deg=primary,
            secondary_angle_deg=secondary,
            detector_rotation_deg=float(rotation),
            sod_mm=sod,
            sdd_mm=sdd,
            rows=header.rows,
            columns=header.columns,
            pixel_spacing_mm=spacing,
            principal_point_px=_principal_point(header, frame, spacing, rotation, notes),
        )
    except GeometryError as error:
        text = str(error)
        raise GeometryError(
            text if text.startswith(header.name) else f"{header.name}: {text}"
        ) from None
    return carm, notes


def unsaid(header: Header) -> tuple[str, ...]:
    """Name the fields of ``DicomOptions`` that must say what the header of a run does not."""
    own = {
        "pixel_spacing_mm": header.pair("ImagerPixelSpacing"),
        "sod_mm": _own_sod(header, 0),
    }
    return tuple(key for key, value in own.items() if not value)


def is_flipped(header: Header, frame: int) -> bool:
    """Whether the pixels are a mirror image of what the detector saw."""
    return header.text("FieldOfViewHorizontalFlip", frame) == "YES"


def _angles(header: Header, frame: int, notes: list[str]) -> tuple[float, float]:
    found = []
    for axis in ("Primary", "Secondary"):
        keyword = f"Positioner{axis}Angle"
        angle = header.number(keyword, frame)
        if angle is None:
            angle = _isocenter_angle(header, keyword, axis, frame, notes)
        if not header.enhanced:
            angle += _increment(header, keyword, frame, notes)
        found.append(angle)
    # Sums of angle and increment may pass the back; the direction is the same.
    primary = found[0] if abs(found[0]) <= 180.0 else (found[0] + 180.0) % 360.0 - 180.0
    return primary, found[1]


def _isocenter_angle(
    header: Header, keyword: str, axis: str, frame: int, notes: list[str]
) -> float:
    """Angle against the room, which is the one against a patient who lies head first, supine."""
    other = f"PositionerIsocenter{axis}Angle"
    angle = header.number(other, frame)
    if angle is None:
        raise GeometryError(f"{tag(keyword)} is missing; {_WAY_OUT}")
    position = header.text("PatientPosition", frame)
    if position not in ("", "HFS"):
        raise GeometryError(
            f"{tag(keyword)} is missing, and {tag(other)} counts from the room: that is the "
            f"patient only with {tag('PatientPosition')} = HFS, not {position[:16]}; {_WAY_OUT}"
        )
    tilts = (
        f"Table{kind}Angle" for kind in ("HorizontalRotation", "HeadTilt", "CradleTilt")
        if header.number(f"Table{kind}Angle", frame)
    )  # fmt: skip
    tilted = "".join(f"; {tag(key)} is not applied" for key in tilts)
    notes.append(
        f"{tag(keyword)} is missing, {tag(other)} is taken for it: right for a patient who lies "
        f"head first, supine, on a level table{tilted}"
    )
    return angle


def _increment(header: Header, keyword: str, frame: int, notes: list[str]) -> float:
    """Angle of a frame against the first (PS3.3 C.8.7.5.1.3).

    One value is the change from frame to frame, as many as frames are offsets from the first. They
    mean something in dynamic runs alone, but not every file says that its run is one.
    """
    motion, steps = header.text("PositionerMotion"), header.numbers(keyword + "Increment")
    if motion == "STATIC":
        if steps is not None and any(steps):
            notes.append(
                f"{tag(keyword + 'Increment')} is not used: {tag('PositionerMotion')} = STATIC, "
                "the C-arm stood still"
            )
        return 0.0
    if steps is None and (frame == 0 or motion != "DYNAMIC"):
        return 0.0
    if steps is None:
        raise GeometryError(
            f"the C-arm moved during the run, and {tag(keyword + 'Increment')} is missing: the "
            f"angles of frame {frame + 1} are unknown; use --frame 1, or {_WAY_OUT}"
        )
    if len(steps) == 1:
        return frame * steps[0]
    if len(steps) != header.frames:
        raise GeometryError(
            f"{tag(keyword + 'Increment')} holds {len(steps)} values for {header.frames} frames"
        )
    return steps[frame]


def _distances(
    header: Header, frame: int, options: DicomOptions, notes: list[str]
) -> tuple[float, float]:
    sdd = header.number("DistanceSourceToDetector", frame)
    if not sdd:
        raise GeometryError(f"{tag('DistanceSourceToDetector')} is missing; {_WAY_OUT}")
    factor = header.number("EstimatedRadiographicMagnificationFactor", frame)
    sod = _own_sod(header, frame)
    if not sod and options.sod_mm is None:
        hint = f" (its magnification factor suggests {sdd / factor:.0f})" if factor else ""
        raise GeometryError(
            f"{tag('DistanceSourceToPatient')}, source to isocentre, is missing; "
            f"give it with --sod MM (sod_mm of an order){hint}"
        )
    if sod and options.sod_mm is not None and abs(sod - options.sod_mm) > 0.5:
        notes.append(f"says {sod:g} mm source to isocentre itself; --sod is not used for it")
    sod = sod or float(options.sod_mm or 0.0)
    if factor and abs(sdd / sod / factor - 1.0) > _MAGNIFICATION_SHARE:
        notes.append(
            f"{tag('EstimatedRadiographicMagnificationFactor')} = {factor:g} is at odds with "
            f"SDD / SOD = {sdd / sod:.3f}: is one of the distances to something else?"
        )
    return sod, sdd


def _own_sod(header: Header, frame: int) -> float | None:
    sod = header.number("DistanceSourceToIsocenter", frame)
    return sod or header.number("DistanceSourceToPatient", frame)


def _spacing(
    header: Header, frame: int, options: DicomOptions, notes: list[str]
) -> tuple[float, float]:
    own, given = header.pair("ImagerPixelSpacing", frame), options.pixel_spacing_mm
    if own is None and given is None:
        calibrated = header.find("PixelSpacing", frame) is not None
        why = (
            f"; {tag('PixelSpacing')} is a calibration in the patient and no substitute"
            if calibrated
            else ""
        )
        raise GeometryError(
            f"{tag('ImagerPixelSpacing')}, pixel spacing at the detector, is missing; "
            f"give it with --pixel-spacing MM (pixel_spacing_mm of an order){why}"
        )
    if own is None:
        side = float(given or 0.0)
        _check_field(header, frame, side, notes)
        return side, side
    if given is not None and max(abs(x / given - 1.0) for x in own) > 1e-3:
        notes.append(f"says {own[0]:g} mm pixel spacing itself; --pixel-spacing is not used for it")
    return own


def _check_field(header: Header, frame: int, given: float, notes: list[str]) -> None:
    """Note a given spacing that is at odds with the size of the field that the file tells.

    Only a rectangle's: a round field need not fill the picture, which says nothing of its pixels.
    """
    try:
        told = header.numbers("FieldOfViewDimensions", frame) or ()
    except GeometryError:  # no geometry hangs on it
        return
    if len(told) != 2 or header.text("FieldOfViewShape", frame) != "RECTANGLE" or min(told) <= 0:
        return
    sides = ("rows", told[0], header.rows), ("columns", told[1], header.columns)
    for name, size, count in sides:
        spacing = size / count
        if abs(given / spacing - 1.0) > _FIELD_SHARE:
            notes.append(
                f"--pixel-spacing {given:g} mm is at odds with {tag('FieldOfViewDimensions')}: "
                f"{size:g} mm over {count} {name} are {spacing:.3g} mm each"
            )
            return


def _check_tilt(header: Header, frame: int, notes: list[str]) -> None:
    for keyword in ("DetectorPrimaryAngle", "DetectorSecondaryAngle"):
        tilt = header.number(keyword, frame) or 0.0
        if abs(tilt) > _MAX_TILT_DEG:
            raise GeometryError(
                f"{tag(keyword)} = {tilt:g} deg: the detector is tilted against the beam "
                f"(at most {_MAX_TILT_DEG:g} deg); {_WAY_OUT} and a projection_matrix"
            )
        if abs(tilt) > _GOOD_TILT_DEG:
            notes.append(f"{tag(keyword)} = {tilt:g} deg is neglected")


def _rotation(header: Header, frame: int, notes: list[str]) -> int:
    """Clockwise turn of the stored picture against the detector: 0, 90, 180 or 270 deg."""
    turned = header.number("FieldOfViewRotation", frame) or 0.0
    if turned not in (0.0, 90.0, 180.0, 270.0):
        raise GeometryError(
            f"{tag('FieldOfViewRotation')} = {turned:g} deg must be 0, 90, 180 or 270"
        )
    if turned:
        # Content turned clockwise: the axes turn counter-clockwise, as detector_rotation_deg does.
        notes.append(f"the picture is taken as turned by {turned:g} deg against the detector")
    if is_flipped(header, frame):
        notes.append("the picture is stored as a mirror image; it was turned back")
    own = header.number("PositionerIsocenterDetectorRotationAngle", frame) or 0.0
    if own:
        notes.append(
            f"{tag('PositionerIsocenterDetectorRotationAngle')} = {own:g} deg is not applied"
        )
    return int(turned)


def _principal_point(
    header: Header, frame: int, spacing: tuple[float, float], rotation: int, notes: list[str]
) -> tuple[float, float] | None:
    """(col, row) of the isocentre in the picture, flip undone; None for the picture's middle.

    ``PositionOfIsocenterProjection`` and ``FieldOfViewOrigin`` count detector elements (row,
    column) from the detector's first corner, before the picture was turned or flipped.
    """
    center = header.pair("PositionOfIsocenterProjection", frame)
    origin = header.pair("FieldOfViewOrigin", frame)
    element = header.pair("DetectorElementSpacing", frame)
    if center is None and (origin is None or origin == (0.0, 0.0)):
        return None
    if center is None and element is not None:
        size = header.pair("PhysicalDetectorSize", frame)
        size = size or header.pair("DetectorActiveDimensions", frame)
        if size is not None:
            center = ((size[0] / element[0] - 1) / 2, (size[1] / element[1] - 1) / 2)
    if center is None or element is None or min(element) <= 0:
        notes.append(
            f"{tag('FieldOfViewOrigin')} or {tag('PositionOfIsocenterProjection')} is given, but "
            "not the detector that it counts on: the isocentre is taken to project into the "
            "picture's middle"
        )
        return None
    turned = rotation in (90, 270)
    rows, columns = (header.columns, header.rows) if turned else (header.rows, header.columns)
    own = spacing[::-1] if turned else spacing
    origin = origin or (0.0, 0.0)
    row, col = ((center[k] - origin[k] + 0.5) * element[k] / own[k] - 0.5 for k in range(2))
    if rotation == 90:
        row, col = col, rows - 1 - row
    elif rotation == 180:
        row, col = rows - 1 - row, columns - 1 - col
    elif rotation == 270:
        row, col = columns - 1 - col, row
    if not all(math.isfinite(x) for x in (row, col)):
        raise GeometryError(f"{tag('PositionOfIsocenterProjection')} is not finite")
    return col, row

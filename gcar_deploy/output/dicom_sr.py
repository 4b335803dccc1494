"""Measurements of a result as a Comprehensive 3D SR (PS3.3 A.35.13, PS3.16 TID 1500), by highdicom.

One group of measurements a branch, then one for each further lesion. A diameter says where along
the vessel it was measured, as a code of the vascular measurement sites (PS3.16 CID 3486) and as a
point in patient coordinates (mm LPS, the frame of reference of the surface). What the standard has
no code for is of scheme ``99GCAR``. Neither verified nor final: whoever files it may do that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from gcar_deploy.errors import UsageError
from gcar_deploy.output.stored import Stored
from gcar_deploy.output.words import GHOST
from gcar_deploy.tree.tree import Branch

_TITLE = "Coronary measurements, research use only"
_SCHEME = "99GCAR"
#: name of a branch -> keyword in pydicom's SNOMED codes
_VESSELS = {
    "LM": "LeftMainCoronaryArtery", "LAD": "LeftAnteriorDescendingCoronaryArtery",
    "LCx": "CircumflexCoronaryArtery", "RCA": "RightCoronaryArtery", None: "CoronaryArtery",
}  # fmt: skip


def measurement_report(
    stored: Stored, runs: Sequence[Any], frame: str, series: tuple[str, int]
) -> Any:
    """Return the data set of a report.

    Parameters
    ----------
    stored : what the result folder holds
    runs : headers of the pictures that it was made from, of one study
    frame : UID of the frame of reference of the coordinates
    series : UID and number of its series

    Raises
    ------
    UsageError
        highdicom is not installed, or the runs are of several studies.
    """
    try:
        import highdicom as hd
    except ModuleNotFoundError:
        raise UsageError("highdicom is not installed: pip install 'gcar[sr]'") from None
    from pydicom.sr.codedict import codes
    from pydicom.uid import generate_uid

    if len({str(run.StudyInstanceUID) for run in runs}) > 1:
        raise UsageError("the runs are of several studies: a report belongs to one")
    observer = hd.sr.ObserverContext(
        observer_type=codes.DCM.Device,
        observer_identifying_attributes=hd.sr.DeviceObserverIdentifyingAttributes(
            uid=generate_uid(entropy_srcs=["gcar", version("gcar")]), name="gcar",
            manufacturer_name="gcar", model_name="gcar",
        ),
    )  # fmt: skip
    content = hd.sr.MeasurementReport(
        observation_context=hd.sr.ObservationContext(observer_device_context=observer),
        procedure_reported=codes.SCT.CoronaryArteriography,
        title=codes.DCM.ImagingMeasurementReport,
        imaging_measurements=[
            *(_group(stored, k, frame, runs) for k in range(len(stored.tree.branches))),
            *_further_lesions(stored, frame, runs),
        ],
    )  # fmt: skip
    said = stored.summary
    # The first finding is the sentence. Notes say what goes back to strokes and marks of the user.
    told = [*said["findings"][1:], *said["notes"], *said["silent_errors"]]
    sentences = [f"{said['status']}: {said['sentence']}", *told, said["use"]]
    for text in sentences:
        content[0].ContentSequence.append(_comment(text))
    report = hd.sr.Comprehensive3DSR(
        evidence=list(runs), content=content[0], series_instance_uid=series[0],
        series_number=series[1], sop_instance_uid=generate_uid(), instance_number=1,
        manufacturer="gcar", is_complete=True,
    )  # fmt: skip
    report.SeriesDescription = _TITLE
    # Type 2: present, and empty where the runs do not tell.
    if "ReferencedPerformedProcedureStepSequence" not in report:
        report.ReferencedPerformedProcedureStepSequence = []
    return report


def _group(stored: Stored, k: int, frame: str, runs: Sequence[Any]) -> Any:
    """Measurements of one branch."""
    from pydicom.sr.codedict import codes

    branch, row = stored.tree.branches[k], stored.summary["tree"]["branches"][k]
    lesion = row.get("lesion_mm") or (None, None)
    vessel = getattr(codes.SCT, _VESSELS[row["name"]])
    diameter, sct, dcm = codes.SCT.VesselLumenDiameter, codes.SCT, codes.DCM
    measured = [
        (row["minimal_diameter_mm"], row["minimal_at_mm"], dcm.SiteOfLumenMinimum),
        (row.get("proximal_reference_mm"), lesion[0], dcm.ProximalReference),
        (row.get("distal_reference_mm"), lesion[1], dcm.DistalReference),
    ]
    found = [
        *(_at(diameter, value, vessel, site, _point(branch, at_mm, frame))
          for value, at_mm, site in measured if value is not None and at_mm is not None),
        _number(_own("SIGMA", "Standard deviation of the least diameter"),
                row.get("minimal_sigma_mm"), "mm"),
        _number(sct.LumenDiameterStenosis, row["stenosis_percent"], "%"),
        _number(sct.LumenAreaStenosis, row.get("area_stenosis_percent"), "%"),
        _number(sct.StenoticLesionLength, row["lesion_length_mm"] or None, "mm"),
        _number(sct.LengthOfVesselSegment, row["length_mm"], "mm"),
        _number(_reference(), row["reference_diameter_mm"], "mm"),
        _number(_own("GHOST", GHOST.capitalize()),
                _percent(row.get("ghost_probability")), "%"),
        _number(_own("NAME", "Probability of the name of the vessel"),
                _percent(row.get("name_confidence")), "%"),
    ]  # fmt: skip
    narrowed = (row["stenosis_percent"] or 0.0) > 0 and row["lesion_length_mm"]
    finding = sct.Stenosis if narrowed else sct.LumenOfBloodVessel
    return _measurements(_title(row, k), finding, vessel, found, runs)


def _further_lesions(stored: Stored, frame: str, runs: Sequence[Any]) -> list[Any]:
    """One group for each lesion beside the gravest, of which the branch's own group tells."""
    from pydicom.sr.codedict import codes

    sct, out = codes.SCT, []
    for k, row in enumerate(stored.summary["tree"]["branches"]):
        vessel = getattr(sct, _VESSELS[row["name"]])
        for number, one in enumerate((row.get("lesions") or ())[1:], start=2):
            first, last = one["lesion_mm"]
            point = _point(stored.tree.branches[k], one["minimal_at_mm"], frame)
            found = [
                _at(sct.VesselLumenDiameter, one["minimal_diameter_mm"], vessel,
                    codes.DCM.SiteOfLumenMinimum, point),
                _number(sct.LumenDiameterStenosis, one["stenosis_percent"], "%"),
                _number(sct.StenoticLesionLength, last - first, "mm"),
                _number(_reference(), one["reference_diameter_mm"], "mm"),
            ]  # fmt: skip
            name = f"{_title(row, k)}, lesion {number}"
            out.append(_measurements(name, sct.Stenosis, vessel, found, runs))
    return out


def _title(row: Mapping[str, Any], k: int) -> str:
    return f"branch {k + 1}" + (f", {row['name']}" if row["name"] else "")


def _measurements(
    name: str, finding: Any, vessel: Any, found: Sequence[Any], runs: Sequence[Any]
) -> Any:
    """Group of what was measured at one finding of a vessel; None stands for no value."""
    import highdicom as hd
    from pydicom.uid import generate_uid

    return hd.sr.MeasurementsAndQualitativeEvaluations(
        tracking_identifier=hd.sr.TrackingIdentifier(uid=generate_uid(), identifier=name),
        finding_type=finding,
        finding_sites=[hd.sr.FindingSite(anatomic_location=vessel)],
        algorithm_id=hd.sr.AlgorithmIdentification(name="gcar", version=version("gcar")),
        measurements=[one for one in found if one is not None],
        source_images=[
            hd.sr.SourceImageForMeasurementGroup(str(run.SOPClassUID), str(run.SOPInstanceUID))
            for run in runs
        ],
    )


def _at(name: Any, value: float, vessel: Any, site: Any, point: Any) -> Any:
    """Measurement at a site of a vessel, with the point where it was taken."""
    import highdicom as hd

    where = hd.sr.FindingSite(anatomic_location=vessel, topographical_modifier=site)
    return _number(name, value, "mm", finding_sites=[where], referenced_coordinates=[point])


def _point(branch: Branch, at_mm: float, frame: str) -> Any:
    import highdicom as hd

    place = [float(np.interp(at_mm, branch.arc_mm, axis)) for axis in branch.points_mm.T]
    return hd.sr.CoordinatesForMeasurement3D("POINT", np.array([place]), frame)


def _number(name: Any, value: float | None, unit: str, **more: Any) -> Any:
    """Measurement, or None where there is no value."""
    import highdicom as hd
    from pydicom.sr.codedict import codes

    if value is None:
        return None
    units = codes.UCUM.Percent if unit == "%" else codes.UCUM.Millimeter
    return hd.sr.Measurement(name=name, value=round(float(value), 3), unit=units, **more)


def _comment(text: str) -> Any:
    import highdicom as hd
    from pydicom.sr.codedict import codes

    return hd.sr.TextContentItem(
        name=codes.DCM.Comment, value=text, relationship_type=hd.sr.RelationshipTypeValues.CONTAINS
    )


def _own(value: str, meaning: str) -> Any:
    import highdicom as hd

    return hd.sr.CodedConcept(value=value, scheme_designator=_SCHEME, meaning=meaning)


def _reference() -> Any:
    return _own("REFERENCE", "Healthy diameter at the narrowing")


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share

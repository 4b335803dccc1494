"""Result as DICOM objects: what another reader finds in them, and what a validator says."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import shutil
import subprocess
import warnings

import numpy as np
import pytest

pytest.importorskip("pydicom", reason="needs the dicom extra")
pytest.importorskip("highdicom", reason="needs the sr extra")

import highdicom as hd
import pydicom
from pydicom.sr.codedict import codes
from pydicom.uid import generate_uid

from gcar_deploy.errors import UsageError
from gcar_deploy.output.dicom_sr import measurement_report
from gcar_deploy.output.dicom_study import _EMPTY, file_bytes, study_objects
from gcar_deploy.output.stored import read_folder
from tests.cli.conftest import gcar
from tests.dicom.made_result import named, of_jane, result_of

PDF = b"%PDF-1.4\n1 0 obj << >> endobj\ntrailer << >>\n%%EOF"
VALIDATOR = shutil.which("dciodvfy")
#: what only the archive knows, or each maker names for itself
_NO_ERROR = ("99GCAR", "DICOMDIR")


@pytest.fixture(scope="module")
def jane(tmp_path_factory):
    return of_jane(tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="module")
def result(jane, tmp_path_factory):
    return result_of(jane, tmp_path_factory.mktemp("result") / "out")


@pytest.fixture(scope="module")
def archive(result, jane, tmp_path_factory):
    """Folder that ``gcar dicom`` wrote."""
    room = tmp_path_factory.mktemp("archive")
    (room / "p.pdf").write_bytes(PDF)
    done = gcar("dicom", result, *jane, "--pdf", room / "p.pdf", "--out", room / "out")
    assert done.code == 0, done.err
    return room / "out"


@pytest.mark.slow
def test_every_object_belongs_to_the_study_and_names_its_patient(archive, jane):
    run = pydicom.dcmread(jane[0])
    found = {path.name: pydicom.dcmread(path) for path in archive.glob("*.dcm")}
    assert sorted(found) == ["measurements.dcm", "overlay_view1.dcm", "overlay_view2.dcm",
                             "page.dcm", "surface.dcm"]  # fmt: skip
    for data in found.values():
        for keyword in ("PatientName", "PatientID", "StudyInstanceUID", "StudyDate",
                        "AccessionNumber"):  # fmt: skip
            assert data[keyword].value == run[keyword].value
        assert data.SeriesInstanceUID != run.SeriesInstanceUID and "OperatorsName" not in data
    page = found["page.dcm"]
    assert page.EncapsulatedDocument[: page.EncapsulatedDocumentLength] == PDF
    assert len({data.SeriesInstanceUID for data in found.values()}) == 4


def test_the_report_says_what_the_result_says_and_where(archive, result, jane):
    """Read back by highdicom: one group a branch, values of result.json, points on the line."""
    report = hd.sr.srread(archive / "measurements.dcm")
    stored = read_folder(result)
    groups = report.content.get_image_measurement_groups()
    rows = stored.summary["tree"]["branches"]
    assert len(groups) == len(rows) > 1
    points = 0
    for k, (group, row) in enumerate(zip(groups, rows, strict=True)):
        assert group.tracking_identifier.split(",")[0] == f"branch {k + 1}"
        for code, key in (
            (codes.SCT.LumenDiameterStenosis, "stenosis_percent"),
            (codes.SCT.LumenAreaStenosis, "area_stenosis_percent"),
            (codes.SCT.LengthOfVesselSegment, "length_mm"),
        ):
            told = [m.value for m in group.get_measurements(code)]
            assert told == ([] if row[key] is None else [pytest.approx(row[key], abs=6e-4)])
        diameters = {
            m.finding_sites[0].topographical_modifier.value: m
            for m in group.get_measurements(codes.SCT.VesselLumenDiameter)
        }
        assert ("122382" in diameters) == (row["minimal_diameter_mm"] is not None)
        for measured in diameters.values():
            (place,) = measured.referenced_coordinates
            gap = np.linalg.norm(stored.tree.branches[k].points_mm - place.value, axis=1).min()
            assert gap < 0.5
            points += 1
        if "122382" in diameters:
            least = diameters["122382"]
            assert least.value == pytest.approx(row["minimal_diameter_mm"], abs=6e-4)
            branch = stored.tree.branches[k]
            near = np.linalg.norm(branch.points_mm - least.referenced_coordinates[0].value, axis=1)
            assert abs(branch.arc_mm[near.argmin()] - row["minimal_at_mm"]) < 0.6
    assert points
    said = comments(report)
    assert said[0] == "{status}: {sentence}".format(**stored.summary)
    assert "Research use only" in said[-1]
    assert report.VerificationFlag == "UNVERIFIED"
    evidence = report.CurrentRequestedProcedureEvidenceSequence[0].ReferencedSeriesSequence
    told = {s.ReferencedSOPInstanceUID for series in evidence for s in series.ReferencedSOPSequence}
    assert told == {pydicom.dcmread(run).SOPInstanceUID for run in jane}
    surface = pydicom.dcmread(archive / "surface.dcm")
    first = next(iter(groups[0].get_measurements(codes.SCT.VesselLumenDiameter)))
    assert first.referenced_coordinates[0].frame_of_reference_uid == surface.FrameOfReferenceUID


def comments(report):
    return [
        item.TextValue
        for item in report.ContentSequence
        if (item.ValueType, item.RelationshipType) == ("TEXT", "CONTAINS")
    ]


def report_of(result, jane, change):
    """The report of a result whose summary was changed, read back."""
    stored = read_folder(result)
    summary = json.loads(json.dumps(stored.summary))
    change(summary)
    runs = [pydicom.dcmread(run, stop_before_pixels=True) for run in jane]
    for run, keyword in itertools.product(runs, _EMPTY):
        run.setdefault(keyword, "")
    made = measurement_report(
        dataclasses.replace(stored, summary=summary), runs, generate_uid(), (generate_uid(), 3)
    )
    return hd.sr.Comprehensive3DSR.from_dataset(made)


def test_every_lesion_of_a_branch_stands_in_the_report(result, jane):
    def lesion(at, percent, length):
        return {
            "minimal_diameter_mm": 2.5 * (1 - percent / 100), "minimal_at_mm": at,
            "reference_diameter_mm": 2.5, "stenosis_percent": percent,
            "lesion_mm": [at - length / 2, at + length / 2],
        }  # fmt: skip

    def change(summary):
        row = summary["tree"]["branches"][0]
        row.update(name="LAD", name_confidence=0.93)
        row["lesions"] = [lesion(4.0, 60.0, 3.0), lesion(12.0, 40.0, 5.0), lesion(8.0, 30.0, 2.0)]

    report = report_of(result, jane, change)
    groups = report.content.get_image_measurement_groups()
    count = len(read_folder(result).tree.branches)
    assert [g.tracking_identifier for g in groups[count:]] == [
        "branch 1, LAD, lesion 2", "branch 1, LAD, lesion 3",
    ]  # fmt: skip
    line = read_folder(result).tree.branches[0]
    for group, at, percent, length in zip(
        groups[count:], (12, 8), (40, 30), (5, 2), strict=True
    ):  # fmt: skip
        assert group.finding_type == codes.SCT.Stenosis
        (told,) = group.get_measurements(codes.SCT.LumenDiameterStenosis)
        (long,) = group.get_measurements(codes.SCT.StenoticLesionLength)
        (least,) = group.get_measurements(codes.SCT.VesselLumenDiameter)
        assert (told.value, long.value) == (percent, length)
        assert least.value == pytest.approx(2.5 * (1 - percent / 100))
        near = np.linalg.norm(line.points_mm - least.referenced_coordinates[0].value, axis=1)
        assert abs(line.arc_mm[near.argmin()] - at) < 0.6
    (named_as,) = (m for m in groups[0].get_measurements() if m.name.value == "NAME")
    assert named_as.value == 93


def test_the_report_says_what_is_the_users(result, jane):
    notes = ["view 1: 2 strokes of the user erase vessel", "of the user: branches deleted (1)"]

    def change(summary):
        summary.update(findings=["first", "second"], notes=notes)

    assert comments(report_of(result, jane, change))[1:4] == ["second", *notes]


@pytest.mark.skipif(VALIDATOR is None, reason="needs dciodvfy of dicom3tools")
def test_a_validator_finds_no_fault(archive):
    for path in sorted(archive.glob("*.dcm")):
        told = subprocess.run([VALIDATOR, str(path)], capture_output=True, text=True, check=False)
        faults = [
            line
            for line in told.stderr.splitlines()
            if line.startswith(("Error", "Warning")) and not any(w in line for w in _NO_ERROR)
        ]
        assert not faults, (path.name, faults)


def test_nobody_elses_study_gets_the_result(result, jane, tmp_path):
    _, others = named(tmp_path, side=240)
    with pytest.raises(UsageError, match=r"^run1\.dcm is none of the files that the result"):
        study_objects(result, [others[0], jane[1]])
    with pytest.raises(UsageError, match="1 runs: the result has 2"):
        study_objects(result, jane[:1])
    (tmp_path / "x.pdf").write_bytes(b"PDF")
    with pytest.raises(UsageError, match=r"^x\.pdf is no PDF"):
        study_objects(result, jane, tmp_path / "x.pdf")
    with pytest.raises(UsageError, match=r"^none\.pdf cannot be read"):
        study_objects(result, jane, tmp_path / "none.pdf")
    done = gcar("dicom", result, tmp_path / "none.dcm", jane[0], "--out", tmp_path / "o")
    assert done.code == 3 and "error: none.dcm cannot be read as DICOM" in done.err
    assert not (tmp_path / "o").exists()


def test_what_is_not_as_it_was_written_is_not_filed(result, jane, tmp_path):
    """Another case's surface or picture would go to this patient's archive."""
    made = result_of(named(tmp_path, side=240)[1], tmp_path / "other")
    for name in ("surface.stl", "overlay_view1.png"):
        for number, other in enumerate((made / name, None)):
            folder = shutil.copytree(result, tmp_path / f"{name}{number}")
            (folder / name).unlink()
            if other is not None:
                shutil.copy(other, folder / name)
            done = gcar("dicom", folder, *jane, "--out", tmp_path / "o")
            told = "is not as it was written" if other is not None else "no such file"
            assert done.code == 2 and f"{folder / name} {told}" in done.err
            assert done.err.count("\n") == 1 and not (tmp_path / "o").exists()


def test_a_picture_that_is_not_listed_is_not_filed(result, jane, tmp_path):
    folder = shutil.copytree(result, tmp_path / "result")
    shutil.copy(folder / "overlay_view1.png", folder / "overlay_view3.png")
    assert "overlay_view3.dcm" not in study_objects(folder, jane)


def test_captures_hold_the_overlays_pixels(result, jane):
    import cv2

    made = study_objects(result, jane)
    again = pydicom.dcmread(pydicom.filebase.DicomBytesIO(file_bytes(made["overlay_view2.dcm"])))
    shown = cv2.imread(str(result / "overlay_view2.png"), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(again.pixel_array, shown[..., ::-1])


def as_stored(run, path, **changes):
    """A copy of a run in which attributes stand as they are given, allowed or not."""
    data = pydicom.dcmread(run)
    data.SpecificCharacterSet = changes.pop("SpecificCharacterSet", None)
    for key, value in changes.items():
        setattr(data, key, value)
    data.save_as(path)
    return path


def patient_of(changes, result, jane, tmp_path, others=None):
    """Runs with other headers, and a result that says that it was made from them."""
    told = changes, changes if others is None else others
    runs = [as_stored(run, tmp_path / run.name, **one) for run, one in zip(jane, told, strict=True)]
    folder = shutil.copytree(result, tmp_path / "result")
    summary = json.loads((folder / "result.json").read_text())
    for view, run in zip(summary["views"], runs, strict=True):
        view["picture"]["sha256"] = hashlib.sha256(run.read_bytes()).hexdigest()
    (folder / "result.json").write_text(json.dumps(summary))
    return folder, runs


def test_runs_of_two_patients_are_filed_for_neither(result, jane, tmp_path):
    made = patient_of({"PatientID": "77"}, result, jane, tmp_path, {"PatientID": "4711"})
    with pytest.raises(UsageError, match="different patients") as refused:
        study_objects(*made)
    assert "PatientID" in str(refused.value) and "77" not in str(refused.value)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"SpecificCharacterSet": ["", "ISO 2022 IR 87"], "PatientName": "Yamada^Tarou=山田^太郎"},
         {"PatientName": "Yamada^Tarou=山田^太郎"}),
        ({"SpecificCharacterSet": "ISO_IR 100", "PatientName": "Müller^Jürgen"},
         {"PatientName": "Müller^Jürgen"}),
        ({"SpecificCharacterSet": "ISO-8859-1", "PatientID": "78"}, {"PatientID": "78"}),
        ({"PatientSex": "D", "StudyTime": "10:10:10", "StudyDate": "2020.01.31"},
         {"PatientSex": "", "StudyTime": "101010", "StudyDate": "20200131"}),
        ({"StudyTime": "noon", "StudyDate": "20201399", "PatientBirthDate": "unknown"},
         {"StudyTime": "", "StudyDate": "", "PatientBirthDate": ""}),
        ({"PatientID": "P" * 80, "PatientComments": "tall"}, {"PatientID": "P" * 80}),
    ],
    ids=["kanji", "latin", "no-charset", "old-forms", "no-dates", "long"],
)  # fmt: skip
def test_headers_that_are_not_by_the_standard(changes, told, result, jane, tmp_path):
    made = study_objects(*patient_of(changes, result, jane, tmp_path))
    for data in made.values():
        again = pydicom.dcmread(pydicom.filebase.DicomBytesIO(file_bytes(data)))
        assert {key: str(again[key].value) for key in told} == told
        assert again.SpecificCharacterSet == "ISO_IR 192" and "PatientComments" not in again


def test_nothing_that_is_said_quotes_a_value(result, jane, tmp_path, monkeypatch, recwarn):
    """highdicom warns of names without a caret, and its errors hold what they are about."""
    changes = {"PatientName": "Schneider Anna", "PatientID": "P" * 80}
    folder, runs = patient_of(changes, result, jane, tmp_path)
    recwarn.clear()
    warnings.simplefilter("error")
    done = gcar("dicom", folder, *runs, "--out", tmp_path / "o")
    assert done.code == 0 and "Schneider" not in done.out + done.err and not recwarn

    def fails(*_):
        raise ValueError("'Schneider Anna' is no name")

    monkeypatch.setattr("gcar_deploy.output.dicom_study.measurement_report", fails)
    done = gcar("dicom", folder, *runs, "--out", tmp_path / "p")
    assert (done.code, done.err) == (
        1, "gcar: error: a value in the header of run1.dcm cannot be written (ValueError)\n"
    )  # fmt: skip

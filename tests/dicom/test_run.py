"""Frame choice, shutters, meaning of the grey values, warnings."""

import json

import numpy as np
import pytest

pytest.importorskip("pydicom", reason="needs the dicom extra")

from pydicom.dataset import Dataset
from pydicom.sequence import Sequence

from gcar_deploy.config import DicomOptions, PredictOptions, RunOptions
from gcar_deploy.dicom.carm import frame_carm
from gcar_deploy.dicom.frames import Frames
from gcar_deploy.dicom.header import read_header
from gcar_deploy.dicom.scene import read_run, read_views
from gcar_deploy.engine import Engine
from gcar_deploy.errors import CancelledError, RefusedError, UsageError
from gcar_deploy.geometry.scene import Intensity, Scene, View, scene_to_json
from gcar_deploy.inputs.pictures import prepare
from tests.dicom.files import classic, enhanced, save, vessel_frames

OPTIONS = DicomOptions()


@pytest.fixture
def run(tmp_path):
    def make(pixels=None, wanted=None, **changes):
        return read_run(save(classic(pixels, **changes), tmp_path / "a.dcm"), OPTIONS, wanted)

    return make


def test_the_frame_asked_for(run):
    frames = vessel_frames(6, 3)
    found = run(frames, 5, RepresentativeFrameNumber=2)
    assert found.index == 4 and "asked for" in found.notes[0]
    np.testing.assert_array_equal(found.pixels, frames[4])
    with pytest.raises(UsageError, match=r"--frame 7 is outside 1 \.\. 6 of a\.dcm"):
        run(frames, 7)


def test_the_best_filled_frame_without_any_hint(run):
    assert run(vessel_frames(9, 6)).index == 6


def test_the_stillest_of_the_filled_ones(run):
    frames = vessel_frames(8)
    for k, shift in enumerate((-12, -8, -4, 2, 2, 2, 7, 12)):
        frames[k] = np.roll(frames[k], shift, axis=0)
    assert run(frames).index == 4


def test_the_representative_frame(run):
    found = run(vessel_frames(9, 6), RepresentativeFrameNumber=6)
    assert found.index == 5 and "representative" in found.notes[0]
    empty = run(vessel_frames(9, 6), RepresentativeFrameNumber=1)
    assert empty.index == 0 and any("less contrast than frame 7" in n for n in empty.notes)
    assert run(vessel_frames(9, 6), RepresentativeFrameNumber=12).index == 6


@pytest.mark.parametrize(
    "beats",
    [
        {"RWavePointer": [2, 6]},
        {"RWaveTimeVector": [66, 340], "FrameTime": "66.7"},
        {"RWaveTimeVector": [66, 340], "FrameTimeVector": ["0", *["66.7"] * 8]},
    ],
    ids=["pointer", "frame time", "frame time vector"],
)
def test_the_best_filled_frame_at_an_r_wave(run, beats):
    """Frames 2 and 6 are at an R wave, frame 7 holds most contrast."""
    found = run(vessel_frames(9, 6), RepresentativeFrameNumber=4, **beats)
    assert found.index == 5 and "R wave" in found.notes[0]


def test_trigger_delays_of_an_enhanced_run(tmp_path):
    delays = [300.0, 600.0, 20.0, 320.0, 620.0, 40.0, 340.0]
    per_frame = [
        {"CardiacSynchronizationSequence": {"NominalCardiacTriggerDelayTime": d}} for d in delays
    ]
    path = save(enhanced(vessel_frames(7, 4), per_frame, {}), tmp_path / "a.dcm")
    assert read_run(path, OPTIONS).index == 5


def rectangle(kind):
    names = ("LeftVertical", "RightVertical", "UpperHorizontal", "LowerHorizontal")
    return {f"{kind}{n}Edge": e for n, e in zip(names, (11, 54, 6, 60), strict=True)}


@pytest.mark.parametrize("kind", ["Shutter", "Collimator"])
def test_rectangular_shutter(run, kind):
    valid = run(**{f"{kind}Shape": "RECTANGULAR"}, **rectangle(kind)).valid
    rows, columns = np.nonzero(valid)
    # Edges count from 1 and are shut themselves.
    assert (columns.min(), columns.max(), rows.min(), rows.max()) == (11, 52, 6, 58)


def test_circle_and_polygon_and_both(run):
    circle = {"CenterOfCircularShutter": [33, 33], "RadiusOfCircularShutter": 20}
    valid = run(ShutterShape="CIRCULAR", **circle).valid
    assert valid.sum() == pytest.approx(np.pi * 400, rel=0.02) and valid[32, 12] and not valid[0, 0]
    triangle = {"VerticesOfThePolygonalShutter": [1, 1, 1, 64, 64, 1]}
    valid = run(ShutterShape="POLYGONAL", **triangle).valid
    assert valid[5, 5] and not valid[60, 60] and valid.mean() == pytest.approx(0.5, abs=0.02)
    both = run(ShutterShape=["CIRCULAR", "POLYGONAL"], **circle, **triangle).valid
    assert both[20, 20] and not both[5, 5] and not both[45, 45]


def test_a_shutter_that_leaves_nothing_or_everything(run):
    assert run(ShutterShape="CIRCULAR", CenterOfCircularShutter=[1, 1],
               RadiusOfCircularShutter=2).valid is None  # fmt: skip
    assert run(ShutterShape="RECTANGULAR").valid is None
    assert run().valid is None


@pytest.mark.parametrize(
    ("changes", "kind", "polarity"),
    [
        ({"PixelIntensityRelationship": "LIN"}, "raw", "auto"),
        ({"PixelIntensityRelationship": "LIN", "PixelIntensityRelationshipSign": 1}, "raw", "dark"),
        ({"PixelIntensityRelationship": "LOG", "PixelIntensityRelationshipSign": 1},
         "attenuation", "dark"),
        ({"PixelIntensityRelationship": "LOG", "PixelIntensityRelationshipSign": -1},
         "attenuation", "bright"),
        ({"PixelIntensityRelationship": "LOG", "PixelIntensityRelationshipSign": -1,
          "PhotometricInterpretation": "MONOCHROME1"}, "attenuation", "dark"),
        ({"PixelIntensityRelationship": "DISP"}, "raw", "auto"),
        ({"PixelIntensityRelationship": None}, "raw", "auto"),
    ],
)  # fmt: skip
def test_meaning_of_the_grey_values(run, changes, kind, polarity):
    found = run(**changes)
    assert (found.intensity.kind, found.intensity.polarity) == (kind, polarity)
    said = any("estimated from their contrast" in note for note in found.notes)
    assert said == (changes["PixelIntensityRelationship"] not in ("LIN", "LOG"))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"BurnedInAnnotation": "YES"}, "burned"),
        ({"MaskSubtractionSequence": Sequence([Dataset()])}, "MaskSubtraction"),
        ({"ImageType": ["DERIVED", "PRIMARY", "SUBTRACTION"]}, "subtracted"),
        ({"LossyImageCompression": "01"}, "with loss"),
        ({"ModalityLUTSequence": Sequence([Dataset()])}, "ModalityLUT"),
        ({"TableMotion": "DYNAMIC"}, "table moved"),
    ],
)
def test_said_aloud(run, changes, words):
    assert any(words in note and "a.dcm" not in note for note in run(**changes).notes)
    assert run().notes == ()


@pytest.mark.parametrize("by", ["headers", "scene"])
@pytest.mark.parametrize("side", [1, 2])
def test_reading_a_run_ends_with_the_call(by, side, tmp_path, monkeypatch):
    """Two runs that choose together, and one that chooses alone beside a single picture."""
    runs = [
        save(classic(vessel_frames(k, 6), PositionerPrimaryAngle=angle), tmp_path / f"{angle}.dcm")
        for k, angle in ((40, "-30"), (40 if side == 2 else 1, "45"))
    ]
    geometry = None
    if by == "scene":
        geometry = json.loads(scene_to_json(read_views(runs, DicomOptions(frames=(1,)))[1]))
    decoded, decode = [], Frames.decode
    monkeypatch.setattr(Frames, "decode", lambda *a: (decode(*a), decoded.append(a))[0])
    engine = Engine(threads=1, options=RunOptions(predict=PredictOptions(predictor="none")))
    with pytest.raises(CancelledError, match="cancelled by the caller"):
        engine.reconstruct(runs, geometry, cancel=lambda: len(decoded) >= 5)
    assert len(decoded) <= 6
    with pytest.raises(CancelledError, match="deadline"):
        engine.reconstruct(runs, geometry, deadline_s=1e-4)
    assert len(decoded) <= 8


def pair_of(folder, *told):
    """Two runs that show two things; a header each."""
    pictures = vessel_frames(), np.swapaxes(vessel_frames(), 1, 2)
    return [
        save(classic(pixels, PositionerPrimaryAngle=angle, **one), folder / f"{angle}.dcm")
        for pixels, angle, one in zip(pictures, ("-30", "45"), told, strict=True)
    ]


@pytest.mark.parametrize(
    ("own", "others", "said"),
    [
        ({"PatientID": "ZZ1"}, {"PatientID": "ZZ2"}, "(PatientID (0010,0020))"),
        ({"PatientSex": "F"}, {"PatientSex": "M"}, "(PatientSex (0010,0040))"),
        ({"PatientBirthDate": "19010203"}, {"PatientBirthDate": "19010204"}, "BirthDate"),
        ({"PatientID": "ZZ1"}, {"PatientID": " zz1", "PatientSex": "M"}, None),
        ({"PatientName": "ZZ^A"}, {"PatientName": "ZZ^B"}, None),
    ],
)
def test_runs_of_different_patients_are_refused(own, others, said, tmp_path):
    runs = pair_of(tmp_path, own, others)
    carms = [frame_carm(read_header(run), 0, OPTIONS)[0] for run in runs]
    views = tuple(
        View(id=str(k), carm=carm, intensity=Intensity(kind="raw"))
        for k, carm in enumerate(carms, start=1)
    )
    scene = json.loads(scene_to_json(Scene(views=views)))
    for read in (lambda: read_views(runs, OPTIONS), lambda: prepare(runs, scene, RunOptions())):
        if said is None:
            assert not any("ZZ" in note for note in read()[2])
            continue
        with pytest.raises(RefusedError) as refused:
            read()
        told = str(refused.value)
        assert said in told and "ZZ" not in told and "1901" not in told


def test_different_studies_of_one_patient_are_said(tmp_path):
    runs = pair_of(tmp_path, *({"PatientID": "1", "StudyInstanceUID": f"1.2.{k}"} for k in "12"))
    assert "views 1 and 2 are of different studies" in read_views(runs, OPTIONS)[2]

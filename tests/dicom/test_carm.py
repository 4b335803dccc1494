"""Every attribute that the geometry hangs on: honoured, warned about or refused."""

import numpy as np
import pytest

pytest.importorskip("pydicom", reason="needs the dicom extra")

from gcar_deploy.config import DicomOptions
from gcar_deploy.dicom.carm import frame_carm
from gcar_deploy.dicom.header import read_header
from gcar_deploy.dicom.scene import read_run, read_views
from gcar_deploy.errors import GeometryError, UsageError
from tests.dicom.files import SIDE, classic, enhanced, save, vessel_frames

OPTIONS = DicomOptions()
#: a point well off all axes tells a turn from a flip
POINT = np.array([[11.0, -7.0, 5.0]])


@pytest.fixture
def carm(tmp_path):
    def make(frame=0, options=OPTIONS, pixels=None, **changes):
        path = save(classic(pixels, **changes), tmp_path / "a.dcm")
        return frame_carm(read_header(path), frame, options)

    return make


def seen(view):
    return view.project(POINT)[0][0]


def test_a_complete_header_is_the_contract(carm):
    view, notes = carm()
    assert (view.primary_angle_deg, view.secondary_angle_deg) == (30, -20)
    assert (view.sod_mm, view.sdd_mm, view.rows, view.columns) == (765, 1100, SIDE, SIDE)
    assert view.pixel_spacing_mm == (1.6, 1.6) and view.principal_point_px is None
    assert notes == []


def test_row_spacing_comes_first(carm):
    assert carm(ImagerPixelSpacing=["1.6", "0.8"])[0].pixel_spacing_mm == (1.6, 0.8)


@pytest.mark.parametrize(
    ("missing", "match"),
    [
        ("ImagerPixelSpacing", "--pixel-spacing"),
        ("DistanceSourceToPatient", "--sod"),
        ("DistanceSourceToDetector", "--geom"),
        ("PositionerPrimaryAngle", "--geom"),
        ("PositionerSecondaryAngle", "--geom"),
    ],
)
@pytest.mark.req("REQ-11")
def test_what_is_missing_is_named_with_its_option(carm, missing, match):
    with pytest.raises(GeometryError, match=match) as error:
        carm(**{missing: None})
    assert missing in str(error.value) and str(error.value).startswith("a.dcm: ")


def test_options_supply_what_is_missing_and_nothing_else(carm):
    options = DicomOptions(pixel_spacing_mm=0.9, sod_mm=700)
    view, _ = carm(options=options, ImagerPixelSpacing=None, DistanceSourceToPatient=None)
    assert view.pixel_spacing_mm == (0.9, 0.9) and view.sod_mm == 700
    view, notes = carm(options=options)
    assert view.pixel_spacing_mm == (1.6, 1.6) and view.sod_mm == 765
    assert len(notes) == 2 and all("not used" in note for note in notes)


def test_a_given_spacing_is_held_against_the_field_of_view(carm):
    """204 mm over 128 rows are 1.6 mm each."""
    field = {"FieldOfViewShape": "RECTANGLE", "FieldOfViewDimensions": ["204", "204"]}

    def notes(given, **changes):
        options = DicomOptions(pixel_spacing_mm=given)
        return carm(options=options, ImagerPixelSpacing=None, **{**field, **changes})[1]

    (said,) = notes(1.2)
    assert "--pixel-spacing 1.2 mm" in said and f"204 mm over {SIDE} rows are" in said
    assert f"are {204 / SIDE:.3g} mm each" in said
    assert not notes(0.95 * 204 / SIDE)
    assert not notes(1.2, FieldOfViewShape="ROUND", FieldOfViewDimensions=["204"])
    assert not notes(1.2, FieldOfViewDimensions=None)
    assert not notes(1.2, FieldOfViewDimensions=["0", "0"])


def test_a_calibrated_spacing_is_never_the_detectors(carm):
    with pytest.raises(GeometryError, match="no substitute"):
        carm(ImagerPixelSpacing=None, PixelSpacing=["0.3", "0.3"])
    assert carm(PixelSpacing=["0.3", "0.3"])[0].pixel_spacing_mm == (1.6, 1.6)


def test_magnification_is_a_cross_check(carm):
    assert carm(EstimatedRadiographicMagnificationFactor="1.438")[1] == []
    assert "at odds" in carm(EstimatedRadiographicMagnificationFactor="1.6")[1][0]
    with pytest.raises(GeometryError, match="suggests 733"):
        carm(DistanceSourceToPatient=None, EstimatedRadiographicMagnificationFactor="1.5")


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"DistanceSourceToPatient": "1200"}, "must exceed"),
        ({"DistanceSourceToPatient": "20"}, "sod_mm = 20"),
        ({"PositionerSecondaryAngle": "95"}, "secondary_angle_deg = 95"),
        ({"ImagerPixelSpacing": ["1.6"]}, "holds 1 values"),
        ({"ImagerPixelSpacing": ["0", "0"]}, "pixel_spacing_mm"),
        ({"DetectorPrimaryAngle": "3"}, "tilted"),
        ({"DetectorSecondaryAngle": "-1.5"}, "tilted"),
        ({"FieldOfViewRotation": "45"}, "0, 90, 180 or 270"),
    ],
)
def test_refused(carm, changes, match):
    with pytest.raises(GeometryError, match=match):
        carm(**changes)


def test_a_slight_tilt_is_said(carm):
    assert "DetectorPrimaryAngle" in carm(DetectorPrimaryAngle="0.5")[1][0]
    assert carm(DetectorPrimaryAngle="0")[1] == []


def test_dynamic_run(carm):
    still = {"PositionerMotion": "STATIC", "PositionerPrimaryAngleIncrement": "2"}
    moving = {"PositionerMotion": "DYNAMIC", "PositionerSecondaryAngleIncrement": "0"}
    frames = vessel_frames(4)
    view, notes = carm(3, pixels=frames, **still)
    assert view.primary_angle_deg == 30 and "PositionerPrimaryAngleIncrement" in notes[0]
    assert carm(3, pixels=frames, **{**still, "PositionerPrimaryAngleIncrement": "0"})[1] == []
    # A file that does not say whether the C-arm moved tells it by its increments.
    for silent in ({}, {"PositionerMotion": ""}):
        view, _ = carm(3, pixels=frames, **silent, PositionerPrimaryAngleIncrement="2.5")
        assert view.primary_angle_deg == 37.5
        assert carm(3, pixels=frames, **silent)[0].primary_angle_deg == 30
    # One value: change per frame.
    view, _ = carm(3, pixels=frames, **moving, PositionerPrimaryAngleIncrement="2.5")
    assert view.primary_angle_deg == 37.5
    # As many as frames: offsets from the first.
    offsets = ["0", "2", "3", "3.5"]
    view, _ = carm(2, pixels=frames, **moving, PositionerPrimaryAngleIncrement=offsets)
    assert view.primary_angle_deg == 33
    far = ["0", "60", "120", "170"]
    view, _ = carm(3, pixels=frames, **moving, PositionerPrimaryAngleIncrement=far)
    assert view.primary_angle_deg == -160
    with pytest.raises(GeometryError, match="3 values for 4 frames"):
        carm(1, pixels=frames, **moving, PositionerPrimaryAngleIncrement=offsets[:3])
    with pytest.raises(GeometryError, match="angles of frame 2 are unknown"):
        carm(1, pixels=frames, PositionerMotion="DYNAMIC")
    assert carm(0, pixels=frames, PositionerMotion="DYNAMIC")[0].primary_angle_deg == 30


@pytest.mark.parametrize("turn", [90, 180, 270])
def test_a_turned_picture_shows_the_point_where_the_turned_pixels_are(carm, turn):
    """Independent oracle: turn the pixel itself clockwise about the picture's middle."""
    upright = seen(carm()[0])
    view, notes = carm(FieldOfViewRotation=str(turn))
    col, row = upright
    last = SIDE - 1
    expected = {90: (last - row, col), 180: (last - col, last - row), 270: (row, last - col)}
    assert seen(view) == pytest.approx(expected[turn], abs=1e-9)
    assert f"turned by {turn}" in notes[0]


def test_a_mirror_image_is_turned_back(tmp_path):
    frames = vessel_frames()
    frames[0, :, :20] = 90
    straight = read_run(save(classic(frames), tmp_path / "a.dcm"), OPTIONS)
    shut = {
        "ShutterShape": "RECTANGULAR",
        "ShutterLeftVerticalEdge": 10,
        "ShutterRightVerticalEdge": SIDE + 1,
        "ShutterUpperHorizontalEdge": 0,
        "ShutterLowerHorizontalEdge": SIDE + 1,
    }
    ds = classic(np.ascontiguousarray(frames[:, :, ::-1]), FieldOfViewHorizontalFlip="YES", **shut)
    path = save(ds, tmp_path / "b.dcm")
    mirrored = read_run(path, OPTIONS)
    np.testing.assert_array_equal(mirrored.pixels, straight.pixels)
    # The shutter was at the left of what is stored, so it is at the right now.
    assert mirrored.valid[:, 0].all() and not mirrored.valid[:, -5].any()
    view, notes = frame_carm(read_header(path), 0, OPTIONS)
    assert "mirror" in notes[0] and view.detector_rotation_deg == 0


@pytest.mark.parametrize("turn", [0, 90, 180, 270])
def test_field_of_view_off_the_detectors_middle(carm, turn):
    """A field of 64 x 64 pixels of 1.6 mm on a detector of 0.4 mm elements, 4 of them a pixel."""
    detector = {
        "DetectorElementSpacing": ["0.4", "0.4"],
        "FieldOfViewOrigin": ["40", "120"],
        "FieldOfViewRotation": str(turn),
        "DetectorActiveDimensions": ["204.8", "204.8"],
    }
    view, _ = carm(**detector)
    # The detector's middle, element 255.5, lies (255.5 - origin + 0.5) / 4 - 0.5 into the field.
    row, col = (256 - 40) / 4 - 0.5, (256 - 120) / 4 - 0.5
    last = SIDE - 1
    expected = {
        0: (col, row), 90: (last - row, col), 180: (last - col, last - row), 270: (row, last - col),
    }  # fmt: skip
    assert view.principal_point_px == pytest.approx(expected[turn])
    off = carm(**detector, PositionOfIsocenterProjection=[275.5, 255.5])[0]
    moved = {0: (0, 5), 90: (-5, 0), 180: (0, -5), 270: (5, 0)}[turn]
    assert np.subtract(off.principal_point_px, view.principal_point_px) == pytest.approx(moved)


def test_an_origin_without_its_detector_is_said(carm):
    view, notes = carm(FieldOfViewOrigin=["40", "120"])
    assert view.principal_point_px is None and "middle" in notes[0]


GROUPS = {
    "FieldOfViewSequence": {"FieldOfViewHorizontalFlip": "NO", "FieldOfViewRotation": 0.0},
    "XRayGeometrySequence": {
        "DistanceSourceToIsocenter": 750.0,
        "DistanceSourceToDetector": 1050.0,
    },
    "FramePixelDataPropertiesSequence": {
        "ImagerPixelSpacing": [1.5, 1.5],
        "PixelIntensityRelationship": "LOG",
    },
}


def positions(*angles):
    return [
        {"PositionerPositionSequence": {"PositionerPrimaryAngle": a, "PositionerSecondaryAngle": b}}
        for a, b in angles
    ]


def test_enhanced_reads_the_groups_of_its_frame(tmp_path):
    per_frame = positions((10.0, 5.0), (20.0, 6.0), (30.0, 7.0))
    ds = enhanced(vessel_frames(3), per_frame, GROUPS)
    ds.PositionerPrimaryAngle = "99"  # the top of an Enhanced file is not where angles are
    path = save(ds, tmp_path / "a.dcm")
    run = read_run(path, OPTIONS, 2)
    view, _ = frame_carm(run.header, run.index, OPTIONS)
    assert (view.primary_angle_deg, view.secondary_angle_deg) == (20, 6)
    assert (view.sod_mm, view.sdd_mm, view.pixel_spacing_mm) == (750, 1050, (1.5, 1.5))
    assert run.intensity.kind == "attenuation"


def test_enhanced_without_angles_asks_for_a_geometry(tmp_path):
    path = save(enhanced(vessel_frames(), [{}], GROUPS), tmp_path / "a.dcm")
    with pytest.raises(GeometryError, match="PositionerPrimaryAngle"):
        frame_carm(read_header(path), 0, OPTIONS)


def test_angles_against_the_room_are_said_and_need_a_patient_head_first_supine(tmp_path):
    room = {
        "IsocenterReferenceSystemSequence": {
            "PositionerIsocenterPrimaryAngle": -30.0, "PositionerIsocenterSecondaryAngle": -20.0,
        },
        "TablePositionSequence": {"TableHeadTiltAngle": 10.0, "TableCradleTiltAngle": 0.0},
    }  # fmt: skip
    ds = enhanced(vessel_frames(), [room], GROUPS)
    for position in (None, "HFS"):
        if position:
            ds.PatientPosition = position
        view, notes = frame_carm(read_header(save(ds, tmp_path / "a.dcm")), 0, OPTIONS)
        assert (view.primary_angle_deg, view.secondary_angle_deg) == (-30, -20)
        assert "PositionerIsocenterPrimaryAngle" in notes[0] and "TableHeadTiltAngle" in notes[0]
        assert "TableCradleTiltAngle" not in notes[0]
    ds.PatientPosition = "FFS"
    with pytest.raises(GeometryError, match=r"a\.dcm: PositionerPrimaryAngle.*= HFS, not FFS"):
        frame_carm(read_header(save(ds, tmp_path / "a.dcm")), 0, OPTIONS)


def test_two_runs_make_a_scene(tmp_path):
    a = save(classic(), tmp_path / "a.dcm")
    b = save(classic(PositionerPrimaryAngle="-40"), tmp_path / "b.dcm")
    angiograms, scene, _ = read_views([a, b], OPTIONS)
    assert [x.carm.primary_angle_deg for x in angiograms] == [30, -40]
    assert [v.carm for v in scene.views] == [x.carm for x in angiograms]
    with pytest.raises(UsageError, match="3 frames for 2"):
        read_views([a, b], DicomOptions(frames=(1, 1, 1)))

"""Real X-rays: seven hand-picked landmarks in four runs of a physical phantom.

Angles and distances are those in the headers of the runs (Vukicevic et al., Sci Rep 8:1711,
2018, Dataset I); each run may shift by some millimetres.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import triangulate
from tests.conftest import data_dir
from tests.geometry.test_carm import wrong_order

PICKED = json.loads((Path(__file__).parents[1] / "data" / "phantom_landmarks.json").read_text())
HEADERS = PICKED["headers"]
PIXELS = {k: np.array(v, float) for k, v in PICKED["pixels_col_row"].items()}
#: millimetres that a run may be off, one standard deviation, and pixels of picking
SHIFT_MM, PICK_PX = 10.0, 2.0


def carms(sign=1.0, second=1.0):
    return [
        CArm(
            primary_angle_deg=sign * header["primary_angle_deg"],
            secondary_angle_deg=second * header["secondary_angle_deg"],
            sod_mm=PICKED["sod_mm"],
            sdd_mm=header["sdd_mm"],
            rows=PICKED["rows"],
            columns=PICKED["columns"],
            pixel_spacing_mm=(PICKED["pixel_spacing_mm"],) * 2,
        )
        for header in HEADERS.values()
    ]


def fitted_rms(views, matrix=lambda c: c.world2pixel):
    P = [matrix(c) for c in views]
    seen = [PIXELS[k] for k in HEADERS]
    start, _ = triangulate(views, seen)

    def residuals(x):
        X, shift = x[:21].reshape(7, 3), x[21:].reshape(4, 3)
        out = [shift.ravel() / SHIFT_MM]
        for k in range(4):
            h = (X + shift[k]) @ P[k][:, :3].T + P[k][:, 3]
            out.append(((h[:, :2] / h[:, 2:] - seen[k]) / PICK_PX).ravel())
        return np.concatenate(out)

    r = least_squares(residuals, np.concatenate([start.ravel(), np.zeros(12)])).fun[12:] * PICK_PX
    return np.sqrt(np.mean(r**2))


def test_contract_geometry_fits_real_x_rays():
    """As well as a hand picks: about 2.0 px per coordinate."""
    assert fitted_rms(carms()) == pytest.approx(2.0, abs=0.1)


def test_headers_are_those_of_the_files():
    pydicom = pytest.importorskip("pydicom")
    folders = [data_dir() / "phantom_xa", data_dir() / "data" / "phantom_xa"]
    folder = next((f for f in folders if f.is_dir()), None)
    if folder is None:
        pytest.skip("GCAR_DATA has no phantom_xa")
    for name, header in HEADERS.items():
        d = pydicom.dcmread(folder / f"{name}.dcm", stop_before_pixels=True)
        assert float(d.PositionerPrimaryAngle) == header["primary_angle_deg"]
        assert float(d.PositionerSecondaryAngle) == header["secondary_angle_deg"]
        assert float(d.DistanceSourceToDetector) == header["sdd_mm"]
        assert float(d.DistanceSourceToPatient) == PICKED["sod_mm"]


def test_the_mirror_image_fits_as_well():
    """Both signs reversed: no residual excludes it, so the convention must be right by itself."""
    assert fitted_rms(carms(-1, -1)) == pytest.approx(fitted_rms(carms()), abs=0.1)


@pytest.mark.parametrize(
    ("views", "matrix"),
    [
        (carms(), wrong_order),
        (carms(sign=-1), lambda c: c.world2pixel),
        (carms(second=-1), lambda c: c.world2pixel),
    ],
    ids=["rotations in the other order", "primary sign", "secondary sign"],
)
def test_wrong_conventions_do_not(views, matrix):
    assert fitted_rms(views, matrix) > 10

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
from tests.geometry.test_carm import wrong_order

PICKED = json.loads((Path(__file__).parents[1] / "data" / "phantom_landmarks.json").read_text())
HEADERS = {
    "IM1": (31.3, 0.1, 860),
    "IM4": (0.1, 28.7, 907),
    "IM7": (-29.3, 25.5, 976),
    "IM8": (30.7, 23.6, 976),
}
PIXELS = {k: np.array(v, float) for k, v in PICKED["pixels_col_row"].items()}
#: millimetres that a run may be off, one standard deviation, and pixels of picking
SHIFT_MM, PICK_PX = 4.0, 2.0


def carms(sign=1.0, second=1.0):
    return [
        CArm(
            primary_angle_deg=sign * a,
            secondary_angle_deg=second * b,
            sod_mm=720,
            sdd_mm=sdd,
            rows=512,
            columns=512,
            pixel_spacing_mm=(0.390625, 0.390625),
        )
        for a, b, sdd in HEADERS.values()
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
    return np.sqrt(np.mean(np.sum(r.reshape(-1, 2) ** 2, axis=1)))


def test_contract_geometry_fits_real_x_rays():
    assert fitted_rms(carms()) < 3.5


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
    assert fitted_rms(views, matrix) > 2.5 * fitted_rms(carms())

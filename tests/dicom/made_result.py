"""A result of two DICOM runs of one patient's study."""

from __future__ import annotations

import numpy as np
from pydicom.uid import generate_uid

from gcar_deploy.config import PredictOptions, RunOptions
from gcar_deploy.engine import Engine
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.selftest import tiny_tree
from gcar_deploy.tubes.model import footprint, tubes_of
from tests.dicom.files import classic, save

SIDE = 256


def named(folder, side=SIDE, **more):
    """Two X-ray pictures of a small tree as XA files of one patient's study."""
    study, files = generate_uid(), []
    rng = np.random.default_rng(0)
    for number, (primary, secondary) in enumerate(((-30, -20), (45, 25)), start=1):
        carm = CArm(
            primary_angle_deg=primary, secondary_angle_deg=secondary, sod_mm=765.0, sdd_mm=1100.0,
            rows=side, columns=side, pixel_spacing_mm=(0.6, 0.6),
        )  # fmt: skip
        path = footprint(tubes_of(tiny_tree()), carm, 1.0).image((side, side))
        grey = 190 * np.exp(-0.22 * path) + rng.normal(0, 1.5, path.shape)
        run = classic(
            np.rint(grey).clip(0, 255).astype(np.uint8)[None], StudyInstanceUID=study,
            SeriesInstanceUID=generate_uid(), PositionerPrimaryAngle=str(primary),
            PositionerSecondaryAngle=str(secondary), ImagerPixelSpacing=["0.6", "0.6"], **more,
        )  # fmt: skip
        files.append(save(run, folder / f"run{number}.dcm"))
    return study, files


def of_jane(folder):
    """Runs of a patient with a name."""
    return named(
        folder, PatientName="Doe^Jane", PatientID="77", StudyDate="20240102",
        AccessionNumber="A9", OperatorsName="Not^Copied",
    )[1]  # fmt: skip


def result_of(runs, out):
    """The result folder of runs."""
    engine = Engine(options=RunOptions(predict=PredictOptions(predictor="none")))
    return engine.reconstruct(runs).save(out)

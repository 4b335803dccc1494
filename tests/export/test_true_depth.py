"""Centres at true depth lie in the vessel: the bound that the paper's predictor is held against."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gcar_export.methods.settings import BASELINES, START_ROWS
from gcar_export.methods.solve import path_lengths
from gcar_export.methods.true_depth import true_depth_centers
from gcar_export.scenes.labels import read_label
from gcar_export.scenes.protocols import make_case
from tests.export.label_files import write_tree


@pytest.mark.slow
def test_centres_lie_within_a_cell_of_the_vessel_and_hold_it_once(tmp_path):
    write_tree(tmp_path / "imagecas" / "5.label.nii.gz", 5)
    case = make_case(read_label(tmp_path / "imagecas" / "5.label.nii.gz"), "paper")
    centers = true_depth_centers(case, path_lengths(case))
    vessel = case.grid.index2world(np.argwhere(case.truth >= 0.5))
    off = cKDTree(vessel).query(centers.points_mm)[0]
    assert (off < 1.5 * case.grid.spacing_mm[0]).mean() > 0.9
    held = centers.confidence.sum() * centers.spacing_mm**3
    assert held == pytest.approx(case.truth.sum() * np.prod(case.grid.spacing_mm), rel=0.1)


def test_every_row_of_others_stands_in_the_guide():
    guide = (Path(__file__).parents[2] / "docs" / "evaluation.md").read_text()
    rows = " ".join(line.split("|")[1] for line in guide.splitlines() if line.startswith("| `"))
    assert [name for name in (*START_ROWS, *BASELINES) if f"`{name}`" not in rows] == []

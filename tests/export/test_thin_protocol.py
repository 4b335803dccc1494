"""Thin trees for evaluation: what the pictures hold, and shares of lines in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from gcar_deploy.errors import UsageError
from gcar_export.evaluate.evaluate import EvaluateOptions, evaluate
from gcar_export.scenes.protocols import MM_PER_COUNT
from gcar_export.scenes.thin_protocol import THIN, along, line_measures, thin_case, thin_names


def test_pictures_show_the_line_with_the_noise_that_is_named() -> None:
    case = thin_case("01", "thin-0.05")
    assert case.line_mm is not None
    for view, picture in zip(case.scene.views, case.pictures, strict=True):
        assert picture.shape == (960, 960)
        assert view.carm.pixel_at_isocenter_mm == pytest.approx(0.138)
        path = picture * MM_PER_COUNT
        # half of the noise is cut off at 0: its deviation lies at 84 % of the background
        assert np.quantile(path[path < 0.3], 0.8413) == pytest.approx(0.05, rel=0.15)
        pixels = np.rint(view.carm.project(case.line_mm)[0]).astype(int)
        inside = ((pixels >= 0) & (pixels < 960)).all(axis=1)
        assert inside.mean() > 0.95
        seen = path[pixels[inside, 1], pixels[inside, 0]]
        assert (seen > 0.2).mean() > 0.97
        # thin: a good part of the line is less than 1 mm thick
        assert 0.1 < (seen < 1.0).mean() < 0.9
    assert case.truth[case.truth > 0].sum() > 500


@pytest.mark.slow
def test_the_same_tree_at_every_noise_and_others_by_name() -> None:
    lines = [thin_case("02", protocol).line_mm for protocol in THIN]
    assert all(line is not None and np.array_equal(line, lines[0]) for line in lines)
    other = thin_case("03", "thin-0").line_mm
    assert other is not None and len(other) != len(lines[0] if lines[0] is not None else ())
    with pytest.raises(UsageError, match="two views"):
        thin_case("01", "thin-0", views=4)


def test_shares_of_lines_are_those_of_closed_forms() -> None:
    truth = along([np.array([[0.0, 0, 0], [100, 0, 0]])])
    assert np.linalg.norm(np.diff(truth, axis=0), axis=1).max() <= 0.25 + 1e-9
    found = along([np.array([[0.0, 0.5, 0], [40, 0.5, 0]]), np.array([[0.0, 9, 0], [0, 19, 0]])])
    shares = line_measures(truth, found)
    assert shares["found_1mm"].value == pytest.approx(0.41, abs=0.005)
    assert shares["true_1mm"].value == pytest.approx(0.8, abs=0.005)
    assert line_measures(truth, None)["found_1mm"].reason == "no prediction"
    assert line_measures(truth, np.zeros((0, 3)))["true_1mm"].reason == "prediction is empty"


def test_it_needs_no_data_and_says_which_trees_there_are(tmp_path) -> None:
    options = EvaluateOptions(
        data=None, out=tmp_path, protocol="thin", methods=("ours",), cases=("99",)
    )
    assert options.protocols == tuple(THIN) and len(thin_names()) == 12
    with pytest.raises(UsageError, match=r"99 is not in 01 \.\. 12"):
        evaluate(options)
    with pytest.raises(UsageError, match="--data is missing"):
        evaluate(EvaluateOptions(data=None, out=tmp_path, protocol="paper", methods=("ours",)))

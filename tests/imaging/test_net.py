"""The shipped segmentation network: loads, finds a drawn tree, is worse than the classical way."""

import numpy as np
import pytest

from gcar_deploy.config import ImagingOptions
from gcar_deploy.engine import load_segmenter
from gcar_deploy.errors import RefusedError, UsageError
from gcar_deploy.imaging.extract import extract_vessels
from tests.conftest import data_dir
from tests.imaging.phantoms import angiogram, raw_picture, tube_paths


@pytest.fixture(scope="module")
def net():
    return load_segmenter("net", 1)


def test_who_needs_it():
    assert load_segmenter("classic") is None
    assert load_segmenter("auto") is not None
    with pytest.raises(UsageError, match="classic, net, auto"):
        load_segmenter("best")


def test_tubes_are_found(net):
    paths = tube_paths()
    picture = angiogram(raw_picture(paths), pixel_mm=0.5)
    found = extract_vessels(picture, ImagingOptions(segmenter="net"), net)
    truth = paths > 0.5
    assert 2 * (found.mask & truth).sum() / (found.mask.sum() + truth.sum()) > 0.6
    assert found.kind == "raw" and not found.calibrated


def test_a_blank_picture_is_refused_by_both(net):
    noise = np.random.default_rng(0).normal(128, 2, (200, 200)).clip(0, 255)
    for who in ("net", "auto"):
        with pytest.raises(RefusedError, match="no vessel"):
            extract_vessels(angiogram(noise), ImagingOptions(segmenter=who), net)


@pytest.mark.slow
def test_expert_masks(net):
    """Eight of the real pictures: the network is usable, and honestly the weaker of the two."""
    table = pytest.importorskip("gcar_export.segmentation_table", reason="needs the workshop")
    pairs = sorted(table.find(data_dir(), "xca_masks").glob("*_gt.png"))[::5]
    if not pairs:
        pytest.skip("GCAR_DATA has no xca_masks")
    dice = {
        who: np.mean([table.expert_score(path, one)[0]["Dice"] for path in pairs])
        for who, one in (("net", net), ("classic", None))
    }
    assert 0.5 < dice["net"] < dice["classic"] < 0.9

"""The shipped segmentation network: loads, finds a drawn tree, and what it adds to the other."""

import cv2
import numpy as np
import pytest

from gcar_deploy.config import ImagingOptions
from gcar_deploy.errors import RefusedError, UsageError
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.imaging.fusion import fused
from gcar_deploy.imaging.grey_values import bright_vessels
from gcar_deploy.imaging.net import load_segmenter
from gcar_deploy.imaging.skeleton import skeletonize
from tests.conftest import data_dir
from tests.imaging.phantoms import angiogram, raw_picture, tube_paths


@pytest.fixture(scope="module")
def net():
    return load_segmenter("net", 1)


def test_who_needs_it():
    assert load_segmenter("classic") is None
    assert load_segmenter("auto") is not None
    with pytest.raises(UsageError, match="auto, classic, net"):
        load_segmenter("best")


def test_tubes_are_found(net):
    paths = tube_paths()
    picture = angiogram(raw_picture(paths), pixel_mm=0.5)
    truth = paths > 0.5
    for who in ("net", "auto"):
        found = extract_vessels(picture, ImagingOptions(segmenter=who), net)
        assert 2 * (found.mask & truth).sum() / (found.mask.sum() + truth.sum()) > 0.6
        assert found.kind == "raw" and not found.calibrated and 0 < found.path_error < 1
        either = (found.path_mm > 0) | (paths > 0)
        assert np.corrcoef(found.path_mm[either], paths[either])[0, 1] > 0.8
        assert (found.others == ()) == (who == "net")
        assert not found.path_mm[~found.valid].any()


def test_the_fusion_draws_what_the_network_draws_and_forgets_no_line(net):
    picture = angiogram(raw_picture(tube_paths()), pixel_mm=0.5)
    one = extract_vessels(picture, ImagingOptions(segmenter="classic"))
    two = extract_vessels(picture, ImagingOptions(segmenter="net"), net)
    bright = bright_vessels(picture.pixels, "raw", True)[0]["display"]
    both = fused(one, two, bright)
    alone, old = both.others
    assert alone is two and old.mask is one.mask
    assert both.device is old.device is two.device and one.device is None
    np.testing.assert_array_equal(both.mask, two.mask)
    assert (both.path_mm > 0)[(one.path_mm > 0.5) | (two.path_mm > 0.5)].mean() > 0.9
    assert not both.path_mm[(one.path_mm == 0) & (two.path_mm == 0)].any()
    # The scale is the network's.
    of_both = both.path_mm[two.mask].sum() / two.path_mm[two.mask].sum()
    assert of_both == pytest.approx(1, abs=0.15)


def artery_over_ribs(contrast, slope, pixel_mm):
    """(512, 512) grey counts and chords, mm: an artery with three branches over faint ribs."""
    rng = np.random.default_rng(3)
    v, u = np.indices((512, 512)) / 512
    path = np.zeros((512, 512))

    def draw(course, radii):
        nonlocal path
        for (x, y), radius in zip(course, radii, strict=True):
            away = np.hypot(u - x, v - y) * 512 * pixel_mm
            path = np.maximum(path, 2 * np.sqrt(np.clip(radius**2 - away**2, 0, None)))

    t = np.linspace(0, 1, 300)[:, None]
    main = np.hstack([0.30 + 0.22 * np.sin(2.6 * t), 0.16 + 0.66 * t])
    draw(main, 1.6 - 0.9 * t[:, 0])
    for k, (right, down) in ((90, (-0.20, 0.16)), (150, (0.22, 0.10)), (220, (0.16, 0.18))):
        draw(main[k] + np.hstack([right * t, down * t + 0.03 * np.sin(9 * t)]), 0.8 - 0.4 * t[:, 0])
    soft = cv2.GaussianBlur(rng.standard_normal((512, 512)), (0, 0), 40)
    ribs = np.zeros((512, 512))
    for start in np.arange(-0.4, 1.4, 0.3):
        off = np.abs(v - start - slope * u - 0.15 * (u - 0.5) ** 2) / 0.03
        ribs += np.exp(-((off - 1) ** 2) / 0.15) + 0.4 * (off < 1)
    light = np.exp(-contrast * path - 0.08 * soft / soft.std() - 0.03 * ribs)
    seen = cv2.GaussianBlur(rng.poisson(2500 * light) / 2500, (0, 0), 0.8)
    return np.clip(255 * seen / np.quantile(seen, 0.999), 0, 255), path


@pytest.mark.slow
@pytest.mark.parametrize("slope", [-0.4, 0.25])
@pytest.mark.parametrize("contrast", [0.10, 0.15])
def test_ribs_are_no_vessels_where_there_is_little_vessel(net, contrast, slope):
    """They are longer than all vessels then, and as strong as the thin ones."""
    grey, path = artery_over_ribs(contrast, slope, 0.27)
    found = extract_vessels(angiogram(grey, pixel_mm=0.27), ImagingOptions(), net)
    true = path > 0.1
    near = cv2.dilate(true.astype(np.uint8), np.ones((9, 9))) > 0
    line, reach = skeletonize(true), cv2.dilate(found.mask.astype(np.uint8), np.ones((7, 7))) > 0
    assert (found.skeleton & ~near).sum() < 0.1 * line.sum()
    assert reach[line].mean() > 0.95


def test_a_blank_picture_is_refused_by_both(net):
    noise = np.random.default_rng(0).normal(128, 2, (200, 200)).clip(0, 255)
    for who in ("net", "auto"):
        with pytest.raises(RefusedError, match="no vessel"):
            extract_vessels(angiogram(noise), ImagingOptions(segmenter=who), net)


@pytest.mark.slow
@pytest.mark.parametrize("claimed", [0.6, 1.0, 1.6])
def test_what_a_child_could_trace_is_found_whatever_the_size_of_a_pixel(net, claimed):
    """Ten pictures of vessels alone, of any contrast, 512 to 1024 pixels; true size or not."""
    table = pytest.importorskip(
        "gcar_export.studies.segmentation_table", reason="needs the workshop"
    )
    rows = [table.generated_score(k, net, "auto", claimed) for k in range(10)]
    assert {kind for kind, _ in rows} == {"trivial"}
    dice = np.sort([scores["Dice"] for _, scores in rows])
    # One picture shows a single short vessel: it is found where the pixel is not said too large.
    assert np.median(dice) > 0.9 and dice[1] > 0.84


@pytest.mark.slow
def test_expert_masks(net):
    """Eight of the real pictures: neither way is far from the other, and both together neither."""
    table = pytest.importorskip(
        "gcar_export.studies.segmentation_table", reason="needs the workshop"
    )
    pairs = sorted(table.find(data_dir(), "xca_masks").glob("*_gt.png"))[::5]
    if not pairs:
        pytest.skip("GCAR_DATA has no xca_masks")
    dice = {
        who: np.mean([table.expert_score(path, one, who)[0]["Dice"] for path in pairs])
        for who, one in (("net", net), ("classic", None), ("auto", net))
    }
    assert all(0.68 < value < 0.9 for value in dice.values())

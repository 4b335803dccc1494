from __future__ import annotations

import cv2
import numpy as np
import pytest

from gcar_deploy.imaging import enhance, segment
from tests.imaging.phantoms import PIXEL_MM, raw_picture, tube_paths


def _line(width, size=129, angle=0.0):
    row, column = np.indices((size, size), dtype=np.float64) - (size - 1) / 2
    across = row * np.cos(angle) - column * np.sin(angle)
    return np.exp(-(across**2) / (2 * width**2)).astype(np.float32)


@pytest.mark.parametrize("width", [2.0, 3.0, 5.0])
@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 4, 2.0])
def test_gaussian_ridge_has_the_closed_form_response(width, angle):
    # Blurred by s a ridge of width w has w' = sqrt(w^2 + s^2) and height w / w'; curvature
    # height / w'^2, and a drop height (1 - exp(-(g s)^2 / 2 w'^2)) to each side.
    picture, gap = _line(width, angle=angle), 2.5
    for sigma in (2.0, 3.0, 5.0):
        wide = np.hypot(width, sigma)
        height = width / wide
        drop = height * (1 - np.exp(-((gap * sigma / wide) ** 2) / 2))
        expected = sigma * np.sqrt(height / wide**2 * drop)
        middle = enhance.ridge_response(picture, sigma, gap)[60:68, 60:68].max()
        assert middle == pytest.approx(expected, rel=0.06)


@pytest.mark.parametrize("width", [2.0, 3.0, 4.0, 6.0])
def test_response_peaks_at_a_scale_that_grows_with_the_width(width):
    # -s^2 L'' alone peaks at s = sqrt(2) w; the drop to the sides moves that by a constant
    # factor, so the best scale is proportional to w.
    sigmas = np.geomspace(1.0, 20.0, 40)
    picture = _line(width, size=257)
    values = [enhance.ridge_response(picture, s, 2.5)[128, 128] for s in sigmas]
    wide = np.hypot(1.0, sigmas / width)  # the closed form in units of the width
    form = sigmas / width / wide**2 * np.sqrt(1 - np.exp(-((2.5 * sigmas / width / wide) ** 2) / 2))
    best, expected = sigmas[int(np.argmax(values))], sigmas[int(np.argmax(form))]
    assert best / expected == pytest.approx(1.0, abs=0.1)
    assert 0.8 < best / width < 2.0


def test_step_edge_answers_much_less_than_a_line():
    edge = np.zeros((96, 96), np.float32)
    edge[48:] = 1
    line = np.zeros((96, 96), np.float32)
    line[46:51] = 1
    for sigma in (1.5, 3.0):
        edge_response = enhance.ridge_response(edge, sigma, 2.5)[20:-20, 20:-20].max()
        line_response = enhance.ridge_response(line, sigma, 2.5)[20:-20, 20:-20].max()
        assert edge_response < 0.02 * line_response


def test_polarity_is_seen_and_symmetric():
    picture = raw_picture(tube_paths())
    dark, bright = (enhance.darkness(one, PIXEL_MM) for one in (picture, 255 - picture))
    assert dark > np.log(3)
    assert bright == pytest.approx(-dark, abs=1e-3)


@pytest.mark.parametrize("shutter", [False, True])
def test_a_thin_vessel_in_grain_tells_the_polarity(shutter):
    """A few pixels of a thousand are vessel: no percentile of all reaches them."""
    picture = raw_picture(0.5 * tube_paths(512, radius_mm=0.8), noise=6.0)
    if shutter:
        row, column = np.indices(picture.shape) - 255.5
        picture[np.hypot(row, column) > 250] = 4
    for sign, one in ((1, picture), (-1, 255 - picture)):
        assert sign * enhance.darkness(one, 0.2) > np.log(1.5)


def test_polarity_is_that_of_pixels_three_times_as_large():
    """Polarity is asked of coarse pixels: fine ones, alike up to their size, say the same."""
    picture = raw_picture(tube_paths())
    fine = cv2.resize(picture, None, fx=3, fy=3, interpolation=cv2.INTER_LINEAR)
    pixel_mm = 0.9 * enhance.POLARITY_PIXEL_MM
    dark, same = (
        enhance.darkness(picture, pixel_mm),
        enhance.darkness(fine, pixel_mm / 3),
    )
    assert dark > 0
    assert same == pytest.approx(dark, rel=0.1)


def test_background_fills_a_plane_in_to_a_tenth_of_the_contrast():
    row, column = np.indices((96, 96), dtype=np.float32)
    plane = 0.5 * row - 0.2 * column
    vessel = np.zeros((96, 96), bool)
    vessel[45:51, 10:80] = True
    filled = enhance.background(plane + 30 * vessel, vessel, 0.5)
    assert np.abs(filled - plane)[vessel].max() < 2.0


def test_straight_wire_goes_and_a_bent_vessel_stays():
    vessel = np.zeros((200, 200), np.uint8)
    cv2.ellipse(vessel, (100, 100), (60, 45), 0, 0, 250, 1, 1)
    both = vessel.copy()
    cv2.line(both, (185, 0), (170, 199), 1, 1)
    left = segment._without_wires(both > 0)
    assert (left & (vessel > 0)).sum() >= 0.98 * (vessel > 0).sum()
    assert left[:, 165:].sum() < 20  # of 200


def test_grain_that_is_strong_in_one_part_is_no_vessel_and_a_line_beside_it_stays():
    """Answers of a filter: four times as strong on the left as on the right, where a line runs."""
    noise = np.random.default_rng(4).standard_normal((240, 480)).astype(np.float32)
    answers = cv2.GaussianBlur(noise**2, (0, 0), 1.5)
    answers[:, :240] *= 4
    arc = np.zeros(answers.shape, np.uint8)
    cv2.ellipse(arc, (360, 120), (90, 80), 0, 0, 230, 1, 3)
    answers[arc > 0] = 12.0
    valid = np.ones(answers.shape, bool)
    grain = segment._grain(answers, valid, 0.5)
    assert np.median(grain[:, :200]) == pytest.approx(4 * np.median(grain[:, 280:]), rel=0.05)
    line = segment.centreline(answers, valid, 0.5)
    assert line[:, :240].sum() < 0.05 * line.sum()
    assert (line & (arc > 0)).sum() > 300 and (line & (arc == 0)).sum() < 20


def test_fine_pixels_show_a_given_mask_as_well_as_coarse_ones():
    """What is asked is how well the vessel stands out, not how well each of its pixels does."""
    path = tube_paths(256)
    fine = cv2.resize(path, (768, 768), interpolation=cv2.INTER_LINEAR)
    rng = np.random.default_rng(2)
    contrast = []
    for picture, share, pixel_mm in ((path, 1, 0.5), (fine, 3, 0.5 / 3)):
        # As many quanta: a ninth of them for each of nine pixels.
        noisy = picture + rng.normal(0, 0.3 * share, picture.shape)
        holes = np.zeros(picture.shape, bool)
        contrast.append(
            segment.given(noisy.astype(np.float32), picture > 0, holes, pixel_mm).contrast
        )
    assert contrast[1] == pytest.approx(contrast[0], rel=0.15)


def _noisy_tube(blur_px: float) -> np.ndarray:
    noise = np.random.default_rng(6).standard_normal((256, 256))
    noise = cv2.GaussianBlur(noise, (0, 0), blur_px) if blur_px else noise
    return raw_picture(tube_paths(radius_mm=1.8), noise=0.0) + 12.0 * noise / noise.std()


@pytest.mark.parametrize("blur_px, grain", [(0.0, True), (6.0, False)])
def test_the_rim_goes_lower_in_grain_than_in_structure(blur_px, grain, monkeypatch):
    found = {}
    for share in (0.45, 0.65):
        monkeypatch.setattr(segment, "RIM_HIGH_IN_GRAIN", share)
        picture = enhance.absorbance(_noisy_tube(blur_px).astype(np.float32))
        holes = np.zeros(picture.shape, bool)
        found[share] = segment.segment(picture, holes, PIXEL_MM)
    if not grain:
        np.testing.assert_array_equal(found[0.45].mask, found[0.65].mask)
        return
    truth = tube_paths(radius_mm=1.8) > 0.9
    low, high = ((found[s].mask & truth).sum() / truth.sum() for s in (0.45, 0.65))
    assert low > high + 0.05

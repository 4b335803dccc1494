from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import ImagingOptions
from gcar_deploy.errors import GeometryError, ImageError, RefusedError
from gcar_deploy.imaging.extract import (
    CONTRAST_ERROR,
    asks_network,
    extract_vessels,
)
from gcar_deploy.imaging.grey_values import bright_vessels
from gcar_deploy.imaging.polarity import with_polarity
from gcar_deploy.imaging.resample import (
    area_average,
    coarsened,
    coarser_view,
    resize,
    resized,
    stretched,
)
from gcar_deploy.imaging.widths import MASK_ERROR
from tests.conftest import data_dir
from tests.imaging.phantoms import PIXEL_MM, angiogram, carm, dice, raw_picture, tube_paths

_OPTIONS = ImagingOptions()
_PICTURES = ("path_mm", "mask", "skeleton", "device", "painted", "valid")


@pytest.mark.req("REQ-12")
def test_path_length_is_exact():
    truth = tube_paths()
    counts = np.round(truth / 0.001)
    found = extract_vessels(angiogram(counts, "path_length", mm_per_count=0.001), _OPTIONS)
    assert found.calibrated and found.kind == "path_length" and found.vesselness is None
    np.testing.assert_array_equal(found.mask, counts * np.float32(0.001) > 0.1 * PIXEL_MM)
    np.testing.assert_allclose(found.path_mm[found.mask], truth[found.mask], atol=6e-4)
    assert (found.path_mm[~found.mask] == 0).all()
    assert not (found.skeleton & ~found.mask).any()


@pytest.mark.req("REQ-12")
def test_a_mask_is_read_above_half_and_nothing_of_its_brightness():
    truth = tube_paths()
    binary = extract_vessels(angiogram(truth > 0.5, "mask"), _OPTIONS)
    np.testing.assert_array_equal(binary.mask, truth > 0.5)
    assert not binary.calibrated and binary.path_error == MASK_ERROR
    assert np.median(binary.path_mm[truth > 1] / truth[truth > 1]) == pytest.approx(1, abs=0.06)
    # grey: an edge drawn softly, any scale, brightness within that means nothing
    grey = np.where(truth > 0.5, 120 + 80 * np.random.default_rng(2).random(truth.shape), 40)
    soft = extract_vessels(angiogram(grey, "mask", polarity="bright"), _OPTIONS)
    np.testing.assert_array_equal(soft.mask, binary.mask)
    np.testing.assert_array_equal(soft.path_mm, binary.path_mm)


def test_a_users_mask_cuts_a_mask_and_keeps_the_brightness_of_a_picture():
    truth = tube_paths()
    half = np.zeros(truth.shape, bool)
    half[:, :150] = True
    given = dataclasses.replace(angiogram(truth > 0.5, "mask"), mask=half)
    np.testing.assert_array_equal(extract_vessels(given, _OPTIONS).mask, (truth > 0.5) & half)
    grey = dataclasses.replace(angiogram(raw_picture(truth, gain=0.06)), mask=truth > 0.5)
    found = extract_vessels(grey, _OPTIONS)
    assert found.kind == "raw" and found.path_error == CONTRAST_ERROR


@pytest.mark.parametrize("slope", [0.0, 1.0, -1.0])
def test_a_short_vessel_is_as_long_whichever_way_it_runs(slope):
    row, col = PIXEL_MM * (np.indices((256, 256)) - 127.5)
    along, off = (np.array([col + slope * row, row - slope * col])) / np.hypot(1, slope)
    wide = np.abs(off) < 1.0
    long_enough = angiogram(wide & (np.abs(along) < 15), "mask")  # 30 mm
    np.testing.assert_array_equal(extract_vessels(long_enough, _OPTIONS).mask, long_enough.pixels)
    with pytest.raises(RefusedError, match="mm of line"):
        extract_vessels(angiogram(wide & (np.abs(along) < 11), "mask"), _OPTIONS)


def test_masks_need_no_network():
    assert not asks_network([angiogram(tube_paths() > 0.5, "mask")])
    assert asks_network([angiogram(raw_picture(tube_paths()))])


def test_thin_vessel_survives_in_coarse_path_lengths():
    # 0.6 mm vessel in 1.4 mm pixels: below half a pixel wide
    fine = tube_paths(size=512, radius_mm=0.3, pixel_mm=0.15, oversample=2)
    coarse = area_average(fine, 55, 55)
    found = extract_vessels(
        angiogram(coarse, "path_length", pixel_mm=512 * 0.15 / 55, mm_per_count=1.0), _OPTIONS
    )
    line = area_average((fine > 0.5).astype(np.float32), 55, 55) > 0.15
    assert found.mask[line].mean() > 0.95


@pytest.mark.parametrize("radius_mm", [0.9, 1.5, 2.2])
@pytest.mark.req("REQ-12")
def test_raw_tube_gives_mask_and_path_within_a_stated_tolerance(radius_mm):
    truth = tube_paths(radius_mm=radius_mm)
    found = extract_vessels(angiogram(raw_picture(truth)), _OPTIONS)
    assert not found.calibrated and found.kind == "raw"
    assert dice(found.mask, truth > 0.3 * radius_mm) > 0.85
    both = found.mask & (truth > radius_mm)
    assert np.median(found.path_mm[both] / truth[both]) == pytest.approx(1.0, abs=0.15)
    assert np.corrcoef(found.path_mm[both | found.mask], truth[both | found.mask])[0, 1] > 0.85
    assert np.isfinite(found.path_mm).all() and (found.path_mm >= 0).all()


def test_polarity_declared_or_seen_gives_the_same_vessels():
    picture = raw_picture(tube_paths(), gain=0.04)
    dark = extract_vessels(angiogram(picture, polarity="dark"), _OPTIONS)
    seen = extract_vessels(angiogram(picture), _OPTIONS)
    np.testing.assert_array_equal(dark.mask, seen.mask)
    negative = 255 - picture
    for polarity in ("bright", "auto"):
        turned = extract_vessels(angiogram(negative, polarity=polarity), _OPTIONS)
        assert dice(turned.mask, dark.mask) > 0.9


def test_a_picture_that_is_hardly_bright_is_what_is_usual_of_its_kind():
    """Lines of both signs, one a little stronger: no reason to turn a picture round."""
    row, column = np.indices((256, 256))
    rng = np.random.default_rng(4)
    level = 120 + 0.2 * column + rng.normal(0, 4, row.shape)
    level[60:63, 20:230] += 10  # one bright line
    level[150:153, 20:230] -= 7  # and a dark one that is a little weaker
    for kind, usual in (("raw", "dark"), ("attenuation", "bright")):
        given = angiogram(level.astype(np.float32), kind)
        (told,) = with_polarity([given])
        assert told.intensity.polarity == usual
        assert with_polarity([told])[0].intensity.polarity == usual
    for kind in ("path_length", "mask"):
        given = angiogram(level.astype(np.float32), kind, mm_per_count=1.0)
        assert with_polarity([given])[0] is given


def test_a_doubtful_picture_is_read_like_the_clear_one_beside_it():
    """Both came through one display; what is sure by itself stays, declared or seen."""
    clear = raw_picture(tube_paths(), gain=0.02)
    rng = np.random.default_rng(5)
    doubtful = np.clip(128 + 30 * rng.standard_normal(clear.shape), 0, 255).astype(np.float32)
    sure = raw_picture(tube_paths(), gain=0.2, noise=0.5)

    def read(*pictures, **declared):
        told = with_polarity([angiogram(one, **declared) for one in pictures])
        return [one.intensity.polarity for one in told]

    assert read(doubtful, clear) == read(clear, doubtful) == ["dark", "dark"]
    assert read(doubtful, 255 - clear) == ["bright", "bright"]
    assert read(sure, 255 - sure) == ["dark", "bright"]
    assert read(doubtful, 255 - clear, polarity="dark") == ["dark", "dark"]


def test_a_negative_with_a_shutter_gives_the_same_vessels():
    picture = raw_picture(tube_paths(), gain=0.04)
    row, column = np.indices(picture.shape) - 127.5
    picture[np.hypot(row, column) > 128] = 4
    dark, turned = (
        extract_vessels(angiogram(one), _OPTIONS).mask for one in (picture, 255 - picture)
    )
    assert dice(dark, tube_paths() > 0.5) > 0.8
    assert dice(dark, turned) > 0.95


def test_sixteen_bit_equals_eight_bit_within_quantisation():
    light = raw_picture(tube_paths(), noise=0.0)
    noise = np.random.default_rng(3).normal(0, 1.5, light.shape)
    eight = np.clip(np.round(light + noise), 0, 255)
    sixteen = np.clip(np.round((light + noise) * 257), 0, 65535)
    a, b = (extract_vessels(angiogram(p), _OPTIONS) for p in (eight, sixteen))
    assert dice(a.mask, b.mask) > 0.97
    assert b.path_mm.sum() == pytest.approx(a.path_mm.sum(), rel=0.03)


@pytest.mark.req("REQ-12")
def test_attenuation_scale_does_not_matter():
    truth = tube_paths()
    noise = np.random.default_rng(4).normal(0, 0.05, truth.shape)
    results = [
        extract_vessels(angiogram(gain * (truth + noise + 1), "attenuation"), _OPTIONS)
        for gain in (1.0, 250.0)
    ]
    np.testing.assert_allclose(results[0].path_mm, results[1].path_mm, atol=2e-3)
    both = results[0].mask & (truth > 1)
    ratio = np.median(results[0].path_mm[both] / truth[both])
    assert ratio == pytest.approx(1.0, abs=0.15)
    assert not results[0].calibrated


_N = 256
_RNG = np.random.default_rng(5)
_EMPTY = {
    "black": np.zeros((_N, _N)),
    "white": np.full((_N, _N), 255),
    "grey": np.full((_N, _N), 77),
    "noise": 128 + 8 * _RNG.standard_normal((_N, _N)),
    "ramp": np.add.outer(np.arange(_N), np.arange(_N)) * 0.2 + 20,
    "edge": np.repeat([200.0, 90.0], _N // 2)[:, None] + 3 * _RNG.standard_normal((_N, _N)),
    "one hot pixel": np.eye(1, _N * _N, 700).reshape(_N, _N) * 255,
}


@pytest.mark.parametrize("kind", ["raw", "attenuation"])
@pytest.mark.parametrize("name", sorted(_EMPTY))
def test_no_vessel_is_refused_with_the_view(name, kind):
    with (
        np.errstate(divide="raise", invalid="raise", over="raise"),
        pytest.raises(RefusedError, match="no vessel found in view 2"),
    ):
        extract_vessels(angiogram(_EMPTY[name], kind), _OPTIONS)


@pytest.mark.parametrize("name", ["black", "white", "grey"])
def test_no_path_is_refused(name):
    with pytest.raises(RefusedError, match="no vessel found in view 2"):
        extract_vessels(angiogram(_EMPTY[name], "path_length", mm_per_count=0.01), _OPTIONS)
    with pytest.raises(RefusedError, match="longer than"):
        faint = np.zeros((64, 64))
        faint[3, 3] = 1
        extract_vessels(angiogram(faint, "path_length", mm_per_count=1e-6), _OPTIONS)


def test_path_length_needs_a_scale_and_bright_vessels():
    with pytest.raises(GeometryError, match="mm_per_count"):
        extract_vessels(angiogram(tube_paths(), "path_length"), _OPTIONS)
    with pytest.raises(GeometryError, match="bright"):
        extract_vessels(
            angiogram(tube_paths(), "path_length", mm_per_count=1.0, polarity="dark"), _OPTIONS
        )


def test_wrong_shape_is_an_error():
    import dataclasses

    with pytest.raises(ImageError, match="the geometry says"):
        dataclasses.replace(angiogram(np.zeros((32, 32))), pixels=np.zeros((32, 31), np.float32))


def test_same_input_same_bytes():
    picture = raw_picture(tube_paths())
    first, second = (extract_vessels(angiogram(picture), _OPTIONS) for _ in range(2))
    assert first.path_mm.tobytes() == second.path_mm.tobytes()


@pytest.mark.parametrize("shape", [(64, 64), (128, 128), (100, 77), (256, 31), (300, 400)])
def test_resized_keeps_the_mass_and_the_line(shape):
    counts = np.round(tube_paths() / 0.001)
    old = extract_vessels(angiogram(counts, "path_length", mm_per_count=0.001), _OPTIONS)
    new = resized(old, *shape)
    assert new.mask.shape == shape == (new.carm.rows, new.carm.columns)
    ratio = (256 * 256) / (shape[0] * shape[1])
    assert new.path_mm.sum(dtype=np.float64) * ratio == pytest.approx(
        old.path_mm.sum(dtype=np.float64), rel=1e-5
    )
    assert new.skeleton.any() and not (new.skeleton & ~new.mask).any()


def test_one_way_may_shrink_alone():
    picture = np.random.default_rng(4).random((60, 40)).astype(np.float32)
    means = picture.reshape(20, 3, 40).mean(axis=1)
    np.testing.assert_allclose(resize(picture, (40, 20)), means, atol=1e-6)
    np.testing.assert_allclose(resize(picture.T.copy(), (20, 40)), means.T, atol=1e-6)


def test_a_border_more_leaves_a_coarser_view_as_it_was():
    view = extract_vessels(angiogram(tube_paths() > 0.5, "mask"), _OPTIONS)
    told = dataclasses.replace(view, device=view.path_mm / 9, painted=view.mask)
    column, row = view.carm.principal_point

    def wider(picture):
        return np.pad(picture, ((7, 3), (5, 2)))

    wide = dataclasses.replace(
        told,
        carm=dataclasses.replace(
            view.carm, rows=view.carm.rows + 10, columns=view.carm.columns + 7,
            principal_point_px=(column + 5, row + 7),
        ),
        **{name: wider(getattr(told, name)) for name in _PICTURES},
    )  # fmt: skip
    one, other = coarser_view(told, 2), coarser_view(wide, 2)
    down, across = (
        round(b - a) for a, b in zip(one.carm.principal_point[::-1],
                                     other.carm.principal_point[::-1], strict=True)
    )  # fmt: skip
    assert one.mask.any() and one.carm.pixel_at_isocenter_mm > view.carm.pixel_at_isocenter_mm
    for name in _PICTURES[:-1]:
        a, b = getattr(one, name), getattr(other, name)
        inner = b[down + 2 : down + a.shape[0] - 2, across + 2 : across + a.shape[1] - 2]
        np.testing.assert_allclose(inner, a[2:-2, 2:-2], atol=1e-6, err_msg=name)


def test_all_of_a_view_is_resized():
    view = extract_vessels(angiogram(tube_paths() > 0.5, "mask"), _OPTIONS)
    told = dataclasses.replace(view, device=view.path_mm / 9, catheter=view.mask)
    small = resized(told, 128, 64)
    assert small.device is not None and small.catheter is not None
    np.testing.assert_allclose(small.device, small.path_mm / 9, atol=1e-6)


def test_area_average_by_a_whole_factor_is_the_block_mean():
    picture = np.random.default_rng(0).random((32, 48)).astype(np.float32)
    blocks = picture.reshape(8, 4, 12, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(area_average(picture, 8, 12), blocks, rtol=1e-5)


@pytest.mark.parametrize("factor", [2, 2.7, 5.13])
def test_coarser_pixels_keep_the_mass_and_see_the_same_points(factor):
    small = carm(64, 51)
    picture = np.zeros((64, 51), np.float32)
    picture[20:40, 15:35] = np.random.default_rng(0).random((20, 20))
    new, (coarse,) = coarsened(small, (picture,), factor)
    assert coarse.shape == (new.rows, new.columns)
    assert coarse.sum() * factor**2 == pytest.approx(picture.sum(), rel=1e-5)
    assert new.pixel_at_isocenter_mm == pytest.approx(factor * small.pixel_at_isocenter_mm)
    # the mean of the old pixels' places is the new pixel's place, but for parts of pixels
    rows, columns = np.indices(picture.shape, dtype=np.float32)
    _, (row, column) = coarsened(small, (rows, columns), factor)
    at = np.array([[5, 6], [8, 3], [4, 4]])
    old = np.stack([column[at[:, 1], at[:, 0]], row[at[:, 1], at[:, 0]]], axis=1)
    np.testing.assert_allclose(new.rays(at), small.rays(old), atol=3e-5)


def test_a_border_more_leaves_the_coarser_pixels_where_they_were():
    picture = np.random.default_rng(1).random((64, 51)).astype(np.float32)
    small = carm(64, 51)
    column, row = small.principal_point
    wide = dataclasses.replace(
        carm(71, 54), principal_point_px=(column + 3, row + 7), pixel_spacing_mm=(
            small.pixel_spacing_mm
        ),
    )  # fmt: skip
    picture[:6] = picture[:, :6] = 0
    one, (a,) = coarsened(small, (picture,), 2.7)
    two, (b,) = coarsened(wide, (np.pad(picture, ((7, 0), (3, 0))),), 2.7)
    down, right = np.subtract(two.principal_point[::-1], one.principal_point[::-1]).astype(int)
    np.testing.assert_allclose(b[down:, right:], a, atol=1e-6)


@pytest.mark.parametrize(("scale", "middle"), [(1 / 2.45, 29.5), (1.25, 29.6)])
@pytest.mark.parametrize("border", [0, 7, 61])
def test_pixels_that_meet_old_ones_take_nothing_of_the_next(scale, middle, border):
    # Edges of larger pixels, or middles of smaller ones, fall on old ones but for rounding.
    seen = dataclasses.replace(carm(151, 151), principal_point_px=(middle + border,) * 2)
    _, down, across = stretched(seen, (scale, scale))
    weights = np.concatenate([down.data, across.data])
    assert not ((weights > 0) & (weights < 1e-3)).any()


@pytest.mark.slow
def test_real_and_simulated_pictures():
    from gcar_export.studies import segmentation_table as table

    data = data_dir()
    pairs = sorted(table.find(data, "xca_masks").glob("*_gt.png"))
    cases = table.find(data, "cases")
    if not pairs or not any(cases.glob("R_*")):
        pytest.skip("no expert masks or raw cases in GCAR_DATA")
    assert np.mean([table.expert_score(p)[0]["Dice"] for p in pairs]) > 0.74
    for name, scores, _, _ in table.case_scores(cases):
        assert scores["Dice"] > 0.8 and scores["clDice"] > 0.9, name
        assert scores["correlation"] > 0.85 and 0.75 < scores["scale"] < 1.25, name


@pytest.mark.parametrize("dark", [True, False])
@pytest.mark.parametrize("by", [1 / 255, 257.0])
def test_grey_values_may_be_counted_in_any_unit(dark, by):
    counts = np.random.default_rng(3).integers(0, 256, (64, 64)).astype(np.float32)
    laws, _ = bright_vessels(counts, "raw", dark)
    scaled, _ = bright_vessels(counts * np.float32(by), "raw", dark)
    assert laws["log"].max() > 5
    for law, picture in laws.items():
        np.testing.assert_allclose(scaled[law], picture, atol=1e-4, err_msg=law)

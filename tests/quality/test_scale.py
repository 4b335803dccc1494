"""Scale, duplicates and human ranges: what pictures themselves say against their calibration."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from gcar_deploy.engine import Engine
from gcar_deploy.errors import RefusedError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.path_noise import vessels_in_noise
from gcar_deploy.imaging.skeleton import skeletonize
from gcar_deploy.inspection import inspect_files
from gcar_deploy.quality.duplicates import check_duplicates
from gcar_deploy.quality.human_range import check_human_range
from gcar_deploy.quality.scale import check_gross_scale, check_scale, scale_factor
from gcar_deploy.selftest import tiny_case
from gcar_deploy.tree.tree import Branch, Tree

CARM = CArm(
    primary_angle_deg=-30, secondary_angle_deg=20, sod_mm=765, sdd_mm=1100, rows=512, columns=512,
    pixel_spacing_mm=(0.39, 0.39),
)  # fmt: skip


def tube(direction, radius=1.5, length=60.0, middle=(0.0, 0.0, 0.0)):
    t = np.linspace(-length / 2, length / 2, 61)[:, None]
    points = np.asarray(middle) + t * np.asarray(direction) / np.linalg.norm(direction)
    full = np.full(len(points), float(radius))
    branch = Branch(
        points_mm=points, radius_mm=full, sigma_mm=0 * full, confidence=full, start=0, end=1
    )
    return Tree(nodes_mm=points[[0, -1]], branches=(branch,))


def picture(tree, carm=CARM, factor=1.0, radius=None):
    """Path lengths by sampling each pixel's ray: no code of the refinement takes part."""
    cols, rows = np.meshgrid(np.arange(carm.columns), np.arange(carm.rows))
    a, b = tree.branches[0].points_mm[[0, -1]]
    r = tree.branches[0].radius_mm[0] if radius is None else radius
    source, (fc, fr) = carm.source_mm, carm.focal_px
    c0, r0 = (carm.columns - 1) / 2, (carm.rows - 1) / 2
    u, v, d = carm.axes
    ray = ((cols - c0) / fc)[..., None] * u + ((rows - r0) / fr)[..., None] * v + d
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    axis = (b - a) / np.linalg.norm(b - a)
    # Infinite cylinder: quadratic in the distance along the ray.
    o = source - a
    dp, op = ray - (ray @ axis)[..., None] * axis, o - (o @ axis) * axis
    A, B, C = (dp * dp).sum(-1), dp @ op, op @ op - r * r
    chord = 2 * np.sqrt(np.maximum(B * B - A * C, 0)) / A
    chord[np.abs((source + ray * (-(B / A))[..., None] - a) @ axis - 30) > 30] = 0
    path = (factor * chord).astype(np.float32)
    mask = path > 0
    return VesselImage(
        view_id="1", carm=carm, path_mm=path, path_error=0.0, mask=mask, skeleton=mask,
        valid=np.ones_like(mask), kind="path_length",
    )  # fmt: skip


@pytest.mark.parametrize("radius", [0.8, 1.5, 2.5])
@pytest.mark.parametrize("factor", [1.01, 1.15, 2.0])
def test_the_factor_of_a_round_tube_is_found(radius, factor):
    tree = tube((0.3, 0.5, 1.0), radius)
    found = scale_factor(tree, picture(tree, factor=factor))
    assert found == pytest.approx(factor, rel=0.06)


def two_tubes(factor, blur_px, radii=(0.8, 2.4)):
    """A thin and a thick tube side by side, their paths scaled and blurred."""
    thin = tube((0, 0.2, 1), radii[0], middle=(-20, 0, 0))
    thick = tube((0, 0.2, 1), radii[1])
    both = [picture(one, factor=factor).path_mm for one in (thin, thick)]
    path = sum(both)
    if blur_px:
        path = cv2.GaussianBlur(path, (0, 0), blur_px)
        path[path < 1e-3] = 0
    view = dataclasses.replace(picture(thin), path_mm=path)
    tree = Tree(nodes_mm=np.zeros((4, 3)), branches=(*thin.branches, *thick.branches))
    return tree, view


@pytest.mark.parametrize("blur_px", [0, 1.2])
def test_blur_is_no_wrong_scale_and_does_not_hide_one(blur_px):
    assert scale_factor(*two_tubes(1.0, blur_px)) == pytest.approx(1.0, abs=0.1)
    assert scale_factor(*two_tubes(0.5, blur_px)) == pytest.approx(0.5, abs=0.06)
    assert scale_factor(*two_tubes(1.8, 0)) == pytest.approx(1.8, rel=0.06)
    tree, view = two_tubes(0.5, blur_px)
    assert "mm_per_count" in check_scale(tree, [view])[0]


def test_noise_is_no_wrong_scale_and_does_not_hide_one():
    def noisy(factor):
        tree, view = two_tubes(factor, 1.0, radii=(0.6, 1.3))
        noise = np.random.default_rng(2).normal(0, 0.25, view.path_mm.shape)
        path = np.maximum(view.path_mm + noise, 0).astype(np.float32)
        mask, level = vessels_in_noise(path, view.valid, view.carm.pixel_at_isocenter_mm, 0.03)
        path = np.where(mask, path, np.float32(0))
        return tree, dataclasses.replace(view, path_mm=path, mask=mask, noise_mm=level)

    tree, view = noisy(1.0)
    assert check_scale(tree, [view, view]) == []
    # Taken for vessel, noise beside it makes its shadow look too wide for its paths.
    taken = dataclasses.replace(view, noise_mm=0.0)
    assert "of all views are 0.9" in check_scale(tree, [taken, taken])[0]
    tree, view = noisy(1.4)
    assert scale_factor(tree, view) == pytest.approx(1.4, rel=0.05)
    assert "mm_per_count" in check_scale(tree, [view, view])[0]


def test_short_paths_of_one_calibre_may_be_blur():
    tree = tube((0.3, 0.5, 1.0), 1.5)
    assert scale_factor(tree, picture(tree, factor=0.5)) is None


def test_the_radii_of_the_tree_take_no_part():
    tree = tube((0.3, 0.5, 1.0), 1.5)
    wrong = tube((0.3, 0.5, 1.0), 2.2)
    assert scale_factor(wrong, picture(tree, factor=1.1)) == pytest.approx(1.1, rel=0.06)


def test_right_scales_pass_and_wrong_ones_are_named():
    tree = tube((1.0, 0.2, 0.6))
    assert check_scale(tree, [picture(tree)]) == []
    (said,) = check_scale(tree, [picture(tree, factor=1.35)])
    assert "view 1" in said and "mm_per_count" in said and "1.3" in said
    for factor in (2.0, 10.0):
        with pytest.raises(RefusedError, match="mm_per_count or the pixel spacing"):
            check_scale(tree, [picture(tree, factor=factor)])


@pytest.mark.parametrize(
    ("first", "second", "said"),
    # lumens wider than deep: too long in one view, too short in the other
    [(1.12, 1.12, "1.1"), (1.12, 0.95, ""), (1.02, 1.0, ""), (1.0, 1.15, "")],
)
def test_all_views_together_tell_a_scale_to_a_tenth(first, second, said):
    tree, across = tube((0.2, 0.1, 1.0)), dataclasses.replace(CARM, primary_angle_deg=60)
    views = [picture(tree, factor=first), picture(tree, across, factor=second)]
    found = check_scale(tree, views)
    assert (said in found[0] and "all views" in found[0]) if said else found == []


def test_an_enlarged_picture_has_wider_shadows_and_is_told_so():
    tree, across = tube((0.2, 0.1, 1.0)), dataclasses.replace(CARM, primary_angle_deg=60)
    views = [picture(tree, factor=0.89), picture(tree, across, factor=0.89)]
    mean = "gcar_deploy.quality.scale.mean_factor"
    with pytest.MonkeyPatch.context() as patch:
        for factor, enlarged, words in (
            (0.9, 1.0, "says; is mm_per_count"), (0.9, 2.0, ""), (1.12, 2.0, "says; is mm"),
            (0.8, 2.0, "says; enlarging a picture widens shadows; or is mm_per_count"),
        ):  # fmt: skip
            patch.setattr(mean, lambda *_, f=factor: f)
            found = check_scale(tree, [dataclasses.replace(v, enlarged=enlarged) for v in views])
            assert (words in found[0]) if words else found == []
    # Enlarged, pixels as wide as vessels do not become fine ones.
    wide = picture(tree, dataclasses.replace(CARM, pixel_spacing_mm=(0.8, 0.8)), 1.4, radius=2.0)
    assert check_scale(tree, [wide]) != []
    assert check_scale(tree, [dataclasses.replace(wide, enlarged=2.0)]) == []


def test_a_scale_that_is_far_off_is_refused_on_the_pictures_own_lines():
    tree = tube((1.0, 0.2, 0.6))
    given = Angiogram(
        view_id="1", carm=CARM, pixels=np.zeros((512, 512), np.float32), bit_depth=16, sha256="1",
        intensity=Intensity(kind="path_length", mm_per_count=0.001),
    )  # fmt: skip
    views = {f: picture(tree, factor=f) for f in (0.1, 1.0, 2.0, 4.0, 10.0)}
    views = {f: dataclasses.replace(v, skeleton=skeletonize(v.mask)) for f, v in views.items()}
    for factor in (0.1, 1.0, 2.0):
        check_gross_scale([given], [views[factor]])
    for factor in (4.0, 10.0):
        with pytest.raises(RefusedError, match=r"view 1: .* about .*; is mm_per_count"):
            check_gross_scale([given], [views[factor]])
    # A line that a person drew has no width; what is not calibrated has no scale.
    check_gross_scale([dataclasses.replace(given, mask=views[4.0].mask)], [views[4.0]])
    check_gross_scale([given], [dataclasses.replace(views[4.0], path_error=0.3)])


def test_a_vessel_along_the_beam_of_one_view_is_no_wrong_scale():
    """Its path is far longer than it is wide in that view alone; a wrong scale is so in all."""
    along = np.asarray(CARM.axes[2]) + 0.2 * np.asarray(CARM.axes[1])
    tree, other = tube(along, radius=1.2), dataclasses.replace(CARM, primary_angle_deg=55)
    given = Angiogram(
        view_id="1", carm=CARM, pixels=np.zeros((512, 512), np.float32), bit_depth=16, sha256="1",
        intensity=Intensity(kind="path_length", mm_per_count=0.001),
    )  # fmt: skip

    def views(factor):
        seen = [picture(tree, carm, factor) for carm in (CARM, other)]
        return [dataclasses.replace(v, skeleton=skeletonize(v.mask)) for v in seen]

    with pytest.raises(RefusedError):
        check_gross_scale([given], views(1.0)[:1])
    check_gross_scale([given] * 2, views(1.0))
    with pytest.raises(RefusedError):
        check_gross_scale([given] * 2, views(4.0))


@pytest.mark.parametrize("radius", [0.9, 1.2, 1.8])
def test_paths_at_the_middles_of_wide_pixels_are_not_too_long(radius):
    carms = [
        dataclasses.replace(CARM, pixel_spacing_mm=(0.78, 0.78), rows=256, columns=256,
                            primary_angle_deg=angle)
        for angle in (-30, 45)
    ]  # fmt: skip
    tree = tube((0.3, 0.5, 1.0), radius)
    for factor, doubted in ((1.0, False), (1.25, True)):
        found = check_scale(tree, [picture(tree, carm, factor) for carm in carms])
        assert bool(found) is doubted, found


def test_a_scale_that_is_far_off_costs_no_fit_and_validate_knows_it(monkeypatch):
    def refine(*_, **__):
        raise AssertionError("fitted")

    angiograms, grid, _ = tiny_case()
    monkeypatch.setattr("gcar_deploy.reconstruct.refine", refine)
    wrong = [dataclasses.replace(a, pixels=a.pixels * np.float32(10)) for a in angiograms]
    with pytest.raises(RefusedError, match="mm_per_count"):
        Engine(threads=1).reconstruct(wrong, grid)
    assert "mm_per_count" in str(inspect_files(wrong, grid).error)
    assert inspect_files(angiograms, grid).error is None


def test_pictures_without_calibration_are_not_judged():
    tree = tube((1.0, 0.2, 0.6))
    view = dataclasses.replace(picture(tree, factor=3.0), path_error=0.3)
    assert check_scale(tree, [view]) == []


def test_a_vessel_along_the_ray_and_a_short_one_tell_nothing():
    along = tube(CARM.axes[2])
    assert scale_factor(along, picture(along)) is None
    assert scale_factor(Tree(nodes_mm=np.zeros((0, 3)), branches=()), picture(along)) is None


@pytest.mark.parametrize("change", ["bytes", "depth", "noise", "half", "grey scale", "huge"])
def test_one_picture_given_twice_is_refused_in_any_bytes(change):
    (first, second), *_ = tiny_case()
    pixels = first.pixels
    if change == "depth":
        pixels = np.round(pixels / pixels.max() * 255).astype(np.float32)
    if change == "noise":
        noise = np.random.default_rng(0).normal(0, 0.01 * pixels.max(), pixels.shape)
        pixels = np.clip(pixels + noise, 0, None).astype(np.float32)
    if change == "half":
        pixels = cv2.resize(pixels, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    if change == "grey scale":
        pixels = 1000 * pixels
    if change == "huge":
        pixels = pixels * (3e38 / pixels.max())
    carm = dataclasses.replace(second.carm, rows=pixels.shape[0], columns=pixels.shape[1])
    copy = dataclasses.replace(second, pixels=pixels, carm=carm, sha256="other")
    with pytest.raises(RefusedError, match="same picture"):
        check_duplicates([first, copy])
    check_duplicates([first, second])
    near = first.carm.turned(2.0, 0.0)
    check_duplicates([first, dataclasses.replace(first, carm=near, sha256="other")])


def test_sizes_that_no_human_has_are_doubted():
    assert check_human_range(tube((0, 0, 1), 2.0, 100.0)) == []
    assert "mm are usual" in check_human_range(tube((0, 0, 1), 5.0, 100.0))[0]
    assert "mm are usual" in check_human_range(tube((0, 0, 1), 0.3, 100.0))[0]
    assert "extends over 300 mm" in check_human_range(tube((0, 0, 1), 2.0, 300.0))[0]
    assert check_human_range(tube((0, 0, 1), 5.0, 30.0)) == []


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "outcome"), [(1.0, "ok"), (1.35, "degraded"), (2.0, "refused")])
def test_a_whole_run_judges_the_scale(factor, outcome):
    """Two views of a tube at 0.27 mm pixels, whose counts are said to mean more than they do."""
    from gcar_deploy import Engine
    from gcar_deploy.geometry.grid import Grid

    engine = Engine(threads=1)
    tree = tube((0.4, 0.3, 1.0), 1.6, 70.0)
    carms = (CARM, dataclasses.replace(CARM, primary_angle_deg=50, secondary_angle_deg=-10))
    given = tiny_case()[0][0]
    pictures = [
        dataclasses.replace(
            given, view_id=str(k), carm=carm, sha256=str(k),
            pixels=(1000 * factor * picture(tree, carm).path_mm).astype(np.float32),
        )
        for k, carm in enumerate(carms, start=1)
    ]  # fmt: skip
    grid = Grid(center_mm=(0, 0, 0), size_mm=(96, 96, 96), shape=(96, 96, 96))
    if outcome == "refused":
        with pytest.raises(RefusedError, match="mm_per_count"):
            engine.reconstruct(pictures, grid)
        return
    result = engine.reconstruct(pictures, grid)
    assert result.status == outcome, result.quality.sentence
    assert any("mm_per_count" in f for f in result.quality.findings) == (outcome == "degraded")


@pytest.mark.parametrize("shape", ["square", "round"])
@pytest.mark.parametrize("polarity", ["dark", "bright"])
def test_views_behind_one_collimator_are_two_and_a_copy_behind_it_is_one(shape, polarity):
    noise = np.random.default_rng(1)
    side = 256
    row, column = np.indices((side, side)) - 0.5 * (side - 1)
    off = np.hypot(row, column) if shape == "round" else np.maximum(abs(row), abs(column))

    def shown(angiogram, tilt):
        path = cv2.resize(angiogram.pixels, (side, side), interpolation=cv2.INTER_AREA) / 1000
        grey = (180 + tilt * row / 4) * np.exp(-0.06 * path) + noise.normal(0, 2, path.shape)
        grey = np.where(off > 0.4 * side, 3.0, grey)
        grey = grey if polarity == "dark" else 255 - grey
        return dataclasses.replace(
            angiogram, pixels=np.clip(grey, 0, 255).astype(np.float32), sha256=str(noise.random()),
            carm=dataclasses.replace(angiogram.carm, rows=side, columns=side),
            intensity=Intensity(kind="raw"),
        )  # fmt: skip

    (first, second), *_ = tiny_case()
    check_duplicates([shown(first, 0.0), shown(second, 0.2)])
    copy = dataclasses.replace(shown(first, 0.0), carm=shown(second, 0.0).carm)
    with pytest.raises(RefusedError, match="same picture"):
        check_duplicates([shown(first, 0.0), copy])

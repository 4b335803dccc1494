"""Wrong scenes are wrong in the way they are called, and right ones are right."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the export extra")

from gcar_export.scenes.render import path_lengths
from gcar_export.studies.wrong_scenes import CHANGES, SHOWN_PX, exam, rays_miss_px, wrong_scenes
from gcar_export.studies.wrong_scenes_table import RIGHT, Row, roc_table, shape_error_mm, tables

SEED = 62_009


@pytest.fixture(scope="module")
def case():
    return exam(SEED, 0, "path_length", 2)


@pytest.fixture(scope="module")
def scenes(case):
    return {scene.name: scene for scene in wrong_scenes(case)}


def test_the_rays_of_the_right_scene_meet_and_the_list_is_long(case, scenes):
    assert rays_miss_px(case, case.told) < 1e-6
    assert len(scenes) == len(CHANGES) >= 40
    assert len(list(wrong_scenes(exam(SEED, 1, "mask", 3)))) == len(CHANGES) - 4  # mm_per_count


@pytest.mark.parametrize(
    "name",
    ["last picture mirrored", "last picture upside down", "last picture turned by 180 deg",
     "last picture turned by 90 deg", "last picture moved by 20 px",
     "last picture cropped and resized"],
)  # fmt: skip
def test_points_are_said_to_move_with_the_pixels(case, scenes, name):
    """A vessel's points fall on bright pixels of the changed picture."""
    told, carm = scenes[name].told, case.told.carms[-1]
    at = np.rint(told.moves[-1](carm.project(case.line_mm)[0])).astype(int)
    image = told.images[-1]
    inside = ((at >= 0) & (at < image.shape[0])).all(axis=1)
    assert inside.mean() > 0.3
    assert (image[at[inside, 1], at[inside, 0]] > 0).mean() > 0.97


@pytest.mark.parametrize(
    ("name", "shows"),
    [("secondary angle of the last view +10 deg", "rays"), ("mm_per_count x2", "width"),
     ("last picture cropped", "shape"), ("two patients", "content"),
     ("spacing of all views x1.1", "width"), ("last picture mirrored", "rays")],
)  # fmt: skip
def test_how_an_error_shows(scenes, name, shows):
    assert scenes[name].shows == shows


def test_a_turn_round_the_line_that_two_level_views_see_best_does_not_show(case):
    level = [dataclasses.replace(carm, secondary_angle_deg=0.0) for carm in case.told.carms]
    images = [path_lengths(carm, *case.tree.segments()) for carm in level]
    told = dataclasses.replace(case.told, carms=tuple(level), images=tuple(images))
    own = dataclasses.replace(case, told=told)
    by = told.view(-1, primary_angle_deg=level[-1].primary_angle_deg + 5)
    tilted = told.view(-1, secondary_angle_deg=5.0)
    assert rays_miss_px(own, by) < SHOWN_PX < rays_miss_px(own, tilted)


def test_a_common_shift_is_no_error():
    line = np.random.default_rng(1).normal(size=(300, 3)) * 30
    assert shape_error_mm(line + np.array([0.4, -0.3, 0.5]), line) < 0.05
    assert shape_error_mm(1.2 * line, line) > 1


def row(change, status, score, error=3.0, shows="rays"):
    return Row(
        exam="1/0 left", pictures="raw", views=2, family="angle" if change != RIGHT else RIGHT,
        change=change, shows=shows, status=status, sentence="", error_mm=error, right_mm=0.5,
        score=score,
    )  # fmt: skip


def test_tables_count_what_was_missed():
    rows = [
        row("a", "ok", 0.9), row("b", "degraded", 1.2), row("c", "ok", 0.2, error=0.7),
        row("d", "ok", 0.3, shows="nothing"), row("e", "refused", 10.0, error=None),
        row(RIGHT, "ok", 0.5, error=0.5, shows="nothing"),
    ]  # fmt: skip
    assert [r.change for r in rows if r.missed] == ["a"]
    text = tables(rows)
    assert "5 wrong scenes, 1 of them `ok`" in text and "| raw | 2 | 1 | 1 / 0 / 0 | 100% |" in text
    assert "3 visible wrong scenes against 1 right ones: area 1.000" in roc_table(rows)
    assert "| right, not `ok` |" not in text
    doubted = dataclasses.replace(rows[-1], status="degraded", sentence="because")
    assert "| 1/0 left | raw | 2 | 0.50 | because |" in tables([*rows, doubted])


def test_a_tree_that_explains_masks_as_well_shows_that_an_error_does_not():
    seen = row("a", "ok", 0.9)
    hidden = dataclasses.replace(seen, gap_px=(0.9, 1.2), right_gap_px=(0.8, 1.3))
    assert seen.missed and seen.missed_plainly and hidden.missed and not hidden.missed_plainly
    told = {"gap_px": (0.9, 1.6)}, {"gap_px": ()}, {"pictures": "path_length"}, {"shows": "anatomy"}
    for how in told:  # worse in one picture, no tree, exact pictures, anatomy's to tell
        assert dataclasses.replace(hidden, **how).missed_plainly
    assert "2 of them `ok`" in tables([seen, hidden]) and "; 1 of them where" in tables(
        [seen, hidden]
    )

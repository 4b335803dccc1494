"""The report in a real browser: nothing is blocked, and dragging turns it like a C-arm."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from gcar_deploy.config import LesionBorders
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.output.bundle import render_files
from gcar_deploy.tree.rooted import inlet_arcs
from gcar_deploy.tree.tree import along
from tests.conftest import PATIENCE_MS
from tests.workbench.conftest import lightness, nothing_serious

#: where a lesion is marked on a branch, shares of its length
EIGHTHS = np.array([3, 5]) / 8


@pytest.fixture
def opened(chromium, files, tmp_path):
    """Call with a width (and touch, and another page); at the end its console must be silent."""
    path = tmp_path / "report.html"
    complaints, contexts = [], []

    def open_page(width=1280, touch=False, other=None, scheme="light"):
        path.write_bytes(files["report.html"] if other is None else other)
        context = chromium.new_context(
            viewport={"width": width, "height": 1000},
            has_touch=touch,
            is_mobile=touch,
            color_scheme=scheme,
        )
        context.set_default_timeout(PATIENCE_MS)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on(
            "request", lambda r: r.url.startswith(("file:", "data:")) or complaints.append(r.url)
        )
        page.goto(path.as_uri())
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert complaints == []


def angle(page):
    return " ".join(re.findall("[A-Z0-9]+", page.text_content("#angle")))


def colors(page, selector):
    """Distinct opaque colours of a canvas, as (red, green, blue)."""
    script = """canvas => {
      const copy = document.createElement("canvas");
      copy.width = canvas.width; copy.height = canvas.height;
      const context = copy.getContext("2d", { willReadFrequently: true });
      context.drawImage(canvas, 0, 0);
      const all = context.getImageData(0, 0, copy.width, copy.height).data;
      const found = new Set();
      for (let i = 0; i < all.length; i += 4)
        if (all[i + 3] === 255) found.add(all[i] + "," + all[i + 1] + "," + all[i + 2]);
      return [...found];
    }"""
    return {tuple(map(int, c.split(","))) for c in page.eval_on_selector(selector, script)}


def opaque(page, selector, places):
    """Whether a canvas is drawn on at all these (x, y), CSS pixels from its corner."""
    script = """(canvas, places) => {
      const copy = document.createElement("canvas"), ratio = canvas.width / canvas.clientWidth;
      copy.width = canvas.width; copy.height = canvas.height;
      const context = copy.getContext("2d", { willReadFrequently: true });
      context.drawImage(canvas, 0, 0);
      return places.every(([x, y]) =>
        context.getImageData(Math.floor(x * ratio), Math.floor(y * ratio), 1, 1).data[3] > 0);
    }"""
    return page.eval_on_selector(selector, script, places)


def white_beside(page, selector, place):
    """Whether something white stands right of a place, which is a share of the canvas."""
    script = """(canvas, [x, y]) => {
      const ratio = canvas.width / canvas.clientWidth;
      const data = canvas.getContext("2d").getImageData(
        x * canvas.width + 8 * ratio, y * canvas.height - 7 * ratio, 10 * ratio, 14 * ratio).data;
      return data.some((_, i) => i % 4 === 0 && data.slice(i, i + 4).every(v => v === 255));
    }"""
    return page.eval_on_selector(selector, script, place)


@pytest.mark.slow
def test_its_own_policy_blocks_nothing(opened):
    assert angle(opened()) == "RAO 30 CAU 20"


@pytest.mark.slow
def test_dragging_turns_the_c_arm(opened):
    page = opened()
    page.locator("#canvas").scroll_into_view_if_needed()
    box = page.locator("#canvas").bounding_box()
    x, y = box["x"] + 100, box["y"] + 100
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 25, y + 50, steps=5)
    page.mouse.up()
    # 0.4 deg a pixel: what is near the detector follows the pointer (see the signs below).
    assert angle(page) == "RAO 40 CRA 0"
    page.mouse.move(x + 200, y + 200)
    assert angle(page) == "RAO 40 CRA 0"
    page.locator("button[data-view]").nth(1).click()
    assert angle(page) == "LAO 45 CRA 25"
    page.locator("#canvas").focus()
    for _ in range(20):
        page.keyboard.press("ArrowDown")
    assert angle(page) == "LAO 45 CRA 90"


def test_the_folder_is_told_where_the_page_lies(opened, tmp_path):
    page = opened()
    assert f"folder {tmp_path.parent.name}/{tmp_path.name}" in page.inner_text(".facts")
    assert tmp_path.name not in (tmp_path / "report.html").read_text()


def test_signs_of_a_drag_by_the_geometry():
    """A point on the detector's side moves right and down when the angles change like that."""

    def pixel(primary, secondary):
        carm = CArm(
            primary_angle_deg=primary, secondary_angle_deg=secondary, sod_mm=750.0, sdd_mm=1050.0,
            rows=512, columns=512, pixel_spacing_mm=(0.3, 0.3),
        )  # fmt: skip
        return carm, carm.project(near)[0][0]

    near = np.zeros((1, 3))
    carm, _ = pixel(-30.0, -20.0)
    near = 40.0 * carm.axes[2][None]
    before, after = pixel(-30.0, -20.0)[1], pixel(-40.0, 0.0)[1]
    assert after[0] > before[0] and after[1] > before[1]


def test_foreshortening_follows_the_direction(opened, result):
    def parallel(primary, secondary):
        a, b = np.radians([primary, secondary])
        d = np.array([np.sin(a) * np.cos(b), -np.cos(a) * np.cos(b), np.sin(b)])
        shares = []
        for branch in result.tree.branches:
            steps = np.diff(branch.points_mm, axis=0)
            across = steps - (steps @ d)[:, None] * d
            shares.append(1 - np.linalg.norm(across, axis=1).sum() / branch.length_mm)
        return shares

    page = opened()
    for button, angles in ((0, (-30, -20)), (1, (45, 25))):
        page.locator("button[data-view]").nth(button).click()
        cells = page.locator(".short").all_text_contents()
        found = [float(cell.split()[0]) / 100 for cell in cells]
        np.testing.assert_allclose(found, parallel(*angles), atol=0.011)


@pytest.mark.slow
def test_colours_and_legends(opened):
    page = opened()
    before = colors(page, "#canvas")
    for kind in ("radius", "sigma"):
        page.select_option("#color", kind)
        assert page.text_content("#legend").startswith(f"{kind}: blue")
        assert colors(page, "#canvas") != before


def test_the_best_further_view_is_shown(opened, result):
    page = opened()
    page.locator("button[data-view]").nth(2).click()
    assert angle(page) == result.summary()["best_further_view"]["name"]


@pytest.mark.slow
def test_the_tree_lies_on_the_vessels_of_each_picture(opened):
    """Good fits are blue; the lines can be hidden."""
    page = opened()
    for view in (0, 1):
        found = colors(page, f".lines[data-view='{view}']")
        assert any(b > 190 and b > 2 * r for r, _, b in found)
    page.select_option("#linecolor", "none")
    assert colors(page, ".lines[data-view='0']") == set()


@pytest.mark.slow
def test_pictures_are_shown_around_the_tree(opened, result):
    """A click on a vessel of the enlarged picture chooses its branch."""
    page = opened()
    page.select_option("#crop", "tree")
    for k, view in enumerate(result.views):
        picture, stage = page.locator("figure img").nth(k), page.locator("figure .stage").nth(k)
        stage.scroll_into_view_if_needed()
        whole, shown = picture.bounding_box(), stage.bounding_box()
        assert 1.05 < whole["width"] / shown["width"] <= 4
        size = np.array([view.carm.columns, view.carm.rows])
        lines = [
            (view.carm.project(b.points_mm)[0] + 0.5) / size * [whole["width"], whole["height"]]
            for b in result.tree.branches
        ]
        corner = np.array([whole["x"] - shown["x"], whole["y"] - shown["y"]])
        middles = np.array([line[len(line) // 2] for line in lines]) + corner
        assert opaque(page, f".lines[data-view='{k}']", middles.tolist())
        for line in lines:
            end = line[-1] + corner
            assert (end > 0).all() and (end < [shown["width"], shown["height"]]).all()
        # The longest is chosen from the beginning.
        second = int(np.argsort([branch.length_mm for branch in result.tree.branches])[-2])
        page.mouse.click(*(middles[second] + [shown["x"], shown["y"]]))
        chosen = page.locator("#branches tr.chosen").get_attribute("data-branch")
        assert chosen == str(second + 1)
    page.select_option("#crop", "whole")
    assert page.locator("figure img").first.bounding_box()["width"] <= shown["width"] + 1


@pytest.mark.slow
def test_the_lesion_that_is_said_is_the_one_that_is_shaded(opened, result):
    carm, branch = result.views[0].carm, max(result.tree.branches, key=lambda b: b.length_mm)
    marks = carm.project(along(branch.points_mm, branch.arc_mm, branch.length_mm * EIGHTHS))[0]
    lesion = LesionBorders(view=1, proximal=tuple(marks[0]), distal=tuple(marks[1]))
    options = dataclasses.replace(result.options, lesions=(lesion,))
    marked = dataclasses.replace(result, options=options)
    page = opened(other=render_files(marked)["report.html"])
    (lumen,) = (one for one in marked.measured.lumens if one.lesion_mm)
    which = marked.measured.lumens.index(lumen)
    (told,) = page.locator("#lesions tr").all()
    far = (inlet_arcs(marked.tree)[which] or 0.0) + lumen.minimal_at_mm
    cells = [f"{which + 1}", f"{far:.0f}", f"{lumen.lesion_length_mm:.1f}"]
    assert told.locator("td").all_inner_texts()[:3] == cells
    rows = page.locator("#branches tr")
    assert rows.nth(which).locator("td").all_inner_texts()[7:9] == cells[1:]
    # Its number stands beside it whatever branch is chosen; a branch without has a dash.
    rows.nth(0 if which else 1).click()
    assert page.locator("#branches tr.chosen td").nth(8).inner_text() == "-"
    page.mouse.move(5, 5)
    middle = along(branch.points_mm, branch.arc_mm, np.array([np.mean(lumen.lesion_mm)]))
    place = (carm.project(middle)[0][0] + 0.5) / [carm.columns, carm.rows]
    assert white_beside(page, ".lines[data-view='0']", place.tolist())
    rows.nth(which).click()
    page.mouse.move(5, 5)
    said = page.text_content("#point")
    # Of the narrowing: the branch may taper to less elsewhere.
    where = f"{lumen.minimal_diameter_mm:.2f} mm at {lumen.minimal_at_mm:.1f} mm"
    assert said.startswith(f"Gravest narrowing: {where}")
    assert f"lesion {lumen.lesion_length_mm:.1f} mm" in said
    width = page.eval_on_selector("#curve", "e => e.clientWidth")
    ends = 44 + (width - 54) * np.array(lumen.lesion_mm) / branch.length_mm
    assert opaque(page, "#curve", [(x, 30) for x in (ends[0] + 3, ends.mean(), ends[1] - 3)])
    for x in (ends[0] - 3, ends[1] + 3):
        assert not opaque(page, "#curve", [(x, 30)])


@pytest.mark.slow
def test_the_curve_points_at_its_place_in_3d_and_in_the_views(opened):
    page = opened()
    yellow = (255, 216, 77)
    page.locator("#curve").scroll_into_view_if_needed()
    box = page.locator("#curve").bounding_box()
    assert "stenosis" in page.text_content("#point") or "short" in page.text_content("#point")
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 60)
    first = page.text_content("#point")
    assert re.match(r"At [\d.]+ mm: diameter [\d.]+ mm", first)
    for selector in ("#canvas", "#curve", ".lines[data-view='0']", ".lines[data-view='1']"):
        assert yellow in colors(page, selector)
    page.mouse.move(box["x"] + box["width"] * 0.8, box["y"] + 60)
    assert page.text_content("#point") != first
    page.mouse.move(5, 5)
    assert yellow not in colors(page, "#canvas")


def test_hovering_a_row_dims_the_others_and_a_click_chooses(opened):
    page = opened()
    page.select_option("#linecolor", "same")
    before = colors(page, ".lines[data-view='0']")
    rows = page.locator("#branches tr")
    rows.nth(1).hover()
    assert colors(page, ".lines[data-view='0']") != before
    rows.nth(1).click()
    assert page.locator("#branches tr.chosen").get_attribute("data-branch") == "2"


@pytest.mark.slow
def test_fingers_on_a_tablet(opened):
    page = opened(width=820, touch=True)
    page.locator("#branches tr").nth(2).tap()
    assert page.locator("#branches tr.chosen").get_attribute("data-branch") == "3"
    curve = page.locator("#curve")
    curve.scroll_into_view_if_needed()
    box = curve.bounding_box()
    page.touchscreen.tap(box["x"] + box["width"] / 2, box["y"] + 60)
    assert page.text_content("#point").startswith("At ")
    # A finger drags the C-arm instead of the page.
    assert page.eval_on_selector("#canvas", "c => getComputedStyle(c).touchAction") == "none"
    session = page.context.new_cdp_session(page)
    canvas = page.locator("#canvas")
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    start = {"x": box["x"] + 100, "y": box["y"] + 100}
    stop = {"x": start["x"] + 25, "y": start["y"] + 50}
    for kind, points in (("touchStart", [start]), ("touchMove", [stop]), ("touchEnd", [])):
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    assert angle(page) == "RAO 40 CRA 0"


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_dark_rooms_get_a_dark_page_and_paper_a_light_one(opened, scheme):
    page = opened(scheme=scheme)
    nothing_serious(page)
    assert (lightness(page, "body") < 40) == (lightness(page, ".panel") < 40) == (scheme == "dark")
    letters = (227, 232, 239) if scheme == "dark" else (28, 36, 48)
    assert letters in colors(page, "#curve")
    page.emulate_media(media="print", color_scheme=scheme)
    assert lightness(page, ".panel") == 255 and lightness(page, "body") > 240
    assert (28, 36, 48) in colors(page, "#curve")


@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 1024, 768])
def test_nothing_is_cut_off(opened, width):
    page = opened(width=width)
    over = "all => all.map(e => e.scrollWidth - e.clientWidth)"
    for selector in ("html", ".scroll"):
        assert max(page.eval_on_selector_all(selector, over)) <= 0, selector


#: a branch with a name, two lesions and a taper, which makes the widest row that there is
WIDEST = """rows => rows.forEach(row => {
  row.children[1].textContent = "24 LAD (83 %)";
  row.children[6].textContent = "57 %, 55 %, narrows to 1.25 mm without recovery";
})"""


@pytest.mark.slow
def test_on_paper_no_table_leaves_its_card(opened):
    """A4 within margins of 10 mm; the direction on the screen says nothing there."""
    page = opened(width=718)
    page.eval_on_selector_all("#branches tr", WIDEST)
    assert page.locator("th.here").is_visible()
    page.emulate_media(media="print")
    assert page.evaluate("document.documentElement.scrollWidth") <= 718
    wider = "all => all.map(t => t.offsetWidth - t.parentElement.clientWidth)"
    assert max(page.eval_on_selector_all(".panel table", wider)) <= 0
    assert not any(one.is_visible() for one in page.locator(".short, .here").all())


@pytest.mark.slow
def test_a_telephone_scrolls_tables_and_pictures_within_their_cards(opened):
    page = opened(width=400)
    page.eval_on_selector_all("#branches tr", WIDEST)
    assert page.evaluate("document.documentElement.scrollWidth") <= 400
    # Its numbers are 12 high in a picture 760 wide.
    assert page.locator(".panel svg").bounding_box()["width"] * 12 / 760 > 8.5
    nothing_serious(page)
    page.evaluate("""() => {
      const draw = CanvasRenderingContext2D.prototype.fillText, told = window.told = [];
      CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
        if (this.canvas.id === "curve" && text.startsWith("Branch"))
          told.push([text, x + this.measureText(text).width - this.canvas.clientWidth]);
        draw.call(this, text, x, y);
      };
      dispatchEvent(new Event("resize"));
    }""")
    (text, over), *_ = page.evaluate("told")
    assert "diameter" in text and over <= 0


@pytest.mark.parametrize("width", [340, 390, 640, 680, 1280])
def test_angles_and_names_do_not_run_into_each_other(opened, width):
    page = opened(width)
    names = "LM: 1; LAD: 2, 3, 4, 12, 15; LCx: 7, 8, 20"
    page.eval_on_selector("#legend", "(e, names) => e.textContent = names", names)
    angle, legend = (page.locator(name).bounding_box() for name in ("#angle", "#legend"))
    assert angle["y"] + angle["height"] <= legend["y"] or angle["x"] + angle["width"] <= legend["x"]

"""What the page asks for and how it shows it, in a real browser."""

from __future__ import annotations

import itertools

import pytest

from gcar_deploy.inputs.order import Order
from tests.conftest import of_data
from tests.workbench.conftest import finished, nothing_serious, order_of, stroke, until, until_order


def test_runs_whose_headers_lack_the_pixel_are_asked_for_it(serve, browse):
    """A field instead of a dead end; Reconstruct leads to it, its value is taken back by undo."""
    pytest.importorskip("gdcm", reason="the runs are JPEG lossless")
    folder = of_data("phantom_xa")
    address, cases = serve()
    page = browse(address)
    page.set_input_files("#files", [folder / "IM8.dcm", folder / "IM1.dcm"])
    page.locator("#geometry form").wait_for()
    assert page.inner_text("#message") == (
        "The header of IM1.dcm does not say how large a pixel is at the detector. Say it below."
    )
    assert "View 2: IM8.dcm" in page.inner_text("#geometry")
    nothing_serious(page)
    page.click("#run")
    page.keyboard.type("0.4")
    page.keyboard.press("Enter")
    page.locator("#cancel").wait_for()
    page.click("#cancel")
    finished(page)
    assert order_of(cases / "case")["pixel_spacing_mm"] == 0.4
    assert page.locator(".view").count() == 3
    page.click("#undo")
    page.locator("#geometry form").wait_for()
    assert "pixel_spacing_mm" not in order_of(cases / "case")


def test_pictures_without_geometry_are_shown_beside_what_is_asked(serve, browse):
    """Reconstruct says what is missing in the words of the page, and leads to the first field."""
    from gcar_deploy.data.demo_case import demo_case

    address, _ = serve()
    page = browse(address)
    page.set_input_files("#files", list(demo_case().pictures))
    page.locator("#geometry form").wait_for()
    pictures = page.locator("#geometry form img")
    until(page, lambda: pictures.count() == 2 and pictures.last.evaluate("i => i.naturalWidth"))
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    page.click("#geometry summary")
    page.click("#run")
    assert "came without their geometry" in page.inner_text("#message")
    assert "--geom" not in page.inner_text("main")
    assert page.evaluate("document.activeElement.id") == "new-primary_angle_deg-0"
    nothing_serious(page)


@pytest.mark.slow
def test_strokes_are_as_wide_as_a_vessel_and_hide_nothing(serve, browse):
    """2 mm in the patient to begin with; what the last run found stays where it was drawn."""
    address, cases = serve(lambda desk: desk.demo().id)
    page = browse(address)
    finished(page)
    page.wait_for_timeout(500)
    page.uncheck("#show-tree")
    page.click("[data-tool=erase]")
    width, unit, mm, _ = page.inner_text("#brush-out").split()
    assert unit == "px," and 1.7 < float(mm) < 2.3
    canvas = page.locator(".view canvas").first
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    lower = {**box, "y": box["y"] + box["height"] / 4, "height": box["height"] / 2}

    def shown():
        page.mouse.move(2, 2)
        return page.screenshot(clip=lower)

    before = shown()
    stroke(page, 1, [(400, 20), (480, 20)])
    until_order(page, cases / "demo", lambda order: "edits" in order)
    assert order_of(cases / "demo")["edits"]["1"][0]["width_px"] == int(width)
    assert shown() == before
    page.uncheck("#show-found")
    assert shown() != before


@pytest.mark.slow
def test_a_reload_opens_the_case_again_and_does_not_run_it(serve, browse):
    """Its name stands in the address; what was deleted is told by the name that it had."""
    address, _ = serve()
    page = browse(address)
    page.click("#demo")
    assert finished(page) == "ok"
    page.locator("#lesions tbody button[aria-label^=Delete]").first.click()
    page.locator("#corrections li").wait_for()
    finished(page)
    assert page.inner_text("#corrections li").startswith("Deleted branch 4 LAD")
    rows = page.locator("#lesions tbody tr")
    before, runs = rows.count(), []
    page.on("request", lambda request: request.url.endswith("/run") and runs.append(request.url))
    assert page.url.endswith("/#case=demo")
    page.reload()
    finished(page)
    assert rows.count() == before and page.inner_text("#case-name") == "demo"
    page.click("#home")
    page.click("#cases button")
    finished(page)
    assert rows.count() == before and runs == []
    assert "stale" not in page.locator("#run").get_attribute("class")


def boxes(page, *names):
    """(left, top, right, bottom) of elements that are seen."""
    found = [page.locator(name).nth(k) for name in names for k in range(page.locator(name).count())]
    seen = [one.bounding_box() for one in found if one.is_visible()]
    return [(b["x"], b["y"], b["x"] + b["width"], b["y"] + b["height"]) for b in seen]


@pytest.mark.slow
def test_much_to_say_leaves_the_pictures_in_sight_and_one_page_in_print(serve, browse):
    """Two runs with findings, notes and 25 branches on a small screen."""
    pytest.importorskip("gdcm", reason="the runs are JPEG lossless")
    runs = tuple(of_data("phantom_xa") / name for name in ("IM1.dcm", "IM8.dcm"))
    given = Order(views=runs, pixel_spacing_mm=0.4)
    address, _ = serve(lambda desk: desk.add(desk.new_folder("runs"), given).id)
    page = browse(address, 1280, 800)
    assert finished(page) == "degraded"
    canvases = boxes(page, ".view canvas")
    assert len(canvases) == 3 and all(bottom < 800 for *_, bottom in canvases)
    rows = page.locator("#lesions tbody tr")
    listed = [row.inner_text().split() for row in rows.all() if row.is_visible()]
    assert 3 < len(listed) < rows.count() and all(float(one[1]) >= 20 for one in listed)
    cells = [row.locator("td").nth(1) for row in rows.all()]
    hidden = [cell.text_content() for cell in cells if not cell.is_visible()]
    short = hidden.count("\u2013")
    more = f"and {len(hidden) - short} narrowed by less than 20 %, {short} too short to say"
    assert short and page.inner_text("#more") == more
    page.click("#more")
    assert all(row.is_visible() for row in rows.all())
    page.click("#more")
    document = page.pdf(prefer_css_page_size=True, print_background=True)
    assert document.count(b"/Type /Page\n") + document.count(b"/Type /Page ") == 1
    assert page.locator(".status details[open]").count() == 0
    page.emulate_media(media="print")
    assert page.inner_text("#more") == more
    head = page.inner_text("header")
    assert "IM1.dcm" in head and "IM8.dcm" in head and "printed 20" in head
    shown = boxes(page, ".view", "#curve", "#lesions", "#status", "#corrections")
    assert len(shown) == 7
    for a, b in itertools.combinations(shown, 2):
        assert a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1], (a, b)


@pytest.mark.slow
def test_strokes_go_with_the_frame_that_they_were_drawn_on(serve, browse):
    """Another frame is taken only without them; the other run keeps the one drawn on."""
    pytest.importorskip("gdcm", reason="the runs are JPEG lossless")
    folder = of_data("phantom_xa")
    address, cases = serve()
    page, case, asked = browse(address), cases / "case", []
    page.set_input_files("#files", [folder / "IM7.dcm", folder / "IM8.dcm"])
    finished(page)
    strips = page.locator("#frames .strip")
    until(page, lambda: strips.count() == 2)
    page.keyboard.press("e")
    stroke(page, 1, [(30, 470), (60, 480)])
    until_order(page, case, lambda order: "edits" in order)
    drawn = order_of(case)["edits"]

    answers = iter([False, True])

    def answer(dialog):
        asked.append(dialog.message)
        dialog.accept() if next(answers) else dialog.dismiss()

    def take(view, frame):
        strips.nth(view - 1).locator("button").nth(frame - 1).click()

    page.on("dialog", answer)
    take(1, 2)
    assert "view 1 were drawn on frame" in asked[0] and "Take frame 2" in asked[0]
    page.wait_for_timeout(300)
    assert order_of(case)["edits"] == drawn and "frames" not in order_of(case)
    take(2, 3)
    until_order(page, case, lambda order: "frames" in order)
    own, other = order_of(case)["frames"]
    assert f"drawn on frame {own}." in asked[0] and other == 3 and len(asked) == 1
    assert order_of(case)["edits"] == drawn
    until(page, lambda: "frame 3 of" in page.inner_text("#frames"))
    take(1, 2)
    until_order(page, case, lambda order: order["frames"] == [2, 3])
    assert len(asked) == 2 and "edits" not in order_of(case)
    page.click("#undo")
    until_order(page, case, lambda order: order.get("edits") == drawn)
    assert order_of(case)["frames"] == [own, 3]

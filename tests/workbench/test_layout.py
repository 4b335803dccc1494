"""Nothing that the page shows hides another part of it, at any width and on paper."""

from __future__ import annotations

import itertools

import pytest

from tests.workbench.conftest import finished

#: what is written on the canvases from now on: canvas, text, left, baseline, width, canvas' size
RECORD = """() => {
  const kind = CanvasRenderingContext2D.prototype, draw = kind.fillText;
  window.told = [];
  kind.fillText = function (text, x, y) {
    const wide = this.measureText(text).width, { clientWidth, clientHeight } = this.canvas;
    const share = { center: 0.5, right: 1 }[this.textAlign] ?? 0;
    window.told.push([this.canvas.id, text, x - share * wide, y, wide, clientWidth, clientHeight]);
    draw.call(this, text, x, y);
  };
}"""
#: a name as long as they come, for every branch of the table
LONGEST = """spans => spans.forEach(span => { span.lastChild.textContent = "24 LAD"; })"""
#: px of a scroll bar, which this browser does not draw
BAR = 15


@pytest.fixture
def demo(serve, browse):
    """The demo's page, done."""
    address, _ = serve(lambda desk: desk.demo().id)
    page = browse(address)
    finished(page)
    page.wait_for_timeout(300)
    return page


def redrawn(page, width):
    """Texts that are drawn at a width."""
    page.set_viewport_size({"width": width, "height": 900})
    page.wait_for_timeout(200)
    again = "() => { told.length = 0; dispatchEvent(new Event('resize')); return told; }"
    return page.evaluate(again)


@pytest.mark.slow
def test_the_table_of_narrowings_shows_its_last_column_at_every_width(demo):
    demo.click("#more")
    demo.eval_on_selector_all("#lesions td:first-child .plain > span", LONGEST)
    for width in (1680, 1440, 1280, 1241, 1240, 1024, 820, 751, 750, 700, 390):
        demo.set_viewport_size({"width": width, "height": 900})
        room = demo.eval_on_selector(".scroll", "e => e.clientWidth") - (BAR if width > 750 else 0)
        least = """t => {
          t.style.width = "min-content";
          const found = t.offsetWidth;
          t.style.width = "";
          return found;
        }"""
        assert demo.eval_on_selector("#lesions", least) <= room, width
        shown = demo.locator("#lesions thead th").all_inner_texts()
        assert any("Ghost" in text for text in shown) and demo.locator("#lesions td button").count()
        assert demo.locator("#lesions thead th:nth-child(9)").is_visible() == (width > 750)
    # Paper is narrower than a telephone's limit, and has all but the button.
    demo.set_viewport_size({"width": 718, "height": 900})
    demo.emulate_media(media="print")
    assert demo.locator("#lesions thead th:nth-child(9)").is_visible()
    assert not demo.locator("#lesions thead th:nth-child(10)").is_visible()


@pytest.mark.slow
def test_captions_stand_below_their_pictures(demo):
    for media, widths in (("screen", (1280, 400)), ("print", (718,))):
        demo.emulate_media(media=media)
        for width in widths:
            demo.set_viewport_size({"width": width, "height": 900})
            for view in demo.locator(".view").all():
                canvas, title = (view.locator(name).bounding_box() for name in ("canvas", ".title"))
                assert title["y"] >= canvas["y"] + canvas["height"]
                assert view.locator(".title").inner_text()


@pytest.mark.slow
def test_names_of_branches_are_whole_and_apart(demo):
    """Over the pictures, on paper where they are small as well, and along the curve."""
    demo.evaluate(RECORD)
    for media, width in (("screen", 1280), ("screen", 400), ("print", 718)):
        demo.emulate_media(media=media)
        told = redrawn(demo, width)
        branches = [one for one in told if one[1].split()[0].isdigit() and " mm" not in one[1]]
        over = [one for one in branches if not one[0]]
        assert {"1 LM", "2 LAD", "7 LCx"} <= {one[1] for one in over}
        for _, text, left, y, wide, columns, rows in over:
            assert 0 <= left <= columns - wide and 11 <= y <= rows, (width, text)
        curve = {text: (x, wide) for name, text, x, y, wide, *_ in told if name and y == 12}
        assert "4 LAD" in curve and len(curve) >= 3
        apart(curve.values())


@pytest.mark.slow
def test_words_below_the_curve_do_not_run_into_each_other(serve, browse):
    """Of a vessel that does not hang on the ostium, which is long to say."""

    def loose(route):
        told = route.fetch()
        result = told.json()
        for branch in result["scene"]["branches"]:
            branch["from_ostium"] = None
        route.fulfill(response=told, json=result)

    address, _ = serve(lambda desk: desk.demo().id)
    page = browse(address)
    page.route("**/result", loose)
    page.reload()
    finished(page)
    page.evaluate(RECORD)
    whole = "mm along the vessel, which does not hang on the ostium"
    for width, said in ((1280, whole), (390, whole.split(",")[0])):
        told = redrawn(page, width)
        below = {text: (x, wide) for name, text, x, _, wide, *_ in told if name and "mm" in text}
        assert set(below) == {"diameter, mm", said}
        apart(below.values())


def apart(spans):
    """Whether no two of (left, width) meet."""
    for (a, long), (b, other) in itertools.combinations(spans, 2):
        assert a >= b + other or b >= a + long, spans

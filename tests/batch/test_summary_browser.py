"""The page of a batch in a real browser: sorted, filtered, readable on a telephone."""

from __future__ import annotations

from pathlib import Path

import pytest

from gcar_deploy.batch.summary import summary_html
from gcar_deploy.batch.work import error_row

AXE = Path(__file__).parents[1] / "workbench" / "vendor" / "axe.min.js"
LONG = "a-case-whose-name-is-long-and-has-no-place-to-break-it-anywhere-0001"


@pytest.fixture
def browse(chromium, tmp_path):
    """Call with a width; nothing may be complained of or asked for."""
    rows = [
        {**error_row(name, status, f"why {name}", 0), "length_mm": length, "seconds": seconds}
        for name, status, length, seconds in (
            ("c10", "ok", 90.5, 1.0), ("c9", "degraded", 700.0, 2.0), (LONG, "ok", 80.0, 11.0),
            ("c1", "refused", None, None),
        )
    ]  # fmt: skip
    file, complaints = tmp_path / "summary.html", []
    file.write_text(summary_html(rows, tmp_path), encoding="utf-8")
    contexts = []

    def open_page(width):
        context = chromium.new_context(viewport={"width": width, "height": 800})
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda r: r.url == file.as_uri() or r.url.startswith("data:")
                or complaints.append(r.url))  # fmt: skip
        page.goto(file.as_uri())
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert complaints == []


def test_the_least_coverage_says_by_what_it_is_weighed(tmp_path):
    """Of the two shares that a run tells; on a telephone as well, which has no heading."""
    page = summary_html([{**error_row("a", "ok", "why", 0), "least_coverage": 0.9}], tmp_path)
    assert "Least coverage</button><small>% weighed by thickness</small>" in page
    assert 'data-name="Least coverage, % weighed by thickness" data-value="90"' in page


def cases(page):
    return [cell.inner_text() for cell in page.locator("tbody tr:visible td.name").all()]


@pytest.mark.slow
def test_columns_sort_both_ways_by_number_and_by_word(browse):
    page = browse(1280)
    assert cases(page) == ["c10", "c9", LONG, "c1"]
    page.click("th button:has-text('Length')")
    assert cases(page) == [LONG, "c10", "c9", "c1"]
    assert page.locator("th[aria-sort=ascending]").inner_text().startswith("Length")
    page.click("th button:has-text('Length')")
    # What is not known stays last.
    assert cases(page) == ["c9", "c10", LONG, "c1"]
    page.click("th button:has-text('Case')")
    assert cases(page) == [LONG, "c1", "c9", "c10"]


@pytest.mark.slow
def test_statuses_are_filtered(browse):
    page = browse(1280)
    page.click("#filter button:has-text('ok')")
    assert cases(page) == ["c9", "c1"] and "2 of 4" in page.inner_text("#shown")
    page.click("#filter button:has-text('refused')")
    assert cases(page) == ["c9"]
    page.click("#filter button:has-text('ok')")
    assert cases(page) == ["c10", "c9", LONG]


@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 820, 390])
def test_no_column_breaks_and_axe_finds_nothing_serious(browse, width):
    page = browse(width)
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    # A short name stands on one line, whatever else there is.
    heights = [box.bounding_box()["height"] for box in page.locator("td.name").all()]
    assert heights[0] < 60 and heights[3] < 60
    page.evaluate(AXE.read_text(encoding="utf-8") + "; undefined")
    found = page.evaluate("axe.run()")
    bad = [v["id"] for v in found["violations"] if v["impact"] in ("serious", "critical")]
    assert found["passes"] and not bad

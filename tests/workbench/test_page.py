"""What the page asks for and how it shows it, in a real browser."""

from __future__ import annotations

import pytest

from tests.conftest import of_data
from tests.workbench.conftest import finished, nothing_serious, order_of, until


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

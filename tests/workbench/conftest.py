"""A workbench with a real engine on a free port, and a browser that counts what it asks for."""

from __future__ import annotations

import contextlib
import functools
import json
import socket
import threading
import time
from pathlib import Path

import pytest

from gcar_deploy.engine import Engine
from gcar_deploy.worker.jobs import JobQueue
from tests.conftest import PATIENCE_MS

TOKEN = "a-token-of-the-tests"
AXE = Path(__file__).parent / "vendor" / "axe.min.js"


@pytest.fixture(scope="session")
def engine():
    return Engine(threads=1)


@pytest.fixture
def serve(engine, tmp_path):
    """Call with what to put on the desk (desk -> name or None); returns the address."""
    pytest.importorskip("flask")
    pytest.importorskip("waitress")
    from gcar_deploy.workbench.desk import Desk
    from gcar_deploy.workbench.http import create_app
    from gcar_deploy.worker.loopback import listen

    opened = []

    def start(put=lambda desk: None) -> tuple[str, Path]:
        desk = Desk(tmp_path / "cases")
        queue = JobQueue(functools.partial(desk.work, engine))
        server = listen(create_app(desk, queue, TOKEN, put(desk)), 0)

        def run() -> None:
            with contextlib.suppress(OSError):
                server.run()

        threading.Thread(target=run, daemon=True).start()
        opened.append((server, queue))
        return f"http://127.0.0.1:{server.effective_port}", tmp_path / "cases"

    yield start
    for server, queue in opened:
        port = int(server.effective_port)
        server.close()
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
            pass
        queue.close()


@pytest.fixture
def browse(chromium):
    """Call with an address and a width; at the end the console must be silent, no call foreign."""
    complaints, contexts = [], []

    def open_page(address: str, width: int = 1280, height: int = 900, scheme: str = "light"):
        context = chromium.new_context(
            viewport={"width": width, "height": height}, accept_downloads=True, color_scheme=scheme
        )
        context.set_default_timeout(PATIENCE_MS)
        contexts.append(context)
        page = context.new_page()
        own = (address, "blob:", "data:")
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda r: r.url.startswith(own) or complaints.append(r.url))
        page.goto(f"{address}/#{TOKEN}")
        return page

    open_page.complaints = complaints  # for a test that provokes one
    yield open_page
    for context in contexts:
        context.close()
    assert complaints == []


def finished(page) -> str:
    """Wait until no run is under way; return the status word."""
    page.locator("#cancel").wait_for(state="hidden")
    page.locator("#status").wait_for()
    return page.inner_text("#status b >> nth=0").lower()


def order_of(folder: Path) -> dict:
    return json.loads((folder / "order.json").read_text())


def on_screen(page, view: int, place):
    """CSS place of a pixel of a view's picture, which is shown whole and square."""
    canvas = page.locator(".view canvas").nth(view - 1)
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    unit = box["width"] / 512
    return box["x"] + (place[0] + 0.5) * unit, box["y"] + (place[1] + 0.5) * unit


def click(page, view, place):
    page.mouse.click(*on_screen(page, view, place))


def stroke(page, view, places):
    page.mouse.move(*on_screen(page, view, places[0]))
    page.mouse.down()
    for place in places[1:]:
        page.mouse.move(*on_screen(page, view, place), steps=3)
    page.mouse.up()


def nothing_serious(page):
    """Let axe-core look at the page as it is."""
    # The page's policy holds for scripts that it loads; the browser's own door is another.
    page.evaluate(AXE.read_text(encoding="utf-8") + "; undefined")
    found = page.evaluate("axe.run()")
    bad = [v for v in found["violations"] if v["impact"] in ("serious", "critical")]
    told = [(v["id"], [node["html"][:120] for node in v["nodes"]][:3]) for v in bad]
    assert found["passes"] and not told, told


def lightness(page, selector) -> float:
    """Of an element's background, 0 (black) .. 255."""
    told = page.eval_on_selector(selector, "e => getComputedStyle(e).backgroundColor")
    return sum(map(int, told[4:-1].split(","))) / 3


def until(page, holds):
    """Wait; the page's policy forbids Playwright's own way, which evaluates text."""
    end = time.monotonic() + 240
    while not holds():
        assert time.monotonic() < end
        page.wait_for_timeout(50)


def until_order(page, case, has):
    until(page, lambda: has(order_of(case)))

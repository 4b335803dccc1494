"""The report in a real browser: nothing is blocked, and dragging turns it like a C-arm."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from gcar_deploy.geometry.carm import CArm

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium")

# Appended to a copy of the page whose policy is taken out: acts like a user, then writes down
# what the page shows. The original page is loaded as it is in another test.
DRIVER = """
<script>
const canvas = document.getElementById("canvas"), angle = document.getElementById("angle");
canvas.setPointerCapture = () => {};
const said = () => angle.textContent.replace(/[^A-Z0-9]+/g, " ").trim();
const short = () => [...document.querySelectorAll(".short")].map(cell => cell.textContent);
const point = (kind, x, y) => canvas.dispatchEvent(
  new PointerEvent(kind, { clientX: x, clientY: y, pointerId: 1, bubbles: true }));
const key = name => canvas.dispatchEvent(new KeyboardEvent("keydown", { key: name }));
const seen = { start: said(), short: short() };
point("pointerdown", 100, 100); point("pointermove", 125, 150); point("pointerup", 125, 150);
seen.dragged = said(); seen.turnedShort = short();
point("pointermove", 300, 300); seen.released = said();
document.querySelectorAll("button[data-view]")[1].click(); seen.button = said();
for (let k = 0; k < 40; k++) key("ArrowDown");
seen.stopped = said();
const select = document.getElementById("color");
for (const kind of ["radius", "sigma"]) {
  select.value = kind; select.dispatchEvent(new Event("change"));
  seen[kind] = document.getElementById("legend").textContent;
}
document.querySelectorAll("#branches tr")[1].click();
seen.chosen = document.querySelectorAll("#branches tr.chosen")[0].dataset.branch;
const over = element => element.scrollWidth - element.clientWidth;
seen.wide = over(document.documentElement);
seen.table = over(document.querySelector(".scroll"));
const out = document.createElement("pre");
out.id = "seen"; out.textContent = JSON.stringify(seen); document.body.append(out);
</script>
"""


def load(page: Path, profile: Path, width: int = 1280) -> tuple[str, list[str]]:
    """Return the page after its scripts ran, and what the console complained of."""
    done = subprocess.run(
        [
            str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr",
            f"--user-data-dir={profile}", f"--window-size={width},1000",
            "--virtual-time-budget=2000", "--dump-dom", page.as_uri(),
        ],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    return done.stdout, [line for line in done.stderr.splitlines() if ":CONSOLE" in line]


@pytest.fixture(scope="module")
def drive(files, tmp_path_factory):
    folder = tmp_path_factory.mktemp("browser")
    text = files["report.html"].decode("utf-8")
    text = re.sub(r"<meta http-equiv[^>]*>", "", text).replace("</body>", DRIVER + "</body>")
    (folder / "driven.html").write_text(text, encoding="utf-8")

    def run(width):
        dom, console = load(folder / "driven.html", folder / "profile", width)
        assert console == []
        match = re.search(r'<pre id="seen">(.*?)</pre>', dom, re.DOTALL)
        assert match, "the page's script stopped"
        return json.loads(html.unescape(match[1]))

    return run


@pytest.fixture(scope="module")
def seen(drive):
    return drive(1280)


def test_its_own_policy_blocks_nothing(files, tmp_path):
    page = tmp_path / "report.html"
    page.write_bytes(files["report.html"])
    dom, console = load(page, tmp_path / "profile")
    assert console == []
    angle = re.search(r'<span id="angle"[^>]*>(.*?)</span>', dom)
    assert angle and angle[1].startswith("RAO 30")


def test_dragging_turns_the_c_arm(seen):
    # 0.4 deg a pixel: what is near the detector follows the pointer (see the signs below).
    assert seen["start"] == "RAO 30 CAU 20"
    assert seen["dragged"] == "RAO 40 CRA 0"
    assert seen["released"] == seen["dragged"]
    assert seen["button"] == "LAO 45 CRA 25"
    assert seen["stopped"] == "LAO 45 CRA 90"


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


def test_foreshortening_follows_the_direction(seen, result):
    def parallel(primary, secondary):
        a, b = np.radians([primary, secondary])
        d = np.array([np.sin(a) * np.cos(b), -np.cos(a) * np.cos(b), np.sin(b)])
        shares = []
        for branch in result.tree.branches:
            steps = np.diff(branch.points_mm, axis=0)
            across = steps - (steps @ d)[:, None] * d
            shares.append(1 - np.linalg.norm(across, axis=1).sum() / branch.length_mm)
        return shares

    for cells, angles in ((seen["short"], (-30, -20)), (seen["turnedShort"], (-40, 0))):
        found = [float(cell.split()[0]) / 100 for cell in cells]
        np.testing.assert_allclose(found, parallel(*angles), atol=0.011)


def test_legends_and_choice(seen):
    assert "mm" in seen["radius"] and "radius" in seen["radius"]
    assert "sigma" in seen["sigma"]
    assert seen["chosen"] == "1"


@pytest.mark.parametrize("width", [1280, 800])
def test_nothing_is_cut_off(drive, seen, width):
    found = seen if width == 1280 else drive(width)
    assert found["wide"] <= 0 and found["table"] <= 0

"""The whole way in a real browser: see, correct, run again, and the order that repeats it."""

from __future__ import annotations

import dataclasses
import itertools
import json
import time
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gcar_deploy.engine import deliver
from gcar_deploy.geometry.scene import parse_scene
from gcar_deploy.inputs.order import Order, load_order, parse_order
from gcar_deploy.tree.curves import resample
from tests.conftest import of_data, ready_case
from tests.workbench.conftest import (
    click,
    finished,
    lightness,
    nothing_serious,
    order_of,
    stroke,
    until,
    until_order,
)

#: what a run writes that holds no clock
TIMELESS = ("volume.nii.gz", "centerline.csv", "centerline.vtp", "surface.stl", "gaussians.npz")


def files_of(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in TIMELESS}


def repeated(engine, case: Path, out: Path) -> dict[str, bytes]:
    """What the stored order gives, as ``gcar run --order`` reads it."""
    order = dataclasses.replace(load_order(case / "order.json"), out=out)
    deliver(engine.reconstruct_order(order), order)
    return files_of(out)


@pytest.mark.slow
def test_demo_to_result_to_deletion_and_back(serve, browse, engine, tmp_path):
    """One click to a result; a branch deleted, undone and redone; the order repeats the bytes."""
    address, cases = serve()
    page = browse(address)
    page.click("#demo")
    assert finished(page) == "ok"
    case = cases / "demo"
    rows = page.locator("#lesions tbody tr")
    before, first = rows.count(), files_of(case / "result")
    assert before > 5 and "deleted_mm" not in order_of(case)
    told = json.loads((case / "result" / "result.json").read_text())["tree"]["branches"]
    ends = [f"{b['proximal_reference_mm']:.2f}, {b['distal_reference_mm']:.2f}" for b in told
            if b["proximal_reference_mm"] is not None]  # fmt: skip
    assert ends and sorted(page.locator("#lesions .ends").all_inner_texts()) == sorted(ends)
    page.click('button[aria-label="Delete branch 5"]')
    until(page, lambda: rows.count() < before)
    finished(page)
    assert len(order_of(case)["deleted_mm"]) == 1
    without = files_of(case / "result")
    assert without != first
    page.keyboard.press("Control+z")
    until(page, lambda: rows.count() == before)
    finished(page)
    assert files_of(case / "result") == first and "deleted_mm" not in order_of(case)
    page.click("#redo")
    until(page, lambda: rows.count() < before)
    finished(page)
    assert files_of(case / "result") == without
    assert repeated(engine, case, tmp_path / "again") == without


def way_of_a_case(page, case, strokes, marks):
    """Erase in view 1, mark a landmark pair, run, delete a branch, undo all; each run's files.

    Returns
    -------
    files of the result with the corrections, and with a branch less
    """
    page.keyboard.press("e")
    stroke(page, 1, strokes)
    until_order(page, case, lambda o: len(o.get("edits", {}).get("1", ())) == 1)
    drawn = order_of(case)["edits"]["1"][0]
    told = page.inner_text("#brush-out").split()
    assert drawn["do"] == "erase" and drawn["width_px"] == int(told[0])
    assert np.allclose(drawn["points"][0], strokes[0], atol=1.5)
    page.keyboard.press("l")
    click(page, 1, marks[0])
    page.wait_for_timeout(600)
    click(page, 2, marks[1])
    until_order(page, case, lambda o: len(o.get("landmarks", ())) == 1)
    pair = order_of(case)["landmarks"][0]
    assert np.allclose(pair[0], marks[0], atol=1.5)
    # Snapped to a vessel on the line, or where the click was.
    assert np.linalg.norm(np.array(pair[1]) - marks[1]) < 24
    page.click("#run")
    finished(page)
    assert page.locator("#status .older").count() == 0
    page.click("#status .notes summary")
    assert "1 stroke of the user erases vessel" in page.inner_text("#status")
    corrected, rows = files_of(case / "result"), page.locator("#lesions tbody tr")
    before = rows.count()
    if page.locator("#more").is_visible():
        page.click("#more")
    page.locator("#lesions tbody button[aria-label^=Delete]").last.click()
    until(page, lambda: rows.count() < before)
    finished(page)
    shorter = files_of(case / "result")
    order = (case / "order.json").read_bytes()
    page.click("#undo")
    until(page, lambda: rows.count() == before)
    finished(page)
    assert files_of(case / "result") == corrected != shorter
    page.keyboard.press("Control+z")
    until_order(page, case, lambda o: "landmarks" not in o)
    page.keyboard.press("Control+z")
    until_order(page, case, lambda o: "edits" not in o)
    return shorter, order


def repeated_from(engine, case, order: bytes, out: Path) -> dict[str, bytes]:
    """What an order that the case had earlier gives."""
    (case / "order.json").write_bytes(order)
    return repeated(engine, case, out)


@pytest.mark.slow
def test_raw_case_is_corrected(serve, browse, engine, tmp_path):
    """Erase, landmark pair on its epipolar line, run, delete a branch, undo; the order repeats."""
    from gcar_deploy.geometry.scene import load_scene

    folder = ready_case("R_0001")
    given = Order(views=(folder / "view1.png", folder / "view2.png"), geometry=folder / "geom.json")
    address, cases = serve(lambda desk: desk.add(desk.new_folder("raw"), given).id)
    page = browse(address, 1500)
    finished(page)
    assert page.locator("#lesions tbody tr").count() > 2
    carms = [view.carm for view in load_scene(folder / "geom.json").views]
    marks = [carm.project(np.array([[4.0, -12.0, 8.0]]))[0][0] for carm in carms]
    shorter, order = way_of_a_case(page, cases / "raw", [(20, 480), (60, 490), (90, 500)], marks)
    assert repeated_from(engine, cases / "raw", order, tmp_path / "again") == shorter


@pytest.mark.slow
def test_phantom_runs_dropped_on_the_page_go_the_whole_way(serve, browse, engine, tmp_path):
    """Real DICOM runs: dropped, frames chosen, corrected, repeated from their order."""
    pytest.importorskip("gdcm", reason="the runs are JPEG lossless")
    folder = of_data("phantom_xa")
    told = json.loads((Path(__file__).parents[1] / "data" / "phantom_landmarks.json").read_text())
    address, cases = serve()
    page = browse(address, 1500)
    page.set_input_files("#files", [folder / "IM7.dcm", folder / "IM8.dcm"])
    assert finished(page) in ("ok", "degraded")
    strips = page.locator("#frames .strip")
    until(page, lambda: strips.count() == 2 and strips.first.locator("button").count() == 9)
    nothing_serious(page)
    # Where the upper branch leaves the main tube.
    marks = [np.array(told["pixels_col_row"][run][2]) for run in ("IM7", "IM8")]
    shorter, order = way_of_a_case(page, cases / "case", [(30, 470), (60, 480), (90, 490)], marks)
    assert repeated_from(engine, cases / "case", order, tmp_path / "again") == shorter


@pytest.mark.slow
def test_a_stated_alternative_is_shown_and_picked(serve, browse):
    """A probable ghost of a real tree: its place is marked, picking it deletes the branch."""
    folder = ready_case("P_0001")
    given = Order(views=(folder / "view1.png", folder / "view2.png"), geometry=folder / "geom.json")
    address, cases = serve(lambda desk: desk.add(desk.new_folder("case"), given).id)
    page = browse(address, 1500)
    finished(page)
    rows, stated = page.locator("#lesions tbody tr"), page.locator("#alternatives li")
    before, texts = rows.count(), stated.all_inner_texts()
    assert "a ghost with probability" in texts[0]
    titles = page.locator(".view .title").all_inner_texts()
    told = "% of the length explained ("
    assert [told in t and "% weighed by thickness)" in t for t in titles[:2]] == [True] * 2
    nothing_serious(page)
    tree = page.locator(".view canvas").last
    unmarked = tree.screenshot()
    page.click("#alternatives li:first-child button:has-text('Show')")
    assert tree.screenshot() != unmarked
    with page.expect_download() as kept:
        page.click("button[aria-label='Save picture of the tree']")
    assert Path(kept.value.path()).read_bytes().startswith(b"\x89PNG")
    with page.expect_response(lambda answer: answer.url.endswith("/views/2/flat.png")) as flat:
        page.check("#show-flat")
    assert flat.value.ok
    page.click("#alternatives li:first-child button:has-text('Delete')")
    until_order(page, cases / "case", lambda o: len(o.get("deleted_mm", ())) == 1)
    until(page, lambda: rows.count() < before)
    finished(page)
    assert stated.all_inner_texts() != texts


@pytest.mark.slow
@pytest.mark.parametrize(("segmenter", "least"), [("classic", 0.78), ("auto", 0.82)])
def test_corrections_mend_a_raw_case(serve, engine, segmenter, least):
    """Two ends of vessels that view 1 lacks and a faint one, painted: the tree follows them.

    DSC by the ridge filter alone from 0.777 to 0.785, with the network from 0.820 to 0.827.
    """
    import nibabel

    folder = ready_case("R_0401")
    truth = np.asarray(nibabel.load(folder / "truth.nii.gz").dataobj) >= 0.5
    carm = parse_scene((folder / "geom.json").read_text()).views[0].carm
    views = (folder / "view1.png", folder / "view2.png")
    given = Order(views=views, geometry=folder / "geom.json", segmenter=segmenter)
    missed = [[[296, 137], [309, 146], [323, 155]], [[164, 179], [147, 192]],
              [[96, 254], [121, 233]]]  # fmt: skip
    strokes = [{"do": "paint", "width_px": 9, "points": points} for points in missed]
    corrected = parse_order({**given.to_dict(), "edits": {"1": strokes}})
    painted = np.concatenate([resample(np.array(points, float), 1.0) for points in missed])
    found, followed = [], []
    for order in (given, corrected):
        result = engine.reconstruct_order(order)
        made = result.volume >= 0.5
        found.append(2 * (made & truth).sum() / (made.sum() + truth.sum()))
        shown = cKDTree(carm.project(result.tree.points())[0])
        followed.append((shown.query(painted)[0] < 4.0).mean())
    assert found[0] < found[1] and found[1] > least, found
    assert followed[0] < 0.9 and followed[1] > 0.95, followed


@pytest.mark.slow
def test_tools_write_what_they_say(serve, browse):
    """Paint, cut, region and ostium, and taking single corrections back; by keyboard as well."""
    address, cases = serve(lambda desk: desk.demo().id)
    page = browse(address, 1500)
    case = cases / "demo"
    finished(page)
    page.click("[data-tool=paint]")
    page.locator(".view canvas").first.focus()
    page.keyboard.press("ArrowRight")
    assert page.locator("#status .older").count() == 0
    page.keyboard.press("Enter")
    until_order(page, case, lambda o: "edits" in o)
    assert "older than the corrections" in page.inner_text("#status .older")
    assert order_of(case)["edits"]["1"][0]["points"][0] == [261, 256]
    page.click("[data-tool=region]")
    for place in ((30, 90), (480, 90), (480, 480), (30, 480)):
        click(page, 2, place)
    page.keyboard.press("Enter")
    until_order(page, case, lambda o: "regions" in o)
    assert np.allclose(order_of(case)["regions"]["2"], [(30, 90), (480, 90), (480, 480), (30, 480)],
                       atol=1.5)  # fmt: skip
    page.click("[data-tool=cut]")
    click(page, 1, (150, 190))
    click(page, 1, (160, 330))
    until_order(page, case, lambda o: len(o["edits"]["1"]) == 2)
    cut = order_of(case)["edits"]["1"][1]
    assert cut["do"] == "erase" and len(cut["points"]) > 20
    page.click("#corrections li:has-text('erased') button")
    until_order(page, case, lambda o: len(o["edits"]["1"]) == 1)
    page.click("#corrections li:has-text('region') button")
    until_order(page, case, lambda o: "regions" not in o)


@pytest.mark.slow
def test_delete_acts_on_a_chosen_branch_and_once(serve, browse):
    """The page shows one from the beginning: nobody chose it, so that no key deletes it."""
    address, cases = serve(lambda desk: desk.demo().id)
    page = browse(address, 1500)
    finished(page)
    assert page.locator("#lesions tr.chosen").count() == 1
    page.keyboard.press("Delete")
    assert "click one first" in page.inner_text("#message")
    page.wait_for_timeout(300)
    assert "deleted_mm" not in order_of(cases / "demo")
    page.locator("#lesions tbody tr[data-branch='5'] button.plain").click()
    page.keyboard.press("Delete")
    page.keyboard.press("Delete")
    until_order(page, cases / "demo", lambda o: "deleted_mm" in o)
    finished(page)
    page.keyboard.press("Delete")
    page.wait_for_timeout(300)
    assert len(order_of(cases / "demo")["deleted_mm"]) == 1
    assert page.locator("#lesions tr.chosen").count() == 0


@pytest.mark.slow
def test_a_long_scribble_is_kept_whole_and_tabs_do_not_wipe_each_other(serve, browse):
    address, cases = serve(lambda desk: desk.demo().id)
    page, other = browse(address, 1500), browse(address, 1500)
    case = cases / "demo"
    for one in (page, other):
        finished(one)
        one.click("[data-tool=erase]")
    page.locator("#brush").fill("3")
    rows = [((20, y), (490, y)) for y in range(20, 60, 4)]
    stroke(page, 1, [place for k, row in enumerate(rows) for place in row[:: 1 - 2 * (k % 2)]])
    until_order(page, case, lambda o: "edits" in o)
    strokes = order_of(case)["edits"]["1"]
    points = np.concatenate([one["points"] for one in strokes])
    assert points[:, 1].max() > 50 and all(len(one["points"]) <= 2000 for one in strokes)
    assert all(a["points"][-1] == b["points"][0] for a, b in itertools.pairwise(strokes))
    stroke(other, 2, [(20, 20), (60, 20)])
    until(other, lambda: "corrected elsewhere" in other.inner_text("#message"))
    assert other.locator("#corrections li").count() == len(strokes)
    assert len(browse.complaints) == 1 and "400" in browse.complaints.pop()
    assert list(order_of(case)["edits"]) == ["1"]
    stroke(other, 2, [(20, 20), (60, 20)])
    until_order(other, case, lambda o: "2" in o["edits"])
    assert order_of(case)["edits"]["1"] == strokes


@pytest.mark.slow
@pytest.mark.parametrize(
    ("width", "scheme"), [(1280, "light"), (820, "light"), (390, "light"), (1280, "dark")]
)
def test_nothing_is_cut_off_and_axe_finds_nothing_serious(serve, browse, width, scheme):
    address, _ = serve(lambda desk: desk.demo().id)
    page = browse(address, width, scheme=scheme)
    finished(page)
    page.wait_for_timeout(300)
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    page.click("#geometry summary")
    page.click("#files-of summary")
    nothing_serious(page)
    assert (lightness(page, "body") < 40) == (lightness(page, ".panel") < 40) == (scheme == "dark")
    page.emulate_media(media="print", color_scheme=scheme)
    assert lightness(page, "body") == lightness(page, ".panel") == 255


@pytest.mark.slow
def test_pictures_in_the_wrong_order_are_exchanged(serve, browse):
    """What was drawn stays with its picture, and so does the name."""
    from gcar_deploy.data.demo_case import demo_case

    case = demo_case()
    given = Order(views=case.pictures[::-1], geometry=case.geometry)
    address, cases = serve(lambda desk: desk.add(desk.new_folder("mixed"), given).id)
    page = browse(address)
    assert finished(page) != "ok"
    page.click("button[data-tool=erase]")
    stroke(page, 1, [(20, 20), (60, 20)])
    until_order(page, cases / "mixed", lambda order: "edits" in order)
    page.click("#geometry summary")
    page.click("#geometry .order button")
    until(page, lambda: finished(page) == "ok")
    order = order_of(cases / "mixed")
    assert list(order["edits"]) == ["1"] and order["views"] == [str(p) for p in given.views]
    told = json.loads(case.geometry.read_text())["views"]
    angles = [view["primary_angle_deg"] for view in told]
    assert [view["primary_angle_deg"] for view in order["geometry"]["views"]] == angles[::-1]
    assert [view["id"] for view in order["geometry"]["views"]] == [v["id"] for v in told]


@pytest.mark.slow
def test_one_printed_page(serve, browse):
    address, _ = serve(lambda desk: desk.demo().id)
    page = browse(address)
    finished(page)
    page.wait_for_timeout(300)
    document = page.pdf(prefer_css_page_size=True, print_background=True)
    assert document.count(b"/Type /Page\n") + document.count(b"/Type /Page ") == 1


def test_demo_to_a_result_in_three_clicks(serve, browse, record_property):
    """From opening the address: clicks counted; the wall limit is that of a busy machine."""
    address, _ = serve()
    started = time.perf_counter()
    page = browse(address)
    page.evaluate("window.clicks = 0; addEventListener('click', () => window.clicks++, true)")
    page.click("#demo")
    page.wait_for_selector("#lesions tbody tr")
    seconds = time.perf_counter() - started
    record_property("seconds", seconds)
    assert page.evaluate("window.clicks") <= 3 and seconds < 240


@pytest.mark.benchmark
def test_demo_takes_less_than_ten_seconds(serve, browse):
    address, _ = serve()
    started = time.perf_counter()
    page = browse(address)
    page.click("#demo")
    page.wait_for_selector("#lesions tbody tr")
    seconds = time.perf_counter() - started
    print(f"from opening the demo to its result: {seconds:.1f} s, one click")
    assert seconds < 10

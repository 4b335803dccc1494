"""The workbench over HTTP: who is answered, and what is refused."""

from __future__ import annotations

import io
import json
import time

import pytest

from gcar_deploy.engine import Engine
from gcar_deploy.inputs.order import load_order
from gcar_deploy.workbench import http
from gcar_deploy.workbench.desk import Desk
from gcar_deploy.worker.jobs import JobQueue
from tests.cli.conftest import good_case  # noqa: F401 - a fixture
from tests.conftest import of_data, ready_case
from tests.workbench.conftest import TOKEN

pytest.importorskip("flask")
pytest.importorskip("waitress")
BEARER = {"Authorization": f"Bearer {TOKEN}"}


@pytest.fixture
def desk(tmp_path):
    return Desk(tmp_path / "cases")


@pytest.fixture
def ask(desk):
    from gcar_deploy.workbench.http import create_app

    def work(order, on_progress, cancel):
        return desk.work(Engine(threads=1), order, on_progress, cancel)

    queue = JobQueue(work)
    client = create_app(desk, queue, TOKEN).test_client()
    yield lambda method, path, **more: client.open(
        path, method=method, **{"headers": BEARER, "base_url": "http://127.0.0.1:80", **more}
    )
    queue.close()


def test_only_the_page_itself_needs_no_token(ask, desk):
    case = desk.demo()
    paths = ["/api/desk", f"/api/cases/{case.id}", f"/api/cases/{case.id}/views/1/picture.png"]
    for path in paths:
        assert ask("GET", path, headers={}).status_code == 401
        assert ask("GET", path, headers={"Authorization": "Bearer no"}).status_code == 401
        assert ask("GET", path).status_code == 200
    for method, path in (("POST", "/api/demo"), ("PUT", f"/api/cases/{case.id}/order")):
        assert ask(method, path, headers={}, json={}).status_code == 401
    assert len(desk.cases) == 1
    page = ask("GET", "/", headers={})
    assert (
        page.status_code == 200 and "default-src 'none'" in page.headers["Content-Security-Policy"]
    )
    assert TOKEN.encode() not in page.data
    assert ask("GET", "/main.js", headers={}).mimetype == "text/javascript"
    for name in ("/../case.py", "/..%2fcase.py", "/case.py", "/nothing.js"):
        assert ask("GET", name, headers={}).status_code in (401, 404)


def test_pages_of_others_and_foreign_names_are_turned_away(ask):
    for origin in ("http://127.0.0.1:81", "http://evil.example", "null"):
        assert ask("GET", "/api/desk", headers={**BEARER, "Origin": origin}).status_code == 403
    own = ask("GET", "/api/desk", headers={**BEARER, "Origin": "http://127.0.0.1"})
    assert own.status_code == 200
    assert ask("GET", "/api/desk", base_url="http://evil.example").status_code in (400, 421)


@pytest.mark.slow
def test_a_refused_run_leaves_no_result_of_an_earlier_order(ask, desk):
    case = desk.demo()

    def ran():
        job = ask("POST", f"/api/cases/{case.id}/run").json["id"]
        while (told := ask("GET", f"/api/jobs/{job}").json)["state"] in ("queued", "running"):
            time.sleep(0.1)
        return told["state"]

    assert ran() == "done" and case.described()["result"] is True
    made = (case.folder / "result" / "result.json").read_bytes()
    everything = [[-9, -9], [999, -9], [999, 999], [-9, 999]]
    edits = {"1": [{"do": "erase", "points": everything}]}
    assert ask("PUT", f"/api/cases/{case.id}/order", json={"edits": edits}).status_code == 200
    assert ran() == "refused" and case.described()["result"] is False
    assert ask("GET", f"/api/cases/{case.id}/result").status_code == 400
    assert (case.folder / "result" / "result.json").read_bytes() == made
    assert (case.folder / "refused.txt").read_text().startswith("order.json was refused: no vessel")
    assert ask("PUT", f"/api/cases/{case.id}/order", json={"edits": None}).status_code == 200
    assert ran() == "done" and not (case.folder / "refused.txt").exists()


def test_result_files_have_an_address_of_their_own(ask, desk):
    case = desk.demo()
    found = ask("GET", f"/files/{case.key}/order.json", headers={})
    assert json.loads(found.data)["out"] == "result"
    for path in ("/files/wrong/order.json", f"/files/{case.key}/../order.json",
                 f"/files/{case.key}/..%2forder.json"):  # fmt: skip
        assert ask("GET", path, headers={}).status_code in (401, 404)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"views": ["a", "b"]}, "'views' is none of edits"),
        ({"out": "elsewhere"}, "'out' is none of"),
        ({"edits": {"3": []}}, "edits 3: there are views 1 .. 2"),
        ({"edits": {"1": [{"do": "cut"}]}}, "edits.1[0].do"),
        ({"deleted_mm": [[1, 2]]}, "deleted_mm"),
    ],
)
def test_wrong_corrections_change_nothing(ask, desk, values, words):
    case = desk.demo()
    before = case.order_file.read_bytes()
    answer = ask("PUT", f"/api/cases/{case.id}/order", json=values)
    assert case.order_file.read_bytes() == before
    assert answer.status_code == 400 and words in answer.json["error"]["message"]


def test_who_has_not_seen_a_correction_does_not_undo_it(ask, desk):
    case = desk.demo()
    path, seen = f"/api/cases/{case.id}/order", case.described()["revision"]

    def put(**values):
        return ask("PUT", path, json={"revision": seen, **values})

    stroke = [{"do": "erase", "width_px": 3, "points": [[9, 9], [20, 9]]}]
    assert put(edits={"1": stroke}).json["revision"] == seen + 1
    late = put(edits={"2": stroke})
    assert late.status_code == 400 and "corrected elsewhere" in late.json["error"]["message"]
    assert list(json.loads(case.order_file.read_text())["edits"]) == ["1"]
    # Another program, which has opened the same folder.
    Desk(case.folder.parent).again(case.folder).correct(
        {"regions": {"1": [[0, 0], [9, 0], [9, 9]]}}
    )
    late = ask("PUT", path, json={"edits": {"2": stroke}})
    assert late.status_code == 400 and "another program" in late.json["error"]["message"]
    assert "regions" in json.loads(case.order_file.read_text()) and list(case.order.edits) == [1]


@pytest.mark.slow
def test_what_cannot_be_kept_is_not_taken(ask, desk, monkeypatch):
    case = desk.demo()
    stroke = [{"do": "erase", "width_px": 3, "points": [[9.5, 9]] * 2000}]

    def put(strokes):
        return ask("PUT", f"/api/cases/{case.id}/order", json={"edits": {"1": strokes}})

    # Hours of drawing are read again as they were kept.
    assert put(stroke * 200).status_code == 200
    assert load_order(case.order_file).edits == case.order.edits and len(case.order.edits[1]) == 200
    before = case.order_file.read_bytes()
    monkeypatch.setattr("gcar_deploy.workbench.case.MAX_BYTES", len(before))
    assert "would be larger than" in put(stroke * 201).json["error"]["message"]
    monkeypatch.undo()
    case.order_file.with_name("order.json.new").mkdir()
    answer = put(stroke)
    assert answer.status_code == 400 and "cannot be written" in answer.json["error"]["message"]
    assert case.order_file.read_bytes() == before and len(case.order.edits[1]) == 200


def test_a_geometry_that_shows_nothing_is_not_taken(ask, desk):
    case = desk.demo()
    told = case.described()["geometry"]
    told["views"][1]["sod_mm"] = 1200
    answer = ask("PUT", f"/api/cases/{case.id}/order", json={"geometry": told})
    assert answer.status_code == 400 and "sdd_mm" in answer.json["error"]["message"]
    assert case.described()["problem"] is None


def test_dropped_files_become_a_case(ask, desk, good_case):  # noqa: F811
    def drop(*names):
        files = [("file", (io.BytesIO((good_case / n).read_bytes()), n)) for n in names]
        from werkzeug.datastructures import MultiDict

        return ask("POST", "/api/cases", data=MultiDict(files))

    found = drop("view2.png", "geom.json", "view1.png")
    assert found.status_code == 200 and found.json["problem"] is None, found.data
    assert [view["id"] for view in found.json["views"]] and found.json["order"]["views"] == [
        "view1.png", "view2.png",
    ]  # fmt: skip
    assert drop("view1.png", "geom.json").json["error"]["message"].startswith("1 pictures and 1")

    def content(case):
        folder = desk.case(case.json["id"]).folder
        return [(folder / name).read_bytes() for name in case.json["order"]["views"]]

    (good_case / "b10.png").write_bytes((good_case / "view1.png").read_bytes())
    (good_case / "b9.png").write_bytes((good_case / "view2.png").read_bytes())
    assert content(drop("b10.png", "b9.png", "geom.json")) == content(found)[::-1]
    bare = drop("view1.png", "view2.png")
    assert "geometry is needed" in bare.json["problem"]
    view = json.loads((good_case / "geom.json").read_text())["views"][0]
    assert bare.json["sizes"] == [[view["rows"], view["columns"]]] * 2
    assert ask("POST", "/api/cases/none/run").status_code == 400


def test_epipolar_line_goes_through_the_other_picture_of_a_point(ask, desk):
    import numpy as np

    case = desk.demo()
    carms = [a.carm for a in case.angiograms()]
    place = np.array([[5.0, -8.0, 12.0]])
    first, second = (carm.project(place)[0][0] for carm in carms)
    found = ask("POST", f"/api/cases/{case.id}/views/1/epipolar", json={"point": first.tolist()})
    (line,) = found.json["views"]
    a, b = (np.array(end) for end in line["line"])
    along = (b - a) / np.linalg.norm(b - a)
    gap = abs(along[0] * (second - a)[1] - along[1] * (second - a)[0])
    assert line["view"] == 2 and gap < 0.05 and line["crossings"] == []


def test_crossings_are_the_vessels_on_the_line():
    import numpy as np

    from gcar_deploy.workbench.shown import _crossings

    skeleton = np.zeros((50, 50), bool)
    skeleton[:, 10] = skeleton[:, 30] = True
    found = _crossings(np.array([0.0, 1.0, -20.0]), skeleton)
    assert sorted(found) == [[10.0, 20.0], [30.0, 20.0]]


def test_only_what_hangs_on_the_ostium_is_so_far_from_it():
    import numpy as np

    from gcar_deploy.tree.rooted import inlet_arcs
    from gcar_deploy.tree.tree import Branch, Tree

    nodes = np.array([[x, 0.0, 0.0] for x in (0, 10, 30, 33, 50)])
    ends = ((0, 1), (1, 2), (3, 4))
    branches = tuple(
        Branch(points_mm=nodes[list(pair)], radius_mm=np.ones(2), sigma_mm=np.ones(2),
               confidence=np.ones(2), start=pair[0], end=pair[1])
        for pair in ends
    )  # fmt: skip
    assert inlet_arcs(Tree(nodes_mm=nodes, branches=branches)) == [0.0, 10.0, None]
    assert inlet_arcs(Tree(nodes_mm=nodes, branches=())) == []


def test_a_trace_follows_the_line_not_the_chord():
    import numpy as np

    from gcar_deploy.geometry.scene import Intensity
    from gcar_deploy.imaging.angiogram import Angiogram
    from gcar_deploy.workbench.trace import trace

    angle = np.linspace(0, np.pi, 400)
    columns, rows = 60 + 40 * np.cos(angle), 80 - 40 * np.sin(angle)
    r, c = np.mgrid[0:100, 0:120]
    gap = np.min(np.hypot(r[..., None] - rows, c[..., None] - columns), axis=-1)
    pixels = np.exp(-0.5 * (gap / 2) ** 2).astype(np.float32)
    picture = Angiogram.without_geometry(
        "1", (pixels, 8, "0"), Intensity(kind="path_length", mm_per_count=1.0)
    )
    ends = np.array([100.0, 80.0]), np.array([20.0, 80.0])
    found = trace(picture, None, ends)
    points = np.array(found["points"])
    assert abs(np.hypot(points[:, 0] - 60, points[:, 1] - 80) - 40).max() < 3
    assert 4 < found["width_px"] < 14


def test_a_picture_without_its_background_keeps_its_vessels(ask, desk):
    import cv2
    import numpy as np

    from gcar_deploy.inputs.order import Order

    folder = ready_case("R_0001")
    given = Order(views=(folder / "view1.png", folder / "view2.png"), geometry=folder / "geom.json")
    case = desk.add(desk.new_folder("raw"), given)
    raw, flat = (
        cv2.imdecode(np.frombuffer(ask("GET", f"/api/cases/{case.id}/views/1/{n}.png").data,
                                   np.uint8), cv2.IMREAD_GRAYSCALE)
        for n in ("picture", "flat")
    )  # fmt: skip
    assert raw.shape == flat.shape
    vessel = cv2.imread(str(ready_case("C_0001") / "view1.png"), -1) > 1000
    away = cv2.dilate(vessel.astype(np.uint8), np.ones((25, 25))) == 0
    # Vessels stay dark, and what lies elsewhere varies less than before against them.
    contrast = [float(np.median(p[away]) - np.median(p[vessel])) for p in (raw, flat)]
    spread = [float(np.std(cv2.GaussianBlur(p, (0, 0), 4)[away])) for p in (raw, flat)]
    assert contrast[1] > 0 and contrast[1] / spread[1] > contrast[0] / spread[0]


def test_a_noisy_negative_is_read_like_the_clear_one_beside_it(ask, desk, monkeypatch):
    """Bright vessels on a dark ground; of the second picture alone nobody could say so."""
    import cv2
    import numpy as np

    from gcar_deploy.imaging.polarity import is_dark
    from gcar_deploy.inputs.order import Order

    source, folder = ready_case("C_0001"), desk.new_folder("negative")
    told = json.loads((source / "geom.json").read_text())
    rng = np.random.default_rng(3)
    drawn = (20, 1.0), (10, 60.0)  # counts per mm, noise
    for k, (view, (gain, noise)) in enumerate(zip(told["views"], drawn, strict=True), start=1):
        path = cv2.imread(str(source / f"view{k}.png"), -1) * view["intensity"]["mm_per_count"]
        grey = 40 + gain * path + rng.normal(0, noise, path.shape)
        cv2.imwrite(str(folder / f"view{k}.png"), np.clip(grey, 0, 255).astype(np.uint8))
        view["intensity"] = {"kind": "raw"}
    (folder / "geom.json").write_text(json.dumps(told))
    views = folder / "view1.png", folder / "view2.png"
    case = desk.add(folder, Order(views=views, geometry=folder / "geom.json"))
    alone = [is_dark(one) for one in case.angiograms()]
    assert alone == [False, True]  # what is usual
    assert [is_dark(one) for one in case.judged()] == [False, False]
    assert [one.intensity.polarity for one in case.angiograms()] == ["auto", "auto"]
    # The deepest vessel of the second picture is followed as a bright line.
    row, column = np.unravel_index(np.argmax(cv2.GaussianBlur(path, (0, 0), 3)), path.shape)
    body = {"from": [float(column), float(row)], "to": [float(column) + 12, float(row)]}
    asked, real = [], http.trace
    monkeypatch.setattr(
        http, "trace", lambda picture, *rest: asked.append(is_dark(picture)) or real(picture, *rest)
    )
    answer = ask("POST", f"/api/cases/{case.id}/views/2/trace", json=body)
    assert answer.status_code == 200 and asked == [False]


def test_scores_of_frame_pairs_are_told_from_either_view(ask, desk):
    import numpy as np

    case = desk.demo()
    assert case.scores_with(1) == {}
    case.pair_scores[1, 2] = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    assert case.scores_with(1) == {"2": [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]}
    assert case.scores_with(2) == {"1": [[0.1, 0.4], [0.2, 0.5], [0.3, 0.6]]}


@pytest.mark.slow
def test_frames_of_two_runs_come_with_how_they_go_together(ask, desk, tmp_path):
    import cv2

    from gcar_deploy.geometry.scene import Intensity, Scene, View, scene_to_json
    from gcar_deploy.inputs.order import Order
    from gcar_export.scenes.cine import cine_pair
    from gcar_export.studies.frame_pairs import CHOSEN_ON

    made = cine_pair(CHOSEN_ON, 3)
    views = []
    for k, run in enumerate(made.runs, start=1):
        cv2.imwritemulti(str(tmp_path / f"run{k}.tif"), list(run.pixels))
        views.append(View(id=str(k), carm=run.carm, intensity=Intensity(kind="raw")))
    (tmp_path / "geom.json").write_text(scene_to_json(Scene(views=tuple(views))))
    order = Order(
        views=(tmp_path / "run1.tif", tmp_path / "run2.tif"), geometry=tmp_path / "geom.json"
    )
    case = desk.add(desk.new_folder("cine"), order)
    told = ask("GET", f"/api/cases/{case.id}").json
    assert told["problem"] is None and told["dicom"] == [True, True]
    first, second = (ask("GET", f"/api/cases/{case.id}/views/{k}/frames").json for k in (1, 2))
    assert first["frames"] == 15 and first["with"] == {"2": second["chosen"]}
    assert made.phase_error()[first["chosen"] - 1, second["chosen"] - 1] * 8 <= 1
    scores = first["pairs"]["2"]
    assert scores[first["chosen"] - 1][second["chosen"] - 1] > 0.5
    assert second["pairs"]["1"][0][2] == scores[2][0]
    shown = ask("GET", f"/api/cases/{case.id}/views/1/frames/3.png")
    assert shown.status_code == 200 and shown.data.startswith(b"\x89PNG")
    # A frame chosen by hand keeps the scores.
    assert ask("PUT", f"/api/cases/{case.id}/order", json={"frames": [3, 4]}).status_code == 200
    assert ask("GET", f"/api/cases/{case.id}/views/1/frames").json["pairs"]["2"] == scores


def test_what_headers_do_not_say_is_asked_for(ask, desk):
    """A run without pixel spacing: named by the key that tells it, shown, and then read."""
    pytest.importorskip("gdcm", reason="the runs are JPEG lossless")
    from werkzeug.datastructures import MultiDict

    folder = of_data("phantom_xa")
    given = {"IM8.dcm": "runs/LAO.dcm", "IM1.dcm": "\u202eRAO.dcm"}
    files = [("file", (io.BytesIO((folder / k).read_bytes()), name)) for k, name in given.items()]
    case = ask("POST", "/api/cases", data=MultiDict(files)).json
    assert case["names"] == ["LAO.dcm", "RAO.dcm"] and case["sizes"] is None
    assert case["lacks"] == {"pixel_spacing_mm": [2]} and case["views"] == []
    path = f"/api/cases/{case['id']}"
    shown = ask("GET", f"{path}/views/2/bare.png")
    assert shown.status_code == 200 and shown.data.startswith(b"\x89PNG")
    assert ask("GET", f"{path}/views/3/bare.png").status_code == 400
    told = ask("PUT", f"{path}/order", json={"pixel_spacing_mm": 0.39}).json
    assert told["problem"] is None and told["lacks"] == {} and len(told["views"]) == 2
    assert "RAO" not in desk.case(case["id"]).order_file.read_text()
    again = ask("PUT", f"{path}/order", json={"pixel_spacing_mm": None}).json
    assert again["lacks"] == case["lacks"]


def test_runs_without_angles_are_asked_for_their_whole_geometry(desk, tmp_path):
    pytest.importorskip("gdcm", reason="the runs are JPEG lossless")
    import pydicom

    from gcar_deploy.inputs.order import Order

    views = tuple(tmp_path / name for name in ("IM7.dcm", "IM8.dcm"))
    for path in views:
        run = pydicom.dcmread(of_data("phantom_xa") / path.name)
        del run.PositionerPrimaryAngle
        run.save_as(path)
    told = desk.add(desk.new_folder("runs"), Order(views=views)).described()
    assert "PositionerPrimaryAngle" in told["problem"] and told["lacks"] == {}
    assert told["sizes"] == [(512, 512)] * 2

"""Orders: what JSON says comes back the same, and what is wrong is named."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gcar_deploy.config import (
    PREDICTORS,
    REFINERS,
    SEGMENTERS,
    LesionBorders,
    RunOptions,
    check_options,
)
from gcar_deploy.errors import UsageError
from gcar_deploy.geometry.fields import LEAST_VIEWS, MOST_VIEWS
from gcar_deploy.inputs.drawn import DOES, Stroke
from gcar_deploy.inputs.order import (
    EXTRAS,
    KEYS,
    POSES,
    SCHEMA,
    Order,
    load_order,
    order_to_json,
    parse_order,
)
from gcar_deploy.pose import landmark_pixels
from tests.tubes.scenes import two_views

_names = st.text("abcäö 1./-", min_size=1, max_size=12).map(Path)
_points = st.none() | st.tuples(st.floats(0, 4000), st.floats(0, 4000))
_corners = st.lists(st.tuples(st.floats(0, 4000), st.floats(0, 4000)), min_size=3, max_size=4).map(
    tuple
)
_strokes = st.builds(
    Stroke,
    do=st.sampled_from(DOES),
    points=_corners,
    width_px=st.none() | st.floats(1, 400),
)
_places = st.tuples(*[st.floats(-200, 200)] * 3)


@st.composite
def orders(draw) -> Order:
    views = tuple(draw(st.lists(_names, min_size=2, max_size=16)))
    numbers = st.integers(1, len(views))
    landmark = st.tuples(*[_points] * len(views))
    pose = draw(st.none() | st.sampled_from(POSES))
    landmarks = st.lists(landmark, min_size=1, max_size=3).map(tuple)
    mark = st.tuples(st.floats(0, 4000), st.floats(0, 4000))
    lesions = st.builds(LesionBorders, view=numbers, proximal=mark, distal=mark)
    return Order(
        views=views,
        lesions=draw(st.none() | st.lists(lesions, min_size=1, max_size=2).map(tuple)),
        geometry=draw(st.none() | _names | st.just({"schema": "gcar-geometry/1", "views": []})),
        masks=draw(st.dictionaries(numbers, _names, max_size=3)),
        landmarks=None if pose == "off" else draw(st.none() | landmarks),
        edits=draw(st.dictionaries(numbers, _strokes.map(lambda one: (one, one)), max_size=1)),
        regions=draw(st.dictionaries(numbers, _corners, max_size=1)),
        same_branch=draw(st.none() | st.tuples(landmark)),
        ostia=draw(st.none() | st.tuples(landmark)),
        deleted_mm=draw(st.none() | st.tuples(_places)),
        drawn_on=draw(
            st.dictionaries(numbers, st.text("0af", min_size=64, max_size=64), max_size=2)
        ),
        frames=draw(st.none() | st.lists(st.none() | st.integers(1, 900), min_size=1).map(tuple)),
        pixel_spacing_mm=draw(st.none() | st.floats(0.02, 10)),
        sod_mm=draw(st.none() | st.floats(300, 5000)),
        allow_rescale=draw(st.booleans()),
        pose=pose,
        segmenter=draw(st.none() | st.sampled_from(SEGMENTERS)),
        predictor=draw(st.none() | st.sampled_from(PREDICTORS)),
        refiner=draw(st.none() | st.sampled_from(REFINERS)),
        deadline_s=draw(st.none() | st.floats(0.1, 1e4)),
        strict=draw(st.booleans()),
        force=draw(st.booleans()),
        out=draw(st.none() | _names),
        extras=tuple(draw(st.lists(st.sampled_from(sorted(EXTRAS)), unique=True))),
    )


@settings(suppress_health_check=[HealthCheck.too_slow])
@given(orders())
def test_json_and_back(order):
    text = order_to_json(order)
    assert json.loads(text)["schema"] == SCHEMA
    assert parse_order(json.loads(text)) == order
    assert order.with_files(lambda _, path: path) == order


@pytest.mark.slow
@settings(suppress_health_check=[HealthCheck.too_slow])
@given(orders())
def test_every_order_makes_options_that_pass_their_checks(order):
    options = order.options(RunOptions())
    check_options(options)
    assert (options.pose.enabled is False) == (order.pose == "off")
    assert options.imaging.allow_rescale == order.allow_rescale
    for key, told in (
        ("segmenter", options.imaging.segmenter),
        ("predictor", options.predict.predictor),
        ("refiner", options.refine.refiner),
        ("frames", options.dicom.frames),
        ("sod_mm", options.dicom.sod_mm),
        ("pixel_spacing_mm", options.dicom.pixel_spacing_mm),
        ("landmarks", options.landmarks),
        ("same_branch", options.same_branch),
        ("ostia", options.ostia),
        ("deleted_mm", options.deleted_mm),
        ("lesions", options.lesions),
    ):
        if getattr(order, key) is not None:
            assert told == getattr(order, key), key


def test_what_an_order_leaves_open_is_as_the_engine_was_set_up():
    base = Order(
        predictor="none", refiner="paper", pose="off", sod_mm=700, allow_rescale=True
    ).options(RunOptions())
    assert Order(views=(Path("a"), Path("b"))).options(base) == base


POSIX = pytest.mark.skipif(os.name != "posix", reason="Windows names files by such halves too")
BASE = {"views": ["a", "b"]}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"schema": "gcar-order/2"}, "schema = 'gcar-order/2'"),
        ({"views": ["a"]}, "1 entries"),
        ({"views": ["a"] * 17}, "17 entries"),
        ({"views": ["a", 3]}, "views = 3"),
        ({"views": ["a", ""]}, "views = ''"),
        ({"geometry": 3}, "geometry must be"),
        ({"masks": ["m"]}, "number of the view"),
        ({"masks": {"one": "m"}}, "number of the view"),
        ({"masks": {"1": "m", "01": "n"}}, "number of the view"),
        ({"masks": {"\u0661": "m"}}, "number of the view"),
        ({"masks": {"3": "m"}}, "mask 3: there are views 1 .. 2"),
        ({"masks": {"0": "m"}}, "mask 0"),
        ({"masks": {"1": 4}}, "masks.1 = 4"),
        ({"landmarks": [[[1, 2, 3], None]]}, "column, row"),
        ({"landmarks": [[["1", 2], None]]}, "landmarks = '1'"),
        ({"landmarks": [[[1, 2], [3, 4]]], "pose": "off"}, "pose off"),
        ({"edits": {"3": []}}, "edits 3: there are views 1 .. 2"),
        ({"edits": {"1": [{"do": "cut", "points": [[1, 2]]}]}}, "edits.1[0].do = 'cut'"),
        ({"edits": {"1": [{"do": "erase", "points": [[1, 2]]}]}}, "edits.1[0].points must be"),
        ({"edits": {"1": [{"do": "erase", "width_px": 0, "points": [[1, 2]]}]}}, "width_px = 0"),
        ({"edits": {"1": [{"do": "erase", "with": 3, "points": []}]}}, "unknown key 'with'"),
        ({"edits": [1]}, "number of the view"),
        ({"regions": {"1": [[1, 2], [3, 4]]}}, "regions.1 must be a list of 3"),
        ({"regions": {"1": [[1, 2], [3, 4], [1e9, 0]]}}, "lies in no picture"),
        ({"ostia": [[[1, 2, 3], None]]}, "ostia: [1, 2, 3] must be [column, row]"),
        ({"deleted_mm": [[1, 2]]}, "deleted_mm = [1, 2] must be 3 numbers"),
        ({"deleted_mm": [[1, 2, 1e6]]}, "outside -2000 .. 2000 mm"),
        ({"lesions": [{"view": 3, "proximal": [1, 2], "distal": [3, 4]}]}, "lesions.view = 3"),
        ({"lesions": [{"view": 1, "proximal": [1, 2]}]}, "has no distal"),
        ({"lesions": [{"view": 1, "proximal": [1], "distal": [3, 4]}]}, "column, row"),
        ({"drawn_on": {"3": "0" * 64}}, "drawn_on 3: there are views 1 .. 2"),
        ({"drawn_on": {"1": "0" * 63}}, "must be 64 digits"),
        ({"frames": [0]}, "frames = 0"),
        ({"frames": 7}, "list of frames"),
        ({"frames": [1.5]}, "whole number"),
        ({"pixel_spacing_mm": 30}, "pixel_spacing_mm = 30.0 must be a number, 0.02 .. 10"),
        ({"sod_mm": 76.5}, "sod_mm = 76.5 must be a number, 300 .. 5,000"),
        ({"pose": "of"}, "pose = 'of' must be one of auto, off"),
        ({"pose": False}, "pose = False"),
        ({"segmenter": "both"}, "segmenter = 'both'"),
        ({"predictor": "single"}, "predictor = 'single'"),
        ({"refiner": "auto"}, "refiner = 'auto'"),
        ({"deadline_s": 0}, "deadline_s = 0"),
        ({"deadline_s": True}, "deadline_s = True"),
        ({"strict": 1}, "strict = 1"),
        ({"allow_rescale": "yes"}, "allow_rescale = 'yes'"),
        ({"out": 1}, "out = 1"),
        pytest.param({"out": "\ud800"}, "no name has", marks=POSIX),
        pytest.param({"views": ["a", "\ud800.png"]}, "no name has", marks=POSIX),
        ({"extras": ["stl"]}, "extras = 'stl'"),
        ({"extras": "glb"}, "list of names"),
        ({"pixel_spacing": 1}, "did you mean 'pixel_spacing_mm'"),
    ],
)
def test_wrong_orders_name_key_and_value(change, words):
    with pytest.raises(UsageError) as caught:
        parse_order({**BASE, **change})
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_points_of_views_that_were_added_later_are_marked_nowhere():
    marks = [[[1, 2], [3, 4]], [None, [5, 6], [7, 8]]]
    three = {"views": ["a", "b", "c"], "landmarks": marks, "ostia": marks[:1]}
    options = parse_order(three).options(RunOptions())
    assert options.landmarks == (
        ((1.0, 2.0), (3.0, 4.0), None), (None, (5.0, 6.0), (7.0, 8.0)),
    )  # fmt: skip
    assert options.ostia == options.landmarks[:1]
    # Points of views that are not there, and one alone, stay a wrong call.
    for wrong in (marks, [[[1, 2]]]):
        two = parse_order({**BASE, "landmarks": wrong}).options(RunOptions())
        with pytest.raises(UsageError, match="points for 2 views"):
            landmark_pixels(two.landmarks, two_views())


def test_relative_paths_of_a_file_begin_at_its_folder(tmp_path):
    file = tmp_path / "order.json"
    values = {**BASE, "geometry": "g.json", "masks": {"2": "/m.png"}, "out": "r"}
    file.write_text(json.dumps(values), encoding="utf-8-sig")
    order = load_order(file)
    assert order.files == {
        "view1": tmp_path / "a", "view2": tmp_path / "b", "geometry": tmp_path / "g.json",
        "mask2": Path("/m.png"),
    }  # fmt: skip
    assert order.out == tmp_path / "r"


@pytest.mark.parametrize("content", [b"{", b"[]", b"\x80", b'{"views": ["a", NaN]}', b""])
def test_order_files_that_are_none(content, tmp_path):
    (tmp_path / "o.json").write_bytes(content)
    with pytest.raises(UsageError, match=r"o\.json: "):
        load_order(tmp_path / "o.json")
    with pytest.raises(UsageError, match=r"p\.json: "):
        load_order(tmp_path / "p.json")


def test_the_worker_describes_every_key():
    """openapi.json is written by hand; what it offers is what an order takes."""
    from importlib import resources

    text = resources.files("gcar_deploy.worker").joinpath("openapi.json").read_text("utf-8")
    document = json.loads(text)
    schemas = document["components"]["schemas"]
    said = schemas["Order"]["allOf"]
    known = set(said[1]["properties"]) | set(schemas["Options"]["properties"])
    assert known == set(KEYS)
    options = schemas["Options"]["properties"]
    for key, choices in (
        ("pose", POSES), ("segmenter", SEGMENTERS), ("predictor", PREDICTORS),
        ("refiner", REFINERS),
    ):  # fmt: skip
        assert set(options[key]["enum"]) == {*choices, None}
    assert options["extras"]["items"]["enum"] == list(EXTRAS)
    form = document["paths"]["/v1/reconstruct"]["post"]["requestBody"]["content"]
    parts = form["multipart/form-data"]["schema"]
    for views in (parts["properties"]["view"], said[1]["properties"]["views"]):
        assert (views["minItems"], views["maxItems"]) == (LEAST_VIEWS, MOST_VIEWS)
    for masks, start in ((parts, "mask"), (said[1]["properties"]["masks"], "")):
        (pattern,) = masks["patternProperties"]
        taken = [k for k in range(100) if re.search(pattern, f"{start}{k}")]
        assert taken == list(range(1, MOST_VIEWS + 1))

"""Every way a scene file can be wrong has its own line; what is right survives a round trip."""

import copy
import json
from importlib import resources

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gcar_deploy.errors import GeometryError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import (
    Intensity,
    load_scene,
    match_picture,
    parse_scene,
    scene_to_json,
)

VIEW = {
    "primary_angle_deg": -30,
    "secondary_angle_deg": -20,
    "sod_mm": 765,
    "sdd_mm": 1100,
    "rows": 512,
    "columns": 512,
    "pixel_spacing_mm": [0.39, 0.39],
    "intensity": {"kind": "raw", "polarity": "dark"},
}
SCENE = {
    "schema": "gcar-geometry/1",
    "frame": "LPS",
    "views": [VIEW, {**VIEW, "primary_angle_deg": 45, "secondary_angle_deg": 25}],
    "volume": {"center_mm": [0, 0, 0], "size_mm": [128, 128, 128], "shape": [128, 128, 128]},
}


def changed(path, value):
    data = copy.deepcopy(SCENE)
    at = data
    for key in path[:-1]:
        at = at[key]
    if value is KeyError:
        del at[path[-1]]
    else:
        at[path[-1]] = value
    return data


FIRST = ("views", 0)
BAD = [
    (changed(("schema",), "gcar-geometry/2"), "schema"),
    (changed(("schema",), KeyError), "schema"),
    (changed(("frame",), "RAS"), "frame"),
    (changed(("views",), KeyError), "views is missing"),
    (changed(("views",), [VIEW]), "views holds 1"),
    (changed(("views",), [VIEW] * 17), "views holds 17"),
    (changed(("views",), {}), "views is missing or not a list"),
    (changed((*FIRST,), 7), "view 1: the view must be a JSON object"),
    (changed(("volme",), {}), "did you mean 'volume'"),
    (changed((*FIRST, "sod"), 765), "did you mean 'sod_mm'"),
    (changed((*FIRST, "primary_angle"), 3), "did you mean 'primary_angle_deg'"),
    *[
        (changed((*FIRST, key), KeyError), f"view 1: {key} is missing")
        for key in (
            "primary_angle_deg",
            "secondary_angle_deg",
            "sod_mm",
            "sdd_mm",
            "rows",
            "columns",
            "pixel_spacing_mm",
        )
    ],
    (changed((*FIRST, "primary_angle_deg"), 181), "outside -180 .. 180 deg"),
    (changed((*FIRST, "primary_angle_deg"), "30"), "must be a number"),
    (changed((*FIRST, "primary_angle_deg"), True), "must be a number"),
    (changed((*FIRST, "secondary_angle_deg"), -91), "outside -90 .. 90 deg"),
    (changed((*FIRST, "sod_mm"), 76.5), "sod_mm = 76.5 mm is outside 300 .. 5000 mm"),
    (changed((*FIRST, "sod_mm"), 0), "outside 300"),
    (changed((*FIRST, "sod_mm"), 1200), "must exceed sod_mm"),
    (changed((*FIRST, "sdd_mm"), 11000), "outside 300 .. 8000"),
    (changed((*FIRST, "rows"), 512.5), "whole number"),
    (changed((*FIRST, "rows"), -4), "outside 1"),
    (changed((*FIRST, "pixel_spacing_mm"), 0.39), "must be 2 numbers"),
    (changed((*FIRST, "pixel_spacing_mm"), [0.39, 0.01]), "outside 0.02 .. 10 mm"),
    (changed((*FIRST, "pixel_spacing_mm"), [0.39, None]), "must be a number"),
    (changed((*FIRST, "principal_point_px"), [1, 2, 3]), "must be 2 numbers"),
    (changed((*FIRST, "isocenter_offset_mm"), [0, 0, 900]), "outside -500 .. 500 mm"),
    (changed((*FIRST, "projection_matrix"), [[1, 2], [3, 4]]), "3 rows of 4"),
    (changed((*FIRST, "projection_matrix"), [[0] * 4] * 3), "singular"),
    (changed((*FIRST, "intensity"), {"kind": "xray"}), "intensity.kind"),
    (changed((*FIRST, "intensity"), {"kind": "raw", "polarity": "black"}), "intensity.polarity"),
    (changed((*FIRST, "intensity"), {"kind": "path_length"}), "mm_per_count is missing"),
    (changed((*FIRST, "intensity"), {"kind": "path_length", "mm_per_count": -1}), "mm_per_count"),
    (changed((*FIRST, "intensity"), {"kin": "raw"}), "did you mean 'kind'"),
    (changed((*FIRST, "id"), ""), "id = ''"),
    (changed((*FIRST, "id"), "2"), "stands twice"),
    (changed(("volume", "shape"), [128, 128]), "volume.shape"),
    (changed(("volume", "shape"), [128, 128, 0]), "outside 1 .. 1024"),
    (changed(("volume", "size_mm"), [128, 128, -1]), "volume.size_mm"),
    (changed(("volume", "size_mm"), KeyError), "volume.size_mm is missing"),
    (changed(("volume", "center_mm"), [0, 800, 0]), "from the source"),
    (changed(("volume", "size_mm"), [128, 900, 128]), "behind the detector"),
    (changed((*FIRST, "principal_point_px"), [1e300, 0]), "is outside -100000 .. 100000"),
    (changed((*FIRST, "projection_matrix"), [[1e308] * 4] * 3), "is outside -1e+09 .. 1e+09"),
    (changed((*FIRST, "primary_angle_deg"), None), "primary_angle_deg is missing"),
    (changed(("schema",), "x" * 9000), "schema = 'xxx"),
    (changed((*FIRST, "id"), "x" * 9000), "id = 'xxx"),
    (changed((*FIRST, "x" * 9000), 1), "unknown key 'xxx"),
    (changed((*FIRST, "intensity"), {"kind": "x" * 9000}), "intensity.kind = 'xxx"),
    (changed(("volume", "shape"), [1] * 9000), "volume.shape = [1, 1"),
]


@pytest.mark.parametrize(("data", "message"), BAD, ids=range(len(BAD)))
@pytest.mark.req("REQ-02")
def test_bad_scene_is_one_line_that_says_where(data, message):
    with pytest.raises(GeometryError) as caught:
        parse_scene(json.dumps(data), "g.json")
    text = str(caught.value)
    assert message in text and text.startswith("g.json: ") and "\n" not in text
    assert len(text) < 500


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not JSON"),
        ("{", "not JSON"),
        ("[1, 2]", "must be a JSON object"),
        ('{"schema": NaN}', "NaN is not a number"),
        ('{"schema": 1, "schema": 2}', "stands twice"),
        ("[" * 40000, "deep"),
        ('{"a": ' + "9" * 5000 + "}", "digits"),
        (" " * 70000, "64 KiB"),
        (json.dumps(SCENE).replace("765", "1e999", 1), "not a finite number"),
    ],
)
@pytest.mark.req("REQ-03")
def test_bad_json(text, message):
    with pytest.raises(GeometryError, match=message):
        parse_scene(text)


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(GeometryError, match=r"none\.json cannot be read"):
        load_scene(tmp_path / "none.json")
    (tmp_path / "latin1.json").write_text(json.dumps(SCENE) + "\xe4", encoding="latin-1")
    with pytest.raises(GeometryError, match="UTF-8"):
        load_scene(tmp_path / "latin1.json")
    (tmp_path / "cut.json").write_bytes(json.dumps(SCENE).encode("utf-16")[:-1])
    with pytest.raises(GeometryError, match="UTF-16"):
        load_scene(tmp_path / "cut.json")
    for encoding in ("utf-16", "utf-8-sig"):
        (tmp_path / "marked.json").write_text(json.dumps(SCENE), encoding=encoding)
        assert load_scene(tmp_path / "marked.json") == parse_scene(json.dumps(SCENE))


def test_round_trip_and_defaults():
    scene = parse_scene(json.dumps(SCENE))
    assert parse_scene(scene_to_json(scene)) == scene
    assert [v.id for v in scene.views] == ["1", "2"]
    assert scene.warnings == ()
    bare = parse_scene(json.dumps(changed(("volume",), KeyError)))
    grid = bare.volume_grid()
    assert grid.shape == (128, 128, 128)
    # A sphere that touches the default cube's faces is seen whole by every view.
    rng = np.random.default_rng(0)
    p = rng.normal(size=(2000, 3))
    p *= 0.5 * grid.size_mm[0] / np.linalg.norm(p, axis=1, keepdims=True)
    for view in bare.views:
        pixels, _ = view.carm.project(p)
        assert pixels.min() > -1.5 and pixels.max() < 512.5


def test_unusual_values_are_warned_about():
    scene = parse_scene(json.dumps(changed((*FIRST, "sod_mm"), 500)))
    assert scene.warnings == ("view 1: sod_mm = 500 mm is outside the usual 600 .. 900 mm",)


@pytest.mark.req("REQ-06")
def test_matrix_alone_is_enough():
    carm = parse_scene(json.dumps(SCENE)).views[0].carm
    data = changed(
        FIRST, {"rows": 512, "columns": 512, "projection_matrix": carm.world2pixel.tolist()}
    )
    other = parse_scene(json.dumps(data)).views[0]
    X = np.array([[10.0, 20, -30]])
    np.testing.assert_allclose(other.carm.project(X)[0], carm.project(X)[0], atol=1e-6)
    assert other.intensity == Intensity(kind="raw")


@pytest.mark.parametrize("point", [[0, 0], [511, 255], [-40, 255]])
def test_a_principal_point_at_the_edge_may_be_that_of_a_crop(point):
    scene = changed((*FIRST, "principal_point_px"), point)
    scene["volume"] = None
    grid = parse_scene(json.dumps(scene)).volume_grid()
    assert grid.size_mm[0] > 20 and grid.center_mm != (0, 0, 0)


def test_a_principal_point_without_common_space_is_named_where_no_volume_is_given():
    """Not a key that the file does not hold."""
    scene = changed((*FIRST, "principal_point_px"), [255, 5000])
    assert parse_scene(json.dumps(scene)).volume_grid().size_mm[0] > 1
    scene["volume"] = None
    with pytest.raises(GeometryError, match=r"view \d sees no space .* correct principal_point_px"):
        parse_scene(json.dumps(scene))


def matrix_view(**more):
    carm = parse_scene(json.dumps(SCENE)).views[0].carm
    own = {"rows": 512, "columns": 512, "projection_matrix": carm.world2pixel.tolist(), **more}
    return carm, changed(FIRST, own)


@pytest.mark.parametrize(
    "more",
    [
        {"detector_rotation_deg": 3},
        {"principal_point_px": [250, 250]},
        {"isocenter_offset_mm": [0, 0, 5]},
    ],
)
@pytest.mark.req("REQ-06")
def test_nothing_beside_a_lone_matrix_is_ignored(more):
    with pytest.raises(GeometryError, match="at odds with a lone projection_matrix"):
        parse_scene(json.dumps(matrix_view(**more)[1]))


CUBE = {"center_mm": (0, 0, 0), "size_mm": (64, 64, 64), "shape": (32, 32, 32)}


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("shape", (32, float("nan"), 32), "is outside 1 .. 1024 voxels"),
        ("shape", (32, float("inf"), 32), "is outside 1 .. 1024 voxels"),
        ("shape", (32, 32.5, 32), "must be 3 whole numbers"),
        ("shape", (32, 32), "must be 3 numbers of 1 .. 1024 voxels"),
        ("shape", 32, "must be 3 numbers of 1 .. 1024 voxels"),
        ("size_mm", ("64", 64, 64), "must be 3 numbers of 1 .. 2000 mm"),
        ("center_mm", (0, 0, float("nan")), "is outside -2000 .. 2000 mm"),
        ("center_mm", (0, 0, True), "must be 3 numbers of -2000 .. 2000 mm"),
    ],
)
def test_a_grid_of_no_numbers_names_its_key_and_its_range(key, value, words):
    with pytest.raises(GeometryError) as caught:
        Grid(**{**CUBE, key: value})
    assert str(caught.value) == f"volume.{key} = {value!r} {words}"


@pytest.mark.parametrize(("value", "words"), [("a", "must be a number of"), (True, "must be a"),
                                              (float("nan"), "is out"), (0, "is out")])  # fmt: skip
def test_a_scale_that_is_none_is_named_with_its_range(value, words):
    with pytest.raises(GeometryError, match=r"\.mm_per_count = .*1e-9 \.\. 1000 mm") as caught:
        Intensity(kind="raw", mm_per_count=value)
    assert f"{value!r} {words}" in str(caught.value)


def test_pixel_spacing_beside_a_lone_matrix_tells_the_detector():
    carm, data = matrix_view(pixel_spacing_mm=[0.39, 0.39])
    scene = parse_scene(json.dumps(data))
    assert scene.views[0].carm.sdd_mm == pytest.approx(carm.sdd_mm)
    assert scene.views[0].carm.magnification == pytest.approx(carm.magnification)
    assert scene.warnings == ()
    assert (
        "magnification of 1.5 is assumed" in parse_scene(json.dumps(matrix_view()[1])).warnings[0]
    )
    for bad, message in (([0.39, 0.5], "disagrees"), ([0.2, 0.2], "must exceed sod_mm")):
        with pytest.raises(GeometryError, match=message):
            parse_scene(json.dumps(matrix_view(pixel_spacing_mm=bad)[1]))


@pytest.mark.req("REQ-05")
def test_picture_of_another_size():
    carm = CArm(
        **{k: v for k, v in VIEW.items() if k not in ("intensity", "pixel_spacing_mm")},
        pixel_spacing_mm=(0.39, 0.39),
    )
    same, said = match_picture(carm, 512, 512, allow_rescale=False)
    assert same is carm and said is None
    half, said = match_picture(carm, 256, 256, allow_rescale=False)
    assert half.rows == 256 and "0.5 times" in said
    # a crop from the middle has the same shape and another scale: only the user knows
    with pytest.raises(GeometryError, match=r"512 x 512 .* 448 x 448; allow_rescale"):
        match_picture(carm, 448, 448, allow_rescale=False)
    scaled, said = match_picture(carm, 448, 448, allow_rescale=True)
    assert scaled.rows == 448 and "0.875 times" in said
    with pytest.raises(GeometryError, match="at odds"):
        match_picture(carm, 256, 512, allow_rescale=True)


#: what a JSON Schema cannot say: relations between values, and text that is not printable
BEYOND_SCHEMA = (
    "must exceed sod_mm",
    "stands twice",
    "from the source",
    "behind the detector",
    "singular",
    "skewed",
    "mirror image",
    "disagrees with",
    "mm_per_count is missing",
    "at odds with a lone",
    "sees no space that the others see",
    "2^28",
)


def schema_validator():
    jsonschema = pytest.importorskip("jsonschema")
    file = resources.files("gcar_deploy") / "geometry/geometry.schema.json"
    return jsonschema.Draft202012Validator(json.loads(file.read_text()))


def agree(validator, data):
    try:
        parse_scene(json.dumps(data))
    except GeometryError as error:
        beyond = any(text in str(error) for text in BEYOND_SCHEMA)
        assert beyond or not validator.is_valid(data), f"only the parser refuses: {error}"
    else:
        validator.validate(data)


@pytest.mark.slow
@pytest.mark.req("REQ-04")
def test_schema_file_says_the_same():
    validator = schema_validator()
    validator.validate(SCENE)
    for data, _ in BAD:
        agree(validator, data)
    agree(validator, matrix_view()[1])
    agree(validator, matrix_view(pixel_spacing_mm=[0.39, 0.39])[1])


PATHS = [
    *[(key,) for key in ("schema", "frame", "views", "volume", "more")],
    *[("volume", key) for key in ("center_mm", "size_mm", "shape", "more")],
    *[
        (*FIRST, key)
        for key in (
            *VIEW,
            "id",
            "detector_rotation_deg",
            "principal_point_px",
            "isocenter_offset_mm",
            "projection_matrix",
            "more",
        )
    ],
    *[(*FIRST, "intensity", key) for key in ("kind", "polarity", "mm_per_count", "more")],
]
SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 1200),
    st.floats(-1e4, 1e4),
    st.sampled_from([0, 90, 180, 360.5, 512.0, 1e300, 10**400, "raw", "dark", "LPS", ""]),
)
VALUES = st.one_of(
    SCALARS,
    st.lists(SCALARS, max_size=4),
    st.lists(st.floats(0.02, 500), min_size=2, max_size=3),
    st.lists(st.integers(1, 300), min_size=3, max_size=3),
    st.dictionaries(st.sampled_from(["kind", "polarity", "mm_per_count"]), SCALARS),
)


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(st.sampled_from(PATHS), st.one_of(VALUES, st.just(KeyError)))
@pytest.mark.req("REQ-04")
def test_schema_and_parser_agree_on_any_change(path, value):
    data = copy.deepcopy(SCENE)
    data["views"][0]["intensity"]["mm_per_count"] = None
    data["views"][0].update(id="a", detector_rotation_deg=0, principal_point_px=None)
    data["views"][0].update(isocenter_offset_mm=None, projection_matrix=None)
    at = data
    for key in path[:-1]:
        at = at[key]
    if value is KeyError:
        at.pop(path[-1], None)
    else:
        at[path[-1]] = value
    agree(schema_validator(), data)


@settings(max_examples=60, deadline=None)
@given(st.text(max_size=60))
@pytest.mark.req("REQ-03")
def test_any_text_is_refused_in_one_line(text):
    with pytest.raises(GeometryError) as caught:
        parse_scene(text)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


@pytest.mark.req("REQ-01")
def test_row_spacing_comes_first():
    """Order (row, column) as in DICOM: the second number is the pitch along a row."""
    data = copy.deepcopy(SCENE)
    data["views"][0]["pixel_spacing_mm"] = [0.2, 0.4]
    carm = parse_scene(json.dumps(data)).views[0].carm
    f_col, f_row = carm.focal_px
    assert f_col == pytest.approx(carm.sdd_mm / 0.4)
    assert f_row == pytest.approx(carm.sdd_mm / 0.2)


def test_a_default_volume_may_reach_behind_the_detector():
    """A projection matrix does not tell where that is: both ways of telling must agree."""
    near = changed((*FIRST, "sdd_mm"), SCENE["views"][0]["sod_mm"] + 60)
    with pytest.raises(GeometryError, match="behind the detector"):
        parse_scene(json.dumps(near))
    near["volume"] = None
    assert parse_scene(json.dumps(near)).volume_grid().size_mm[0] > 120 / np.sqrt(3)

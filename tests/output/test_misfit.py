"""A damaged result.json is one line that names it, whichever value was lost."""

from __future__ import annotations

import json
import shutil
from importlib import resources

import pytest

from gcar_deploy.output.misfit import misfit
from tests.cli.conftest import gcar

jsonschema = pytest.importorskip("jsonschema", reason="needs the test extra")

#: what a value is replaced by
ODD = ("null", "7", "[]")


def schema():
    return json.loads(
        resources.files("gcar_deploy.output").joinpath("result.schema.json").read_text()
    )


def places(value, place=()):
    """Every place of a JSON value, one item of each list."""
    for key in value if isinstance(value, dict) else range(min(len(value), 1)):
        yield (*place, key)
        if isinstance(value[key], (dict, list)):
            yield from places(value[key], (*place, key))


def changed(value, place, odd):
    """A copy with another value there; None takes it away."""
    out = json.loads(json.dumps(value))
    at = out
    for key in place[:-1]:
        at = at[key]
    if odd is None:
        del at[place[-1]]
    else:
        at[place[-1]] = json.loads(odd)
    return out


def of_kind(error):
    """Whether an error is one of type or count; of ``oneOf`` where all branches have one."""
    if error.validator != "oneOf":
        return error.validator in ("type", "minItems", "maxItems")
    wrong = {e.schema_path[0] for e in error.context if of_kind(e)}
    return len(wrong) == len(error.validator_value)


@pytest.fixture
def told(folder):
    """A result as written, named: names are the tree's own and need not be there."""
    found = json.loads((folder / "result.json").read_text())
    found["tree"]["branches"][0].update(name="LAD", name_confidence=0.93)
    ghost = {"branch": 1, "start_mm": 1, "end_mm": 2, "middle_mm": [0, 0, 0], "probability": 0.7}
    found["ambiguity"]["probable_ghosts"] = [ghost]
    return found


@pytest.mark.slow
def test_kinds_are_found_as_jsonschema_finds_them(told):
    checker = jsonschema.Draft202012Validator(schema())
    count = 0
    assert misfit(told, schema()) is None
    for place in places(told):
        for odd in ODD:
            wrong = changed(told, place, odd)
            found = [e for e in checker.iter_errors(wrong) if of_kind(e)]
            where = misfit(wrong, schema())
            assert (where is None) == (not found), (place, odd)
            if found:
                pointers = ["/" + "/".join(map(str, e.absolute_path)) for e in found]
                assert where in pointers, (place, odd)
                count += 1
    assert count > 200


@pytest.mark.parametrize(
    ("place", "odd", "says"),
    [
        (("counts",), None, "'counts' is missing"),
        (("seconds",), None, "'seconds' is missing"),
        (("versions",), None, "'versions' is missing"),
        (("use",), None, "'use' is missing"),
        (("tree", "branches", 0, "name_confidence"), None, "'name_confidence' is missing"),
        (("tree", "branches", 0, "name_confidence"), "null", "a value is of another kind"),
        (("files",), "null", "/files is of another kind"),
        (("files", "surface.stl", "sha256"), None, "'sha256' is missing"),
        (("ambiguity",), "null", "/ambiguity is of another kind"),
        (("ambiguity", "probable_ghosts"), "null", "/ambiguity/probable_ghosts is of another kind"),
    ],
)
def test_info_names_the_key(told, folder, tmp_path, place, odd, says):
    copy = shutil.copytree(folder, tmp_path / "result")
    (copy / "result.json").write_text(json.dumps(changed(told, place, odd)))
    done = gcar("info", copy)
    assert done.code == 2 and done.out == "" and done.err.count("\n") == 1
    assert f"{copy / 'result.json'} is not as gcar wrote it: {says}" in done.err


@pytest.mark.parametrize(
    ("place", "odd", "says"),
    [
        (("status",), None, "'status' is missing"),
        (("ambiguity", "probable_ghosts", 0, "probability"), None, "'probability' is missing"),
        (("ambiguity", "probable_ghosts"), "null", "/ambiguity/probable_ghosts is of another kind"),
        (("files",), "null", "/files is of another kind"),
    ],
)
def test_flow_names_the_key(told, folder, tmp_path, place, odd, says):
    copy = shutil.copytree(folder, tmp_path / "result")
    (copy / "result.json").write_text(json.dumps(changed(told, place, odd)))
    done = gcar("flow", copy)
    assert done.code == 2 and done.out == "" and done.err.count("\n") == 1
    assert f"{copy / 'result.json'} is not as gcar wrote it: {says}" in done.err


def test_no_damage_is_an_internal_error(told, folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "result")
    ends = set()
    for place in places(told):
        if place[0] in ("options", "reasons", "volume", "losses") or "geometry" in place:
            continue
        for odd in (None, "null", "7"):
            (copy / "result.json").write_text(json.dumps(changed(told, place, odd)))
            done = gcar("info", copy)
            ends.add(done.code)
            assert done.code in (0, 2), (place, odd, done.err)
    assert ends == {0, 2}
    deep = json.dumps(told)[:-1] + ', "more": ' + "[" * 3000 + "]" * 3000 + "}"
    (copy / "result.json").write_text(deep)
    assert gcar("info", copy).code in (0, 2)
    (copy / "result.json").write_text(json.dumps(told).replace("0.93", "NaN"))
    done = gcar("info", copy, "--json")
    assert done.code == 2 and "result.json is no JSON: it holds NaN" in done.err

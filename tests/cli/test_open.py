"""gcar open: what it is given, before any page is served."""

from __future__ import annotations

import json
import shutil

import pytest

from gcar_deploy.cli.open import _first
from gcar_deploy.data.demo_case import demo_case
from gcar_deploy.errors import ImageError, UsageError
from gcar_deploy.inputs.order import Order
from gcar_deploy.workbench.desk import Desk


@pytest.fixture
def desk(tmp_path):
    return Desk(tmp_path / "cases")


def test_a_folder_of_pictures_is_a_case_in_the_order_of_their_numbers(desk, tmp_path):
    case = demo_case()
    for name, path in zip(("view10.png", "view9.png"), case.pictures, strict=True):
        shutil.copy(path, tmp_path / name)
    (tmp_path / "notes.txt").write_text("none")
    geometry = json.loads(case.geometry.read_text())
    geometry["views"].reverse()
    (tmp_path / "geom.json").write_text(json.dumps(geometry))
    name, shelved = _first(desk, Order(views=(tmp_path,)))
    opened = desk.case(name)
    assert shelved is None and opened.described()["problem"] is None
    assert [path.name for path in opened.order.views] == ["view9.png", "view10.png"]


def test_a_result_is_its_case_and_another_beside_it_is_a_report(desk, tmp_path):
    case = desk.demo()
    for name in ("result", "kept"):
        (case.folder / name).mkdir()
        (case.folder / name / "report.html").write_text("a page")
    other = Desk(tmp_path / "others")
    assert _first(other, Order(views=(case.folder / "result",))) == (case.id, None)
    name, shelved = _first(other, Order(views=(case.folder / "kept",)))
    assert name is None and other.file(shelved, "report.html")[0] == case.folder / "kept"


def test_what_is_no_case_is_said(desk, tmp_path):
    with pytest.raises(ImageError, match="nowhere: no such file or folder"):
        _first(desk, Order(views=(tmp_path / "nowhere",)))
    with pytest.raises(UsageError, match=r"no case .*, no result .* and no pictures"):
        _first(desk, Order(views=(tmp_path,)))
    assert not desk.cases

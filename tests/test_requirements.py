"""The table of requirements, its marks, and the judge of the full run."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.requirements import TABLE, TESTS, marks, problems, read_table, written

pytest_plugins = ["pytester"]
ROOT = Path(__file__).parents[1]

TABLE_TEXT = """| name | requirement | tests |
|---|---|---|
| REQ-01 | shown | |
| REQ-02 | failing | |
| REQ-03 | skipped | |
"""
TEST_TEXT = """
import pytest
@pytest.mark.req("REQ-01")
def test_shown(): pass
@pytest.mark.req("REQ-02")
def test_failing(): {two}
@pytest.mark.req("REQ-03")
def test_skipped(): pytest.skip("no data")
"""


def test_table_and_marks_agree():
    assert problems() == [], "python -m tests.requirements --write"
    assert len(read_table(TABLE)) >= 40


def test_every_row_is_told_apart():
    texts = [row.text for row in read_table(TABLE)]
    assert len(set(texts)) == len(texts) and all(texts)


def test_writing_fills_the_last_column_alone():
    text = written(TABLE_TEXT, {"REQ-01": ["a.py::test_b"]})
    assert "| REQ-01 | shown | `a.py::test_b` |" in text
    assert written(text, {"REQ-01": ["a.py::test_b"]}) == text
    assert read_table(TABLE)[0].tests.startswith("`")
    assert marks(TESTS)["REQ-01"] == sorted(marks(TESTS)["REQ-01"])


@pytest.fixture
def project(pytester, monkeypatch):
    """A small project with the plugin and a table of three requirements."""
    # Other plugins are not asked, and take a second each to load.
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    table = pytester.path / "requirements.md"
    table.write_text(TABLE_TEXT)
    pytester.makeini("[pytest]\ntestpaths = tests\nmarkers =\n    req(*names): requirements\n")
    pytester.mkdir("tests")
    (pytester.path / "tests" / "conftest.py").write_text(f"""
import sys
from pathlib import Path
sys.path.insert(0, {str(ROOT)!r})
from tests import requirements_plugin as plugin
plugin.TABLE = Path({str(table)!r})
def pytest_configure(config):
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(plugin.RequirementsPlugin(config))
def pytest_collection_modifyitems(items):
    plugin.name_requirements(items)
""")

    def write(two: str) -> None:
        (pytester.path / "tests" / "test_three.py").write_text(TEST_TEXT.format(two=two))

    return write


@pytest.mark.parametrize(
    "workers",
    [(), pytest.param(("-p", "xdist", "-n", "2"), marks=pytest.mark.slow)],
    ids=["alone", "xdist"],
)
def test_a_skipped_requirement_is_told_and_a_missing_one_fails(project, pytester, workers):
    project("pass")
    done = pytester.runpytest_subprocess("-p", "no:cacheprovider", *workers)
    assert done.ret == 0
    done.stdout.fnmatch_lines(["*tests skipped of REQ-03*"])
    file = pytester.path / "tests" / "test_three.py"
    file.write_text(file.read_text().replace('@pytest.mark.req("REQ-02")', ""))
    done = pytester.runpytest_subprocess("-p", "no:cacheprovider", *workers)
    assert done.ret == 1
    done.stdout.fnmatch_lines(["*no passing test for REQ-02*"])


def test_a_part_checks_nothing(project, pytester):
    project("pass")
    for part in (("-k", "shown"), ("-m", "not req"), ("tests/test_three.py::test_shown",)):
        done = pytester.runpytest_subprocess("-p", "no:cacheprovider", *part)
        assert "no passing test" not in done.stdout.str()

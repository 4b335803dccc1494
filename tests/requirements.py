"""The table of requirements: which tests show which.

``python -m tests.requirements`` checks docs/requirements.md against the marks in tests/;
``--write`` fills its last column anew. Marks are read off the source, nothing is run.
"""

from __future__ import annotations

import ast
import dataclasses
import re
import sys
from collections import defaultdict
from pathlib import Path

import click

ROOT = Path(__file__).parents[1]
TABLE = ROOT / "docs" / "requirements.md"
TESTS = ROOT / "tests"
_ROW = re.compile(r"^\| (REQ-\d\d) \| (.+?) \|\s*(.*?)\s*\|$")


@dataclasses.dataclass(frozen=True)
class Requirement:
    """One row: its name, what is required, the tests that the table lists."""

    name: str
    text: str
    tests: str


def read_table(path: Path) -> list[Requirement]:
    """Return the rows of the table in their order."""
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines():
        match = _ROW.match(line)
        if match:
            rows.append(Requirement(*match.groups()))
    return rows


def marks(folder: Path) -> dict[str, list[str]]:
    """Return requirement -> its marked tests, as ``file::name`` relative to tests/, sorted."""
    found: dict[str, list[str]] = defaultdict(list)
    for path in sorted(folder.rglob("test_*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in tree.body:
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test"):
                for name in _names(node.decorator_list):
                    found[name].append(f"{path.relative_to(folder).as_posix()}::{node.name}")
    return {name: sorted(tests) for name, tests in found.items()}


def _names(decorators: list[ast.expr]) -> list[str]:
    out = []
    for decorator in decorators:
        if isinstance(decorator, ast.Call) and ast.unparse(decorator.func) == "pytest.mark.req":
            out += [a.value for a in decorator.args if isinstance(a, ast.Constant)]
    return out


def written(text: str, found: dict[str, list[str]]) -> str:
    """Return the table's text with its last column filled from the marks."""
    lines = []
    for line in text.splitlines():
        match = _ROW.match(line)
        if match:
            tests = ", ".join(f"`{test}`" for test in found.get(match[1], []))
            line = f"| {match[1]} | {match[2]} | {tests} |"
        lines.append(line)
    return "\n".join(lines) + "\n"


def problems(path: Path = TABLE, folder: Path = TESTS) -> list[str]:
    """Return what is wrong between table and marks, as sentences."""
    rows, found = read_table(path), marks(folder)
    names = [row.name for row in rows]
    out = [f"{name} stands twice" for name in sorted(set(names)) if names.count(name) > 1]
    out += [f"{name} has no test" for name in names if name not in found]
    out += [f"{name} is marked in {found[name][0]} but not in the table"
            for name in sorted(set(found) - set(names))]  # fmt: skip
    text = path.read_text(encoding="utf-8")
    if written(text, found) != text:
        out.append(f"{path.name} is not as --write would leave it")
    return out


@click.command()
@click.option("--write", is_flag=True, help="Fill the last column anew.")
def main(write: bool) -> None:
    """Check the table of requirements against the marks of the tests."""
    if write:
        text = TABLE.read_text(encoding="utf-8")
        TABLE.write_text(written(text, marks(TESTS)), encoding="utf-8")
    found = problems()
    for problem in found:
        click.echo(problem)
    click.echo(f"{len(read_table(TABLE))} requirements, {len(found)} problems")
    sys.exit(bool(found))


if __name__ == "__main__":
    main()

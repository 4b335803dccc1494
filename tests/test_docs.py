"""The documentation is there, true to the commands, and its example runs."""

from __future__ import annotations

import re
import shlex
import shutil
import sys
from pathlib import Path

import click
import pytest

from tests.cli.conftest import good_case  # noqa: F401 - a fixture

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def tool():
    sys.path.insert(0, str(ROOT))
    try:
        from gcar_export.cli import command_reference
    finally:
        sys.path.remove(str(ROOT))
    return command_reference


def test_the_command_reference_is_up_to_date(tool):
    """Otherwise: python -m gcar_export.cli.command_reference."""
    assert (DOCS / "commands.md").read_text(encoding="utf-8") == tool.reference()


def test_every_verb_and_option_is_documented(tool):
    page = (DOCS / "commands.md").read_text(encoding="utf-8")
    sections = dict(re.findall(r"^##+ `(.+?)`\n(.*?)(?=^##+ `|\Z)", page, re.MULTILINE | re.DOTALL))
    seen = 0
    for name, command in tool.commands():
        assert name in sections, name
        assert (command.help or "").strip(), f"{name} has no help"
        for option in command.params:
            if isinstance(option, click.Option) and not option.hidden:
                assert all(f"`{o}`" in sections[name] for o in option.opts), (name, option.opts)
                assert option.help or name.startswith("gcar-export"), (name, option.opts)
                seen += 1
    assert seen > 50


def pages():
    return sorted(DOCS.glob("*.md"))


@pytest.mark.parametrize("page", pages(), ids=lambda p: p.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
        assert "://" in target or (page.parent / target).exists(), target


def test_the_demo_promises_no_table(tool):
    """One line compares its tree with the truth; ``gcar bench`` has the table."""
    help_of = {name: command.help or "" for name, command in tool.commands()}
    told = " ".join(help_of["gcar demo"].split())
    assert "a line says how well the tree and the truth" in told and "table" not in told


def test_every_exit_code_is_explained():
    from gcar_deploy import errors

    page = (DOCS / "troubleshooting.md").read_text(encoding="utf-8")
    codes = {
        value.exit_code
        for value in vars(errors).values()
        if isinstance(value, type) and issubclass(value, errors.GcarError)
    }
    for code in (0, *codes):
        assert re.search(rf"^\| {code} \|", page, re.MULTILINE), code
    assert "130, 143" in page


def test_confidence_is_called_a_score_and_no_probability():
    """Most points of 0.2 to 0.4 are right; what is calibrated is ``ghost_probability``."""
    row = re.search(
        r"^\| confidence \|.*$", (DOCS / "glossary.md").read_text("utf-8"), re.MULTILINE
    )
    schema = (ROOT / "gcar_deploy" / "output" / "result.schema.json").read_text(encoding="utf-8")
    told = re.findall(r'"confidence": \{\s+"description": "(.+?)"', schema)
    for said in (row[0] if row else "", *told):
        assert "score" in said and "no probability" in said and "ghost_probability" in said, said
    assert len(told) == 1


def test_pictures_are_small():
    sizes = {p.name: p.stat().st_size for p in (DOCS / "pictures").iterdir()}
    assert max(sizes.values()) < 200_000 and sum(sizes.values()) < 1_000_000


def test_the_host_guide_names_every_argument_of_a_call():
    import inspect

    from gcar_deploy.engine import Engine

    page = (DOCS / "host-guide.md").read_text(encoding="utf-8")
    table = page[page.index("| argument | meaning |") :].split("\n\n")[0]
    said = re.findall(r"^\| `(\w+)", table, re.MULTILINE)
    assert said == list(inspect.signature(Engine.reconstruct).parameters)[1:]


@pytest.mark.slow
def test_the_python_host_runs_as_printed(good_case, tmp_path, monkeypatch, capsys):  # noqa: F811
    code = re.findall(
        r"```python\n(.*?)```", (DOCS / "host-guide.md").read_text("utf-8"), re.DOTALL
    )
    for file in good_case.iterdir():
        shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    exec(compile(code[0], "host-guide.md", "exec"), {})  # noqa: S102
    assert (tmp_path / "result" / "report.html").is_file()
    assert "mm" in capsys.readouterr().out


def test_the_geometry_page_states_the_formulae_in_use():
    from gcar_deploy.geometry.carm import CArm

    carm = CArm(
        primary_angle_deg=30, secondary_angle_deg=25, sod_mm=750, sdd_mm=1050, rows=512,
        columns=512, pixel_spacing_mm=(0.2, 0.2),
    )  # fmt: skip
    pixels, depth = carm.project([[10.0, -20.0, 30.0]])
    stated = f"pixel ({pixels[0, 0]:.3f}, {pixels[0, 1]:.3f}) at depth {depth[0]:.3f} mm"
    assert stated in (DOCS / "geometry.md").read_text(encoding="utf-8")


def printed():
    """Commands as documents print them, between backticks or indented, without placeholders."""
    files = [*pages(), ROOT / "README.md", ROOT / "models" / "MODEL_CARD.md"]
    lines = set()
    for page in files:
        text = page.read_text(encoding="utf-8")
        lines |= set(re.findall(r"`(gcar(?:-export)? [^`]+)`", text.replace("\n", " ")))
        lines |= set(re.findall(r"^    (gcar(?:-export)? .+)$", text, re.MULTILINE))
    return sorted(line.split("  #")[0].strip() for line in lines)


def test_commands_that_documents_print_are_taken(tool):
    """But for their files, which nobody has here."""
    known = dict(tool.commands())
    asked = 0
    for line in printed():
        words = shlex.split(line)
        depth = next((n for n in (3, 2) if " ".join(words[:n]) in known), 0)
        name = " ".join(words[:depth])
        # Placeholders are dots, bars or one capital.
        if not 0 < depth < len(words) or re.search(r"\.\.\.|\|| [A-Z]( |$)", line):
            continue
        asked += 1
        try:
            known[name].make_context(name, words[depth:])
        except click.exceptions.Exit:  # help was asked for
            continue
        except click.UsageError as error:
            said = error.format_message()
            assert re.search(r"does not exist|Missing (argument|option)|requires an arg", said), (
                line,
                said,
            )
    assert asked > 60

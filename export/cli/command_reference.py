"""docs/commands.md from the commands: ``python -m gcar_export.cli.command_reference``."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import click

PAGE = Path(__file__).resolve().parents[2] / "docs" / "commands.md"
_HEAD = """# Commands

Made from the commands by `python -m gcar_export.cli.command_reference`; do not edit.
Exit codes are explained in [troubleshooting.md](troubleshooting.md).
"""


def commands() -> Iterator[tuple[str, click.Command]]:
    """Yield every verb of both commands with its full name, groups before what they hold."""
    from gcar_deploy.cli.main import gcar
    from gcar_export.cli.main import main as workshop

    for name, group in (("gcar", gcar), ("gcar-export", workshop)):
        yield from _walk(name, group)


def reference() -> str:
    """Return the page as Markdown."""
    parts = [_HEAD]
    for name, command in commands():
        level = "##" if " " not in name else "###"
        parts.append(f"{level} `{name}`\n\n{_text(command)}\n")
        rows = [_row(p) for p in command.params if not getattr(p, "hidden", False)]
        if rows:
            parts.append("| argument or option | meaning | default |\n|---|---|---|\n")
            parts[-1] += "\n".join(rows) + "\n"
    return "\n".join(parts)


def _walk(name: str, command: click.Command) -> Iterator[tuple[str, click.Command]]:
    yield name, command
    if isinstance(command, click.Group):
        context = click.Context(command, info_name=name)
        for verb in command.list_commands(context):
            found = command.get_command(context, verb)
            if found is not None:
                yield from _walk(f"{name} {verb}", found)


def _text(command: click.Command) -> str:
    """Help of a command; paragraphs that keep their lines (click's backspace) become code."""
    out = []
    text = "\n\n".join(part.strip("\n") for part in (command.help, command.epilog) if part)
    for paragraph in text.split("\n\n"):
        lines = [line.rstrip() for line in paragraph.strip("\n").splitlines()]
        if lines and lines[0].strip() == "\b":
            title, *rest = lines[1:]
            code = "\n".join(line.strip() for line in rest).strip()
            out.append(f"{title.strip()}\n\n```\n{code}\n```")
        else:
            out.append(" ".join(line.strip() for line in lines).strip())
    return "\n\n".join(out)


def _row(parameter: click.Parameter) -> str:
    if isinstance(parameter, click.Argument):
        cells = [f"`{parameter.metavar or (parameter.name or '').upper()}`", "", ""]
        return "| " + " | ".join(cells) + " |"
    option = parameter
    names = ", ".join(f"`{name}`" for name in (*option.opts, *option.secondary_opts))
    kind = _kind(option)
    text = (getattr(option, "help", None) or "").replace("|", "\\|")
    required = "required" if option.required else ""
    told = getattr(option, "show_default", None)
    default = told if isinstance(told, str) else option.default
    shown = (
        f"`{default}`"
        if isinstance(default, (str, int, float))
        and not isinstance(default, bool)
        and default != ""
        else required
    )
    return f"| {names}{kind} | {text} | {shown} |"


def _kind(option: click.Parameter) -> str:
    if getattr(option, "is_flag", False):
        return ""
    if isinstance(option.type, click.Choice):
        return " " + " / ".join(f"`{choice}`" for choice in option.type.choices)
    if isinstance(option.type, (click.IntRange, click.FloatRange)):
        return f" {_range(option.type)}"
    metavar = option.metavar or option.type.name.upper()
    return f" {metavar}".replace("|", "\\|")


def _range(kind: click.IntRange | click.FloatRange) -> str:
    """Name a number by its kind and what is taken."""
    name = "INTEGER" if isinstance(kind, click.IntRange) else "FLOAT"
    if kind.min is None and kind.max is None:
        return name
    if kind.max is None:
        return f"{name} {'above' if kind.min_open else 'from'} {kind.min}"
    if kind.min is None:
        return f"{name} up to {kind.max}"
    return f"{name} {kind.min} .. {kind.max}"


def main(arguments: list[str]) -> int:
    """Write the page; with ``--check`` only say whether it is as it should be."""
    page = reference()
    if "--check" in arguments:
        same = PAGE.is_file() and PAGE.read_text(encoding="utf-8") == page
        click.echo(f"{PAGE}: {'as it should be' if same else 'out of date'}")
        return 0 if same else 1
    PAGE.write_text(page, encoding="utf-8")
    click.echo(PAGE)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

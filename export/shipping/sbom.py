"""Bill of materials (CycloneDX) and the table of third-party software, from what is installed.

``python -m gcar_export.shipping.sbom --out sbom.json`` writes the bill of this environment;
``python -m gcar_export.shipping.sbom --third-party`` prints the table of THIRD_PARTY.md.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import click
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
_CLASSIFIER = "License :: OSI Approved :: "
_EXTRA = re.compile(r"extra\s*==")


def direct() -> dict[str, list[str]]:
    """Distribution -> the parts of gcar that ask for it: ``runtime`` or names of extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found: dict[str, list[str]] = {}
    parts = {"runtime": project["dependencies"], **project["optional-dependencies"]}
    for part, requirements in parts.items():
        for text in requirements:
            name = Requirement(text).name.lower()
            if name != "gcar":
                found.setdefault(name, []).append(part)
    return found


def closure(names: list[str]) -> dict[str, metadata.Distribution]:
    """Everything installed that ``names`` need, by normalised name; what is absent is left out."""
    found: dict[str, metadata.Distribution] = {}
    waiting = list(names)
    while waiting:
        name = _normal(waiting.pop())
        if name in found:
            continue
        try:
            distribution = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            continue
        found[name] = distribution
        waiting += list(_needs(distribution))
    return dict(sorted(found.items()))


def licence(distribution: metadata.Distribution) -> str:
    """Licence as the distribution states it: SPDX expression, classifier, or its own words."""
    head: Any = distribution.metadata  # an email.message.Message, which the stubs do not say
    stated = head.get("License-Expression")
    if stated:
        return str(stated)
    classified = [c.removeprefix(_CLASSIFIER) for c in head.get_all("Classifier") or []
                  if c.startswith(_CLASSIFIER)]  # fmt: skip
    words = (head.get("License") or "").strip().splitlines()
    short = words[0] if words and len(words[0]) <= 60 else ""
    return ", ".join(classified) or short or "see its own files"


def bill(names: list[str]) -> Any:
    """Return the CycloneDX bill of gcar and of everything that ``names`` need."""
    from cyclonedx.contrib.license.factories import LicenseFactory
    from cyclonedx.model.bom import Bom
    from cyclonedx.model.component import Component, ComponentType
    from packageurl import PackageURL

    licences = LicenseFactory()

    def component(distribution: metadata.Distribution, kind: ComponentType) -> Component:
        name, version = distribution.metadata["Name"], distribution.version
        return Component(
            type=kind,
            name=name,
            version=version,
            bom_ref=f"{_normal(name)}@{version}",
            purl=PackageURL("pypi", None, _normal(name), version),
            licenses=[licences.make_from_string(licence(distribution))],
        )

    out = Bom()
    root = component(metadata.distribution("gcar"), ComponentType.APPLICATION)
    out.metadata.component = root
    installed = closure(names)
    parts = {name: component(d, ComponentType.LIBRARY) for name, d in installed.items()}
    for part in parts.values():
        out.components.add(part)
    out.register_dependency(root, [parts[_normal(n)] for n in names if _normal(n) in parts])
    for name, distribution in installed.items():
        needed = [parts[_normal(n)] for n in _needs(distribution) if _normal(n) in parts]
        out.register_dependency(parts[name], needed)
    return out


def as_json(made: Any) -> str:
    """Return a bill as text, checked against the CycloneDX schema."""
    from cyclonedx.output.json import JsonV1Dot6
    from cyclonedx.schema import SchemaVersion
    from cyclonedx.validation.json import JsonStrictValidator

    text: str = JsonV1Dot6(made).output_as_string(indent=1)
    wrong = JsonStrictValidator(SchemaVersion.V1_6).validate_str(text)
    if wrong is not None:
        raise ValueError(f"not a valid bill: {wrong}")
    return text + "\n"


def third_party() -> str:
    """Return the table of direct dependencies: name, version here, licence, who asks for it."""
    lines = ["| software | version here | licence | needed by |", "|---|---|---|---|"]
    for name, parts in sorted(direct().items()):
        try:
            found = metadata.distribution(name)
            version, terms = found.version, licence(found)
        except metadata.PackageNotFoundError:
            version, terms = "not installed", "see its own files"
        lines.append(f"| {name} | {version} | {terms} | {', '.join(parts)} |")
    return "\n".join(lines)


def _needs(distribution: metadata.Distribution) -> Iterator[str]:
    for text in distribution.requires or []:
        requirement = Requirement(text)
        marker = requirement.marker
        # An extra of a dependency is nobody's need unless it was asked for.
        if marker is None or (not _EXTRA.search(str(marker)) and marker.evaluate()):
            yield requirement.name


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


@click.command()
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), help="Write the bill there."
)
@click.option("--extras", default="", help="Extras beside the runtime, comma-separated.")
@click.option("--third-party", "table", is_flag=True, help="Print the table instead.")
def main(out: Path | None, extras: str, table: bool) -> None:
    """Write the bill of materials of this environment."""
    if table:
        click.echo(third_party())
        return
    wanted = {"runtime", *extras.split(",")}
    names = [name for name, parts in direct().items() if wanted & set(parts)]
    text = as_json(bill(names))
    if out is None:
        click.echo(text, nl=False)
        return
    try:
        with out.open("x", encoding="utf-8") as stream:
            stream.write(text)
    except OSError as error:
        click.echo(f"error: {out}: {error.strerror}", err=True)
        sys.exit(2)
    click.echo(f"{out}: {text.count(chr(10))} lines, {len(closure(names))} components")


if __name__ == "__main__":
    main()

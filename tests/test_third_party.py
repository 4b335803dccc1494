"""Other people's software: listed with its licence, and in a bill of materials."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.req("REQ-47")
def test_every_direct_dependency_is_listed_with_its_licence():
    """By name: versions move on, and a fresh installation may have newer ones."""
    from gcar_export.shipping.sbom import direct

    text = (ROOT / "THIRD_PARTY.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| ([\w.-]+) \| [^|]+ \| ([^|]+) \|", text, flags=re.MULTILINE))
    for name in direct():
        assert rows.get(name, "").strip(), (
            f"{name}: python -m gcar_export.shipping.sbom --third-party"
        )


@pytest.mark.parametrize("page", ["THIRD_PARTY.md", "models/MODEL_CARD.md", "docs/export-guide.md"])
def test_the_terms_of_the_segmenter_and_of_its_real_pictures_are_told_alike(page):
    """Weights are Apache-2.0 as its spec says; the real pictures they saw are BSD-3-Clause."""
    spec = json.loads((ROOT / "models" / "segmenter.json").read_text(encoding="utf-8"))
    assert spec["license"].startswith("Apache-2.0") and "real ones" in spec["license"]
    lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
    told = [" ".join(lines[k : k + 2]) for k, line in enumerate(lines) if "BSD-3-Clause" in line]
    real = ("pictures", "real angiograms")
    assert any("Apache-2.0" in line and any(word in line for word in real) for line in told)


def test_no_model_that_saw_real_pictures_is_called_generated_alone():
    data = (ROOT / "THIRD_PARTY.md").read_text(encoding="utf-8").split("| data in this")[1]
    for spec in sorted((ROOT / "models").glob("*.json")):
        training = json.loads(spec.read_text(encoding="utf-8"))["training"]
        (row,) = (line for line in data.splitlines() if f"`models/{spec.stem}`" in line)
        assert ("alone" in row) == ("crops of real" not in str(training)), spec.stem


@pytest.mark.slow
@pytest.mark.req("REQ-47")
def test_bill_of_materials_is_valid():
    pytest.importorskip("cyclonedx", reason="needs cyclonedx-python-lib")
    from gcar_export.shipping.sbom import as_json, bill, direct

    runtime = [name for name, parts in direct().items() if "runtime" in parts]
    found = json.loads(as_json(bill(runtime)))
    assert found["bomFormat"] == "CycloneDX"
    assert found["metadata"]["component"]["name"] == "gcar"
    names = {part["name"].lower() for part in found["components"]}
    assert {name.replace("_", "-") for name in runtime} <= {n.replace("_", "-") for n in names}
    assert all(part["version"] and part["licenses"] for part in found["components"])
    root = found["metadata"]["component"]["bom-ref"]
    needs = {entry["ref"]: entry.get("dependsOn", []) for entry in found["dependencies"]}
    assert len(needs[root]) == len(runtime)

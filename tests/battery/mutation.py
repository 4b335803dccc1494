"""Put deliberate bugs into a copy of the project and require that named tests notice them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import click

from tests.battery.mutants import MUTANTS, Mutant

_ROOT = Path(__file__).parents[2]
#: folder in the repository -> name that it is imported by
_FOLDERS = {
    "gcar_deploy": "gcar_deploy", "export": "gcar_export", "models": "gcar_models",
    "tests": "tests",
}  # fmt: skip
#: pytest's exit codes of "all passed" and "some failed"; others mean that nothing was tested
_PASSED, _FAILED = 0, 1


def mutation(only: tuple[str, ...] = ()) -> int:
    """Try every bug; return how many were not caught (or could not be put in)."""
    mutants = [m for m in MUTANTS if not only or any(word in m.name for word in only)]
    missed: list[str] = []
    with tempfile.TemporaryDirectory(prefix="gcar-mutants-") as name:
        copy = Path(name)
        _copy(copy)
        if not _is_used(copy):
            click.echo("the copy is not what Python imports: nothing can be said")
            return len(mutants)
        tests = sorted({test for mutant in mutants for test in mutant.tests})
        without = _pytest(copy, tests)
        if without.returncode != _PASSED:
            click.echo(f"{without.stdout[-2000:]}\nthe tests fail without any bug")
            return len(mutants)
        with click.progressbar(mutants, label="mutation", file=sys.stderr) as bar:
            for mutant in bar:
                said = _tried(copy, mutant)
                click.echo(f"{said:10s} {mutant.name} ({mutant.file})")
                missed += [] if said == "caught" else [mutant.name]
    click.echo(f"{len(mutants) - len(missed)} of {len(mutants)} deliberate bugs caught")
    click.echo(f"findings: {len(missed)}")
    return len(missed)


def _copy(folder: Path) -> None:
    """Lay the packages out under the names that they are imported by."""
    skip = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for source, target in _FOLDERS.items():
        shutil.copytree(_ROOT / source, folder / target, ignore=skip)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(_ROOT / name, folder / name)


def _is_used(copy: Path) -> bool:
    code = "import gcar_deploy, gcar_export; print(gcar_deploy.__file__, gcar_export.__file__)"
    said = _python(copy, "-c", code)
    return all(str(copy) in word for word in said.stdout.split()) and said.returncode == 0


def _tried(copy: Path, mutant: Mutant) -> str:
    """Put the bug in, run its tests, take it out again."""
    source = mutant.file.split("/", 1)
    file = copy / _FOLDERS[source[0]] / source[1]
    good = file.read_text(encoding="utf-8")
    if mutant.old not in good:
        return "NOT FOUND"
    file.write_text(good.replace(mutant.old, mutant.new), encoding="utf-8")
    try:
        code = _pytest(copy, mutant.tests).returncode
    finally:
        file.write_text(good, encoding="utf-8")
    return {_FAILED: "caught", _PASSED: "MISSED"}.get(code, "NOT TESTED")


def _pytest(copy: Path, tests: tuple[str, ...] | list[str]) -> subprocess.CompletedProcess[str]:
    return _python(copy, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests)


def _python(copy: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(
        [sys.executable, *arguments], cwd=copy, env=environment, capture_output=True, text=True,
        check=False,
    )  # fmt: skip

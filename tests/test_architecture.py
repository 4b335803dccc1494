"""The rooms and who may import whom; read off the source, nothing is run for it."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "gcar_deploy"
#: from the ground up: a room imports those of lower floors alone; rooms on one floor keep apart
FLOORS = {
    room: floor
    for floor, rooms in enumerate(
        (
            "errors types files",
            "config stopwatch",
            "geometry",
            "models",
            "imaging",
            "gaussians dicom",
            "tree inputs",
            "predict tubes measure",
            "quality",
            "pose",
            "reconstruction",
            "output reconstruct selftest data",
            "result",
            "engine",
            "inspection worker batch bench",
            "cli",
        )
    )
    for room in rooms.split()
}
#: what a bare ``import gcar_deploy`` or ``gcar --help`` must not load
HEAVY = ("numpy", "scipy", "cv2", "skimage", "onnxruntime", "nibabel", "torch", "pydicom")
#: the only files of the runtime that may name these libraries
WALLED = {
    "torch": {"gaussians/torch_project.py"},
    "onnxruntime": {"models/session.py"},
    "nibabel": {"output/volume.py"},
    "pydicom": {
        "dicom/header.py",
        "dicom/frames.py",
        "output/dicom_stl.py",
        "output/dicom_study.py",
    },
    "distributed": {"batch/pools.py"},
    "pynetdicom": {"worker/listen.py", "worker/send.py"},
    "flask": {"worker/http.py"},
    "waitress": {"worker/http.py"},
}


def sources() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def name_of(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


def imports(path: Path) -> set[str]:
    """Full names of all modules that a file imports, also inside functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name_of(path)}: relative import"
            module = node.module or ""
            found |= {module} | {f"{module}.{alias.name}" for alias in node.names}
    return found


def room(path: Path) -> str:
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return parts[0]


def typing_only(path: Path) -> set[str]:
    """Modules imported under ``if TYPE_CHECKING``: names in annotations, no dependency."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            for child in ast.walk(node):
                if isinstance(child, ast.ImportFrom) and child.module:
                    found |= {child.module, *(f"{child.module}.{a.name}" for a in child.names)}
    return found


@pytest.mark.parametrize("path", sources(), ids=name_of)
def test_no_arrow_up(path):
    own = room(path)
    if own == "__init__":
        return
    assert own in FLOORS, f"{own} has no floor: add it to the law on purpose"
    for module in imports(path) - typing_only(path):
        parts = module.split(".")
        if parts[0] != "gcar_deploy" or len(parts) < 2:
            assert parts[0] not in ("gcar_export", "tests"), f"imports {module}"
            continue
        if parts[1] not in FLOORS or parts[1] == own:
            continue
        assert FLOORS[parts[1]] < FLOORS[own], f"{name_of(path)} imports {module}"


@pytest.mark.parametrize("path", sources(), ids=name_of)
def test_walled_libraries_stay_in_their_room(path):
    named = {module.split(".")[0] for module in imports(path)}
    for library, homes in WALLED.items():
        if library in named:
            assert name_of(path) in homes


@pytest.mark.parametrize("path", sources(), ids=name_of)
def test_files_stay_small_and_quiet(path):
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 420
    tree = ast.parse(text)
    assert ast.get_docstring(tree), "no docstring"
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id not in ("print", "eval", "exec"), f"line {node.lineno}"
        if isinstance(node, ast.ExceptHandler):
            assert node.type is not None, f"bare except in line {node.lineno}"
        assert not isinstance(node, ast.Assert), f"assert in line {node.lineno}"


@pytest.mark.parametrize("path", sorted((PACKAGE / "output").glob("*.py")), ids=name_of)
def test_writers_measure_nothing(path):
    """What is measured comes to them as ``Measured``, worked out once below."""
    below = ("gcar_deploy.measure", "gcar_deploy.pose", "gcar_deploy.geometry.observability")
    found = {module for module in imports(path) if module.startswith(below)}
    assert found <= {"gcar_deploy.measure", "gcar_deploy.measure.Measured"}


def loaded_by(code: str) -> set[str]:
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\nimport sys; print('\\n'.join(sys.modules))"],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    return set(done.stdout.split())


def test_a_bare_import_loads_nothing_heavy():
    assert not loaded_by("import gcar_deploy") & set(HEAVY)


@pytest.mark.req("REQ-37")
def test_help_loads_nothing_heavy():
    code = (
        "from gcar_deploy.cli.main import gcar\n"
        "import contextlib, io\n"
        "with contextlib.redirect_stdout(io.StringIO()):\n"
        "    gcar.main(['--help'], standalone_mode=False)"
    )
    assert not loaded_by(code) & set(HEAVY)


@pytest.mark.req("REQ-37")
def test_the_whole_runtime_never_imports_torch():
    modules = [
        "gcar_deploy." + name_of(p)[:-3].replace("/", ".").removesuffix(".__init__")
        for p in sources()
        if p.name != "__init__.py"
    ]
    code = "import importlib\n" + "\n".join(f"importlib.import_module({m!r})" for m in modules)
    assert "torch" not in loaded_by(code)

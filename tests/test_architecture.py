"""The rooms and who may import whom; read off the source, nothing is run for it."""

from __future__ import annotations

import ast
import functools
import graphlib
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = {"gcar_deploy": ROOT / "gcar_deploy", "gcar_export": ROOT / "export"}
PACKAGE = PACKAGES["gcar_deploy"]
#: from the ground up: a room imports those of lower floors alone; rooms on one floor keep apart
RUNTIME_FLOORS = (
    "errors types files plain scratch",
    "config stopwatch beside",
    "geometry",
    "models",
    "imaging",
    "gaussians dicom",
    "frames",
    "tree inputs",
    "predict tubes measure",
    "quality flow",
    "pose",
    "reconstruction steps second_look",
    "output reconstruct selftest data",
    "result",
    "engine",
    "engine_choice",
    "inspection worker batch bench",
    "workbench",
    "cli",
)
EXPORT_FLOORS = ("scenes", "training", "shipping methods", "evaluate", "studies", "cli")
FLOORS = {
    (package, room): floor
    for package, floors in (("gcar_deploy", RUNTIME_FLOORS), ("gcar_export", EXPORT_FLOORS))
    for floor, rooms in enumerate(floors)
    for room in rooms.split()
}
#: rooms that others enter by what their ``__init__`` shows
FACED = ("models", "predict", "tubes", "quality", "pose", "flow")
#: what a bare ``import gcar_deploy`` or ``gcar --help`` must not load
HEAVY = ("numpy", "scipy", "cv2", "skimage", "onnxruntime", "nibabel", "torch", "pydicom")
#: rooms and files of which a run of two calibrated pictures needs none
SPARED = (
    "gaussians.paper", "gaussians.project", "models.guard", "output.dicom_stl",
    "output.frame_pictures", "output.glb", "workbench", "worker",
)  # fmt: skip
#: the only files of the runtime that may name these libraries
WALLED = {
    "torch": {"gaussians/torch_project.py"},
    "onnxruntime": {"models/session.py"},
    "nibabel": set(),
    "pydicom": {
        "dicom/header.py",
        "dicom/frames.py",
        "output/dicom_sr.py",
        "output/dicom_stl.py",
        "output/dicom_study.py",
    },
    "highdicom": {"output/dicom_sr.py"},
    "distributed": {"batch/pools.py"},
    "pynetdicom": {"worker/listen.py", "worker/send.py"},
    "flask": {"worker/http.py", "worker/loopback.py", "workbench/http.py"},
    "waitress": {"worker/loopback.py"},
}


def sources(*packages: str) -> list[Path]:
    return sorted(p for name in packages for p in PACKAGES[name].rglob("*.py"))


RUNTIME = sources("gcar_deploy")
ALL = sources(*PACKAGES)


def package_of(path: Path) -> str:
    return "gcar_deploy" if PACKAGE in path.parents else "gcar_export"


def name_of(path: Path) -> str:
    return path.relative_to(PACKAGES[package_of(path)]).as_posix()


def module_of(path: Path) -> str:
    inside = path.relative_to(PACKAGES[package_of(path)]).with_suffix("").parts
    return ".".join((package_of(path), *inside)).removesuffix(".__init__")


MODULES = {module_of(path): path for path in ALL}


@functools.cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def imports(path: Path, *, typing: bool = True) -> set[str]:
    """Full names of all that a file imports, also inside functions: modules, or names in them.

    Without ``typing`` what stands under ``if TYPE_CHECKING`` is left out: names in annotations
    are no dependency.
    """
    found, tree = set(), parsed(path)
    skipped = {
        id(child)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test) and not typing
        for child in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name_of(path)}: relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def face_of(room: str) -> set[str]:
    """Names that a room shows to others; none without an ``__all__``."""
    for node in parsed(MODULES[room]).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return set(ast.literal_eval(node.value))
    return set()


FACES = {name: face_of(name) for name, path in MODULES.items() if path.name == "__init__.py"}


def dependencies(path: Path) -> set[str]:
    """Modules of our own that a file imports."""
    found = set()
    for name in imports(path, typing=False):
        if name.startswith(tuple(PACKAGES)):
            room, _, last = name.rpartition(".")
            found.add(name if name in MODULES and last not in FACES.get(room, ()) else room)
    return found - {module_of(path)}


def room_of(module: str) -> tuple[str, str]:
    package, _, rest = module.partition(".")
    return package, rest.partition(".")[0]


def arrows(files: list[Path]) -> Iterator[tuple[str, tuple[str, str], str]]:
    """Each import of our own: the file, its room, and the module."""
    for path in files:
        own = room_of(module_of(path))
        if own[1]:
            for module in sorted(dependencies(path)):
                yield name_of(path), own, module


def test_no_arrow_up():
    rooms = {room_of(module_of(path)) for path in ALL}
    assert {room for room in rooms if room[1]} == set(FLOORS), "give each room its floor"
    for name, own, module in arrows(ALL):
        other = room_of(module)
        assert own[0] != "gcar_deploy" or other[0] != "gcar_export", f"{name} imports {module}"
        if other in FLOORS and other[0] == own[0] and other != own:
            assert FLOORS[other] < FLOORS[own], f"{name} imports {module}"


def test_the_drawing_and_the_table_of_the_rooms_name_them_all():
    """CONTRIBUTING draws the floors from the top down; the table has the rooms of several files."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    lines = re.search(r"^    gcar_deploy\n((?:      .+\n)+)", text, re.MULTILINE)[1].splitlines()
    drawn = [set(line.split()) for line in reversed(lines)]
    assert drawn == [set(rooms.split()) for rooms in RUNTIME_FLOORS]
    told = set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE))
    assert told == {file.parent.name for file in PACKAGE.glob("*/__init__.py")}


def test_nothing_imports_tests():
    for path in ALL:
        assert not any(name.startswith("tests.") for name in imports(path)), name_of(path)


def test_a_room_with_a_face_is_entered_by_it():
    for name, own, module in arrows(RUNTIME):
        room = room_of(module)
        assert room == own or room[1] not in FACED or module == ".".join(room), (
            f"{name} imports {module}: let the face of {room[1]} show what others use"
        )


def test_no_circles():
    """Not between the files of a room either: all imports together have an order."""
    graphlib.TopologicalSorter({module_of(p): dependencies(p) for p in ALL}).prepare()


def test_walled_libraries_stay_in_their_room():
    for path in RUNTIME:
        named = {module.split(".")[0] for module in imports(path)}
        for library in named & set(WALLED):
            assert name_of(path) in WALLED[library], f"{name_of(path)} imports {library}"


def test_files_stay_small_and_quiet():
    for path in RUNTIME:
        name, tree = name_of(path), parsed(path)
        assert len(path.read_text(encoding="utf-8").splitlines()) <= 420, name
        assert ast.get_docstring(tree), f"{name}: no docstring"
        for node in ast.walk(tree):
            at = f"{name}, line {getattr(node, 'lineno', '?')}"
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id not in ("print", "eval", "exec"), at
            assert not isinstance(node, ast.ExceptHandler) or node.type, f"bare except: {at}"
            assert not isinstance(node, ast.Assert), f"assert: {at}"


def test_writers_measure_nothing():
    """What is measured comes to them as ``Measured``, worked out once below."""
    below = ("gcar_deploy.measure", "gcar_deploy.pose", "gcar_deploy.geometry.observability")
    handed = {
        "gcar_deploy.measure", "gcar_deploy.measure.Measured", "gcar_deploy.measure.Sections",
        "gcar_deploy.pose.Registered",
    }  # fmt: skip
    for path in (PACKAGE / "output").glob("*.py"):
        found = {module for module in imports(path) if module.startswith(below)}
        assert found <= handed, f"{name_of(path)} imports {found - handed}"


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


@pytest.mark.slow
@pytest.mark.req("REQ-37")
def test_a_run_of_pictures_loads_only_what_it_uses(tmp_path):
    """No DICOM, no library that reads other people's files, nothing for three views."""
    code = (
        "from gcar_deploy.data.demo_case import demo_case\n"
        "from gcar_deploy.engine import Engine\n"
        "case = demo_case()\n"
        "result = Engine(threads=1).reconstruct(case.pictures, case.geometry)\n"
        f"result.save({str(tmp_path / 'out')!r})"
    )
    loaded = loaded_by(code)
    spared = ("nibabel", "pydicom", "gdcm", "matplotlib", "scipy.interpolate", "scipy.stats",
              "scipy.signal", "skimage.morphology", "flask", "onnx", "torch")  # fmt: skip
    assert not loaded & {*spared, *(f"gcar_deploy.{name}" for name in SPARED)}


@pytest.mark.req("REQ-37")
def test_the_whole_runtime_never_imports_torch():
    modules = [
        "gcar_deploy." + name_of(p)[:-3].replace("/", ".").removesuffix(".__init__")
        for p in RUNTIME
        if p.name != "__init__.py"
    ]
    code = "import importlib\n" + "\n".join(f"importlib.import_module({m!r})" for m in modules)
    assert "torch" not in loaded_by(code)


def test_every_room_is_installed():
    """A room that pyproject.toml does not name works in the checkout alone."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    named = settings["tool"]["setuptools"]["packages"]
    there = ["gcar_models"]
    for folder, package in (("gcar_deploy", "gcar_deploy"), ("export", "gcar_export")):
        for file in (ROOT / folder).rglob("*.py"):
            there.append(".".join((package, *file.parent.relative_to(ROOT / folder).parts)))
    assert sorted(named) == sorted(set(there))

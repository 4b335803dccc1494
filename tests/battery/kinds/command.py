"""Whole command lines of ``gcar`` and ``gcar-export``: options, values and files damaged."""

from __future__ import annotations

import contextlib
import io
import os
import random
import resource
import subprocess
import sys
from pathlib import Path

from tests.battery.cases import write_case
from tests.battery.damage import damaged
from tests.battery.kinds.common import generator
from tests.battery.pool import Case, FoundError

#: one in so many is a process of its own; the others run in the child
WHOLE = 10
#: processor seconds of a whole process; importing torch takes some of them
_CPU_S = {"gcar": 5, "gcar-export": 15}
_CODES = (0, 2, 3, 4, 5, 6, 7, 8)
_LONGEST = 2048
_RUN = ["run", "V", "W", "--geom", "G", "--out", "O", "--predictor", "none", "--threads", "1"]
_GCAR = (
    _RUN,
    [*_RUN[:-4], "--predictor", "multi", "--model", "M", "--quiet"],
    [*_RUN, "--json", "--strict", "--refiner", "none"],
    [*_RUN, "--deadline", "0.01", "-v"],
    ["validate", "V", "W", "--geom", "G", "--json"],
    ["enhance", "V", "--out", "O", "--kind", "raw", "--polarity", "auto"],
    ["enhance", "V", "--out", "O", "--kind", "path_length", "--mm-per-count", "0.001"],
    [*_RUN, "--mask", "2:W", "--landmark", "9,9:9,9", "--print-order"],
    ["run", "--order", "G", "--out", "O"],
    ["info", "R", "--json"],
    ["doctor", "--help"],
    ["demo", "--out", "O", "--help"],
)
_EXPORT = (
    ["verify", "M", "--scenes", "0"],
    ["golden", "M"],
    ["export", "C", "--out", "X", "--inputs", "8"],
    ["simulate", "L", "O", "--protocol", "paper", "--views", "2"],
    ["evaluate", "--data", "D", "--out", "O", "--methods", "ours,hull", "--views", "2,4"],
    ["score", "D", "--limit", "1"],
    # Without --help a valid line would begin hours of work: no folder is named here.
    ["train", "--help"],
    ["tree-table", "--count", "0"],
)
_WORDS = (
    "", "-", "--", "--help", "-v", "--json", "--force", "--fast", "nan", "-1", "0", "1e999", "inf",
    "9" * 400, "\u202e", "a" * 5000, ".", "/", "/dev/null", "/dev/full", "V", "O", "D", "G",
    "P", "--out", "--geom", "--order", "--mask", "1:P", "--print-order", "--frame",
    "--landmark", "--threads", "--model", "--deadline", "--predictor", "tube", "none",
    "\udcff",
)  # fmt: skip


def make(seed: int) -> Case:
    """Return the fuzz case of command lines."""
    # Imported before the fork, so that every child has them already.
    import gcar_export.cli.main
    import gcar_export.shipping.parity
    import gcar_export.shipping.verify  # noqa: F401

    def case(index: int, folder: Path) -> str:
        rng = generator("command", seed, index)
        program = "gcar" if rng.random() < 0.7 else "gcar-export"
        names = _files(folder, rng)
        line = _line(list(rng.choice(_GCAR if program == "gcar" else _EXPORT)), names, rng)
        before = _listing(folder)
        whole = index % WHOLE == 0
        code, out, err = (_process if whole else _here)(program, line, folder)
        _judge(program, line, code, out + err, err)
        after = _listing(folder)
        if code != 0 and after != before:
            raise FoundError(f"left behind {sorted(after - before)[:5]} by {line}")
        return f"{program} {'process' if whole else 'call'} exit {code}"

    return case


def _files(folder: Path, rng: random.Random) -> dict[str, str]:
    """Write a case with one file damaged half of the time, and name the paths."""
    write_case(folder / "case")
    paths = {
        "V": folder / "case" / "view1.png", "W": folder / "case" / "view2.png",
        "G": folder / "case" / "geom.json", "O": folder / "out", "R": folder / "case",
        "M": folder / "m.onnx", "C": folder / "c.safetensors", "L": folder / "label.nii.gz",
        "D": folder / "data", "P": folder / "pipe", "X": folder / "m2.onnx",
    }  # fmt: skip
    paths["D"].mkdir()
    os.mkfifo(paths["P"])
    paths["M"].write_bytes(rng.randbytes(200))
    paths["M"].with_suffix(".json").write_text("{}")
    paths["C"].write_bytes(rng.randbytes(200))
    paths["L"].write_bytes(rng.randbytes(200))
    if rng.random() < 0.5:
        file = paths[rng.choice("VWG")]
        file.write_bytes(damaged(file.read_bytes(), rng))
    return {letter: str(path) for letter, path in paths.items()}


def _line(line: list[str], names: dict[str, str], rng: random.Random) -> list[str]:
    for _ in range(rng.choice((0, 1, 1, 2, 3))):
        at = rng.randrange(len(line))
        action = rng.randrange(4)
        if action == 0:
            line[at] = rng.choice(_WORDS)
        elif action == 1:
            line.insert(at, rng.choice(_WORDS))
        elif action == 2 and len(line) > 1:
            del line[at]
        else:
            line.insert(at, line[rng.randrange(len(line))])
    return [names.get(word, word) for word in line]


def _here(program: str, line: list[str], folder: Path) -> tuple[int, str, str]:
    """Run in this child, as the console script would."""
    from gcar_deploy.cli.main import main
    from gcar_export.cli.main import main as export

    out, err = io.StringIO(), io.StringIO()
    code: object = 0
    os.chdir(folder)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            if program == "gcar":
                main(line)
            else:
                export.main(line, prog_name="gcar-export")
        except SystemExit as stop:
            code = stop.code
    return (
        (code if isinstance(code, int) else 0 if code is None else 1),
        out.getvalue(),
        err.getvalue(),
    )


def _process(program: str, line: list[str], folder: Path) -> tuple[int, str, str]:
    module = "gcar_deploy.cli.main" if program == "gcar" else "gcar_export.cli.main"
    code = f"import sys; sys.argv[0] = {program!r}; from {module} import main; main()"
    cpu = _CPU_S[program]

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (cpu, cpu))

    if any("\x00" in word for word in line):
        line = [word.replace("\x00", "") for word in line]
    done = subprocess.run(
        [sys.executable, "-c", code, *line],
        capture_output=True, cwd=folder, preexec_fn=limit, timeout=280, check=False,
        stdin=subprocess.DEVNULL,
    )  # fmt: skip
    return (
        done.returncode,
        done.stdout.decode("utf-8", "replace"),
        done.stderr.decode("utf-8", "replace"),
    )


def _judge(program: str, line: list[str], code: int, both: str, err: str) -> None:
    shown = [word[:60] for word in line]
    if "Traceback" in both:
        raise FoundError(f"traceback of {program} {shown}: {err[-300:]}")
    if code not in _CODES:
        raise FoundError(f"exit {code} of {program} {shown}: {err[-300:]}")
    # A path of the user's own may be long; beyond those a message is short.
    longest = _LONGEST + 2 * sum(len(word) for word in line)
    if code != 0 and "--help" not in line and len(err) > longest:
        raise FoundError(f"{len(err)} characters of {program} {shown}")


def _listing(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*")}

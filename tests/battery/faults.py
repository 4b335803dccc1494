"""Kills, signals, a full disk, a read-only place: the old complete result or the new one.

The disk is a small tmpfs in a mount namespace of its own where the system lets us have one;
elsewhere the largest file size stands in for it, and the read-only mount is left out, which is
then said.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import click

from gcar_deploy.output.stored import altered_files, read_summary
from tests.battery.cases import write_case

_ROOT = Path(__file__).parents[2]
#: saves one result over and over, each time with another stamp in every file
_SAVER = """
import json, os, sys
from pathlib import Path
from gcar_deploy.engine import Engine
from gcar_deploy.config import PredictOptions, RunOptions
from gcar_deploy.output import bundle
from gcar_deploy.output.folder import write_folder
from gcar_deploy.selftest import tiny_case
import hashlib
pictures, grid, _ = tiny_case()
options = RunOptions(predict=PredictOptions(predictor="none"))
files = bundle.render_files(Engine(options=options, threads=1).reconstruct(pictures, grid))
summary = json.loads(files["result.json"])
print("started", flush=True)
for generation in range(10 ** 9):
    stamped = {n: d + f"{os.getpid()}-{generation}".encode() for n, d in files.items()}
    summary["files"] = {n: {"bytes": len(d), "sha256": hashlib.sha256(d).hexdigest()}
                        for n, d in stamped.items() if n != "result.json"}
    stamped["result.json"] = json.dumps(summary).encode()
    write_folder(Path(sys.argv[1]), stamped, force=True)
"""
#: in a mount namespace: a disk of DISK bytes, filled up while a result is replaced; then read-only
_DISK = """
set -e
mount -t tmpfs -o size=%(kib)dk none %(disk)s
mkdir %(disk)s/p
%(run)s --out %(disk)s/p/out && echo FIRST
dd if=/dev/zero of=%(disk)s/filler bs=1k count=%(filler)d 2>/dev/null || true
set +e
%(run)s --out %(disk)s/p/out --force; echo FULL $?
%(run)s --out %(disk)s/p/new/out; echo FULLNEW $?
%(python)s -m gcar_deploy.cli.main info %(disk)s/p/out > /dev/null; echo INFO $?
ls -A %(disk)s/p
mount -o remount,ro %(disk)s
%(run)s --out %(disk)s/p/out --force; echo READONLY $?
%(python)s -m gcar_deploy.cli.main info %(disk)s/p/out > /dev/null; echo INFO $?
ls -A %(disk)s/p
"""


def faults(kills: int, signals: int, seed: int) -> int:
    """Run all of them; return the number of findings."""
    found: list[str] = []
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        # A shell's background job ignores SIGINT, and so would the processes started here.
        signal.signal(signal.SIGINT, signal.default_int_handler)
    with tempfile.TemporaryDirectory(prefix="gcar-faults-") as name:
        for verb, work in (
            ("kills", lambda folder: _kills(folder, kills, seed)),
            ("signals", lambda folder: _signals(folder, signals, seed)),
            ("full disk, read-only", _disk),
            ("largest file size", _file_size),
        ):
            folder = Path(name) / verb.split(",")[0].replace(" ", "-")
            folder.mkdir()
            said, findings = work(folder)
            click.echo(f"{verb}: {said}; {len(findings)} findings")
            found += findings
    for finding in found:
        click.echo(f"    {finding}")
    click.echo(f"findings: {len(found)}")
    return len(found)


def _kills(folder: Path, count: int, seed: int) -> tuple[str, list[str]]:
    """Kill -9 while a result is being replaced, at random moments."""
    chance = random.Random(seed)
    out, found = folder / "out", []
    counts: Counter[str] = Counter()
    before = None
    with click.progressbar(range(count), label="kills", file=sys.stderr) as bar:
        for _ in bar:
            with subprocess.Popen(
                [sys.executable, "-c", _SAVER, str(out)], stdout=subprocess.PIPE, cwd=_ROOT
            ) as process:
                assert process.stdout is not None
                process.stdout.readline()
                time.sleep(chance.uniform(0.0, 0.4))
                process.kill()
                process.wait(timeout=60)
            if not out.exists():
                counts["nothing yet"] += 1
                found += [] if before is None else ["a complete result vanished"]
                continue
            found += _whole(out)
            stamp = (out / "result.json").read_bytes()
            counts["old complete" if stamp == before else "new complete"] += 1
            counts["left private folders"] += len(list(folder.iterdir())) > 1
            before = stamp
    if counts["left private folders"] == 0 and count >= 20:
        found.append("no kill came while it was writing: the test is blind")
    stale = [p.name for p in folder.iterdir() if p != out]
    if len(stale) > 1:
        found.append(f"private folders pile up: {stale}")
    found += [f"not private: {n}" for n in stale if (folder / n).stat().st_mode & 0o077]
    return f"{count} at random moments: {_counted(counts)}", found


def _signals(folder: Path, count: int, seed: int) -> tuple[str, list[str]]:
    """SIGINT and SIGTERM to a whole ``gcar run --force`` at random moments of its life."""
    chance = random.Random(seed)
    write_case(folder / "case")
    out = folder / "place" / "out"
    if subprocess.run(_run(folder, out), capture_output=True, check=False).returncode:
        return "the first run failed", ["the first run failed"]
    began = time.monotonic()
    subprocess.run(_run(folder, out, "--force"), capture_output=True, check=True)
    whole = time.monotonic() - began
    counts: Counter[str] = Counter()
    found = []
    with click.progressbar(range(count), label="signals", file=sys.stderr) as bar:
        for k in bar:
            number = (signal.SIGINT, signal.SIGTERM)[k % 2]
            with subprocess.Popen(
                _run(folder, out, "--force"), stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            ) as process:  # fmt: skip
                # Not while Python itself still starts: nothing of gcar runs yet then.
                time.sleep(chance.uniform(0.2, 1.0) * whole)
                process.send_signal(number)
                _, errors = process.communicate(timeout=120)
            counts[f"{number.name} exit {process.returncode}"] += 1
            if process.returncode == 0:  # too late: the machine has become faster
                whole *= 0.8
            if process.returncode not in (0, 130, 143, -signal.SIGINT, -signal.SIGTERM):
                found.append(f"{number.name}: exit {process.returncode}: {errors[-300:]!r}")
            if process.returncode > 0 and b"Traceback" in errors:
                found.append(f"{number.name}: traceback {errors[-300:]!r}")
            found += _whole(out)
            others = [p.name for p in out.parent.iterdir() if p != out]
            found += [f"{number.name} left {others}"] if others else []
    for name in ("SIGINT", "SIGTERM"):
        if count >= 10 and counts[f"{name} exit 0"] == (count + (name == "SIGINT")) // 2:
            found.append(f"no {name} arrived in time: the test is blind")
    return f"{count} of SIGINT, SIGTERM: {_counted(counts)}", found


def _disk(folder: Path) -> tuple[str, list[str]]:
    """Fill a small disk while a result is replaced; make it read-only."""
    if shutil.which("unshare") is None or os.name != "posix":
        return "left out, no mount namespaces here", []
    write_case(folder / "case")
    disk = folder / "disk"
    disk.mkdir()
    run = " ".join(_run(folder, Path("X"))[:-2])
    names = {"disk": disk, "run": run, "python": sys.executable, "kib": 8192, "filler": 8192}
    script = _DISK % names
    command = ["unshare", "--mount", "--map-root-user", "sh", "-c", script]
    if os.geteuid() == 0:
        command.remove("--map-root-user")
    done = subprocess.run(command, capture_output=True, text=True, cwd=_ROOT, check=False)
    said = [line for line in done.stdout.splitlines() if line.split(" ")[0].isupper()]
    if "FIRST" not in done.stdout:
        return f"left out, no small disk here ({done.stderr.strip()[-80:]})", []
    codes = dict(line.split() for line in said if " " in line)
    left = [line for line in done.stdout.splitlines() if line.startswith(".") or line == "new"]
    found = [f"left on the disk: {left}"] if left else []
    found += [
        f"{key}: exit {codes.get(key)}" for key in ("FULL", "FULLNEW") if codes.get(key) != "1"
    ]
    found += (
        ["READONLY: exit " + codes["READONLY"]] if codes.get("READONLY") not in ("1", "2") else []
    )
    found += ["the old result is not complete"] if said.count("INFO 0") != 2 else []
    found += ["a traceback"] if "Traceback" in done.stderr else []
    return f"exit codes {codes}, old result complete {said.count('INFO 0')} of 2 times", found


def _file_size(folder: Path) -> tuple[str, list[str]]:
    """Let no file grow beyond some sizes: the write fails in the middle."""
    import resource

    write_case(folder / "case")
    found, codes = [], Counter[str]()
    for size in (0, 1000, 20_000, 100_000):
        out = folder / "place" / "out"

        def limit(size: int = size) -> None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

        done = subprocess.run(_run(folder, out), capture_output=True, preexec_fn=limit, check=False)
        codes[f"exit {done.returncode}"] += 1
        if done.returncode != 1 or b"Traceback" in done.stderr or (folder / "place").exists():
            found.append(f"{size} bytes: exit {done.returncode}: {done.stderr[-200:]!r}")
    return f"4 sizes: {_counted(codes)}", found


def _run(folder: Path, out: Path, *more: str) -> list[str]:
    case = folder / "case"
    return [
        sys.executable, "-m", "gcar_deploy.cli.main", "run", str(case / "view1.png"),
        str(case / "view2.png"), "--geom", str(case / "geom.json"), "--predictor", "none",
        "--threads", "1", *more, "--out", str(out),
    ]  # fmt: skip


def _whole(out: Path) -> list[str]:
    """Return what is wrong with a result folder: every listed file must be there as written."""
    try:
        summary = read_summary(out)
        altered = altered_files(out, summary)
    except Exception as error:  # noqa: BLE001 - whatever it is, the folder is not whole
        return [f"half a result: {error}"]
    extra = {p.name for p in out.iterdir()} - set(summary["files"]) - {"result.json"}
    return [f"half a result: {altered or sorted(extra)}"] if altered or extra else []


def _counted(counts: Counter[str]) -> str:
    return json.dumps(dict(sorted(counts.items())))[1:-1].replace('"', "")

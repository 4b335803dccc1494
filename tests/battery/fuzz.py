"""Fuzz every kind of input that comes from outside; resumable, counts printed."""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections import Counter
from pathlib import Path

import click

from tests.battery.pool import Tally, run_cases

#: kind -> (module, cases of a full run)
KINDS = {
    "png": ("png", 20_000),
    "json": ("json_kind", 20_000),
    "onnx": ("onnx_kind", 5_000),
    "dicom": ("dicom", 2_000),
    "checkpoint": ("checkpoint", 500),
    "http": ("http", 2_000),
    "command": ("command", 300),
}
#: cases between two notes of the state
_STRETCH = 500
_SHOWN = 20


def fuzz(kinds: tuple[str, ...], share: float, seed: int, state: Path | None) -> int:
    """Run the kinds one after the other; return the number of findings.

    Parameters
    ----------
    share : of the full counts, for a short version
    state : file that notes what is done; a later call with the same seed goes on there
    """
    noted = _noted(state, seed)
    findings = 0
    for kind in kinds:
        module, full = KINDS[kind]
        try:
            make = importlib.import_module(f"tests.battery.kinds.{module}").make
        except ImportError as error:
            click.echo(f"{kind:12s} skipped: {error.name or error} is not installed")
            continue
        tally = _all_cases(kind, make(seed), max(1, round(full * share)), noted, state)
        findings += len(tally.findings)
        click.echo(_line(kind, tally))
        for finding in tally.findings[:_SHOWN]:
            click.echo(f"    {finding}")
    click.echo(f"findings: {findings}")
    return findings


def _all_cases(kind: str, case: object, count: int, noted: dict, state: Path | None) -> Tally:
    tally = _tally(noted["kinds"].get(kind))
    with click.progressbar(length=count, label=f"{kind:12s}", file=sys.stderr) as bar:
        bar.update(min(tally.cases, count))
        while tally.cases < count:
            part = run_cases(case, tally.cases, min(_STRETCH, count - tally.cases))  # type: ignore[arg-type]
            tally.add(part)
            bar.update(part.cases)
            noted["kinds"][kind] = {**vars(tally), "outcomes": dict(tally.outcomes)}
            if state is not None:
                part_file = state.with_suffix(".part")
                part_file.write_text(json.dumps(noted))
                os.replace(part_file, state)
    return tally


def _noted(state: Path | None, seed: int) -> dict:
    if state is not None and state.exists():
        noted: dict = json.loads(state.read_text())
        if noted["seed"] == seed:
            return noted
    if state is not None:
        state.parent.mkdir(parents=True, exist_ok=True)
    return {"seed": seed, "kinds": {}}


def _tally(noted: dict | None) -> Tally:
    if noted is None:
        return Tally()
    return Tally(**{**noted, "outcomes": Counter(noted["outcomes"])})


def _line(kind: str, tally: Tally) -> str:
    counts = ", ".join(f"{name} {n}" for name, n in tally.outcomes.most_common())
    return (
        f"{kind:12s} {tally.cases} cases, {len(tally.findings)} findings; {counts}; "
        f"at most {tally.most_cpu_s:.2f} s of processor time, {tally.peak_mib} MiB"
    )

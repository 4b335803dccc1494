"""gcar doctor: versions, processor, threads, self-test; everything offline."""

from __future__ import annotations

import json
import os
import platform
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gcar_deploy.cli.common import Talk, ToldError, talk_options

if TYPE_CHECKING:
    from gcar_deploy.models import Kind

#: instruction sets that the numerical libraries gain from
_FLAGS = ("sse4_2", "avx", "avx2", "fma", "avx512f", "avx512_vnni", "amx_int8", "asimd", "sve")
#: a wrong library gives nonsense of centimetres; where depth is ambiguous a part may be off
_SELF_TEST_MM = 1.0


@click.command("doctor")
@talk_options("as_json", "verbose")
def doctor(talk: Talk) -> None:
    """Check this installation: versions, processor, threads, models, a small reconstruction.

    \b
    Example:
      gcar doctor
    """  # noqa: D301 - click wants a real backspace
    from gcar_deploy.errors import GcarError, ModelError

    talk.set_up()
    report = examine()
    click.echo(json.dumps(report, allow_nan=False) if talk.as_json else "\n".join(lines(report)))
    unsound = [f"{one['name']}: {one['sentence']}" for one in report["models"] if not one["sound"]]
    if unsound:
        raise ToldError(ModelError("; ".join(unsound)))
    if not report["self_test"]["passed"]:
        raise ToldError(GcarError(f"self-test failed: {report['self_test']['sentence']}"))


def examine() -> dict[str, Any]:
    """Collect the report; plain values only."""
    import cv2

    from gcar_deploy.reconstruction import versions

    return {
        "versions": versions(),
        "platform": platform.platform(),
        "processor": processor(),
        "threads": {
            "cores": os.cpu_count(),
            "usable": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
            "opencv": cv2.getNumThreads(),
            "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS"),
        },
        "models": models(),
        "torch_imported": "torch" in sys.modules,
        "network": "not used by any verb",
        "self_test": self_test(),
    }


def processor() -> dict[str, Any]:
    """Name and useful instruction sets of the processor, where the system tells."""
    name, flags = platform.processor() or platform.machine(), set[str]()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                name = value.strip()
            elif key.strip() in ("flags", "Features"):
                flags = set(value.split())
    return {"name": name, "flags": [flag for flag in _FLAGS if flag in flags]}


def models() -> list[dict[str, Any]]:
    """Name, hash and golden case of every model that comes along, or why it is unfit."""
    from gcar_deploy.imaging.net import KIND as SEGMENTER
    from gcar_deploy.predict import PREDICTOR_KINDS

    return [_model(kind) for kind in (*PREDICTOR_KINDS.values(), SEGMENTER)]


def _model(kind: Kind) -> dict[str, Any]:
    from gcar_deploy.errors import ModelError
    from gcar_deploy.imaging.net import open_segmenter
    from gcar_deploy.models import check_graph
    from gcar_deploy.predict import PREDICTOR_KINDS, open_predictor, read_predictor

    out = {"name": kind.shipped, "sha256": None, "sound": False, "golden": None}
    if kind.path is None:
        return {**out, "sentence": "not installed"}
    try:
        if kind.name in PREDICTOR_KINDS:
            session = open_predictor(read_predictor(kind.path), threads=1).session
        else:
            session = open_segmenter(kind.path, threads=1).session
        check_graph(kind.path.name, session.model.data)
        worst = session.check_golden()
    except ModelError as error:
        return {**out, "sentence": str(error)}
    golden = "no golden case" if worst is None else f"golden case within {worst:.0e}"
    return {
        **out, "sha256": session.model.sha256, "sound": True, "golden": worst,
        "sentence": f"matches its spec; {golden}",
    }  # fmt: skip


def self_test() -> dict[str, Any]:
    """Reconstruct a small generated tree and compare it with what was drawn."""
    import numpy as np
    from scipy.spatial import cKDTree

    from gcar_deploy.engine import Engine
    from gcar_deploy.errors import GcarError
    from gcar_deploy.selftest import tiny_case

    angiograms, grid, tree = tiny_case()
    try:
        result = Engine().reconstruct(angiograms, grid)
    except GcarError as error:
        return {"passed": False, "sentence": str(error), "seconds": None, "distance_mm": None}
    distance = float(np.median(cKDTree(result.tree.points()).query(tree.points())[0]))
    return {
        "passed": distance < _SELF_TEST_MM,
        "sentence": f"a generated tree was found again within {distance:.2f} mm (median)",
        "seconds": result.seconds["total"],
        "distance_mm": distance,
    }


def lines(report: dict[str, Any]) -> list[str]:
    """Return the report for people."""
    out = [
        f"{name:32s} {version or 'not installed'}" for name, version in report["versions"].items()
    ]
    out.append(f"{'platform':32s} {report['platform']}")
    cpu, threads, test = report["processor"], report["threads"], report["self_test"]
    out.append(f"{'processor':32s} {cpu['name']} ({', '.join(cpu['flags']) or 'flags unknown'})")
    out.append(f"{'cores, usable, OpenCV threads':32s} "
               f"{threads['cores']}, {threads['usable']}, {threads['opencv']}")  # fmt: skip
    out += [f"{'model ' + one['name']:32s} {one['sentence']}" for one in report["models"]]
    out.append(f"{'network':32s} {report['network']}")
    seconds = "" if test["seconds"] is None else f" ({test['seconds']:.2f} s)"
    out.append(f"{'self-test':32s} {'passed' if test['passed'] else 'FAILED'}: "
               f"{test['sentence']}{seconds}")  # fmt: skip
    return out

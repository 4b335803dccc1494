"""report.html: one page that needs no network, status first."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

import cv2
import numpy as np

from gcar_deploy.errors import GcarError
from gcar_deploy.output.overlay import branch_color
from gcar_deploy.output.result import Result
from gcar_deploy.tree.lumen import foreshortening
from gcar_deploy.types import Array

_TEMPLATE = "report_template.html"
#: tried in turn until the pictures together fit the budget
_JPEG_QUALITIES = (85, 75, 65, 50, 35)
_PICTURE_SIDE = 1024
_PICTURES_BYTES = 240_000
#: points drawn in 3D, all branches together
_DRAWN_POINTS = 3000


def report_html(result: Result, summary: Mapping[str, Any], overlays: Sequence[Array]) -> str:
    """Render the page.

    Parameters
    ----------
    result : Result
    summary : its ``summary()``
    overlays : (rows, cols, 3) uint8 pictures, blue green red, one per view

    Returns
    -------
    HTML text; scripts and styles inside, allowed by their hashes and nothing else
    """
    template = resources.files("gcar_deploy.output").joinpath(_TEMPLATE).read_text("utf-8")
    parts = {
        "STATUS": html.escape(str(summary["status"])),
        "SENTENCE": html.escape(str(summary["sentence"])),
        "FINDINGS": _list(_sentences(summary)),
        "FACTS": _facts(summary),
        "FIGURES": "".join(
            _figure(view, picture, _PICTURES_BYTES // len(overlays))
            for view, picture in zip(summary["views"], overlays, strict=True)
        ),
        "BUTTONS": "".join(_button(k, view) for k, view in enumerate(summary["views"])),
        "SHORTCOUNT": str(len(summary["views"]) + 1),
        "SHORTHEAD": "".join(
            f"<th>view {html.escape(str(view['id']))}</th>" for view in summary["views"]
        ),
        "BRANCHES": "".join(
            _branch(k, row, [foreshortening(branch, view.carm) for view in result.views])
            for k, (row, branch) in enumerate(
                zip(summary["tree"]["branches"], result.tree.branches, strict=True)
            )
        ),
        "TIMINGS": _rows({k: f"{v:.2f} s" for k, v in summary["seconds"].items()}),
        "PROVENANCE": _rows(_provenance(summary)),
        "USE": html.escape(str(summary["use"])),
        "DATA": _embedded(_scene(result)),
    }
    # One pass: a name of a view that looks like a mark is text.
    page = re.sub("__([A-Z]+)__", lambda mark: parts.get(mark[1], mark[0]), template)
    return page.replace("__CSP__", _policy(page), 1)


def _policy(page: str) -> str:
    """Content security policy: only the scripts and styles of this very page."""

    def hashes(tag: str) -> str:
        bodies = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        digests = (hashlib.sha256(body.encode("utf-8")).digest() for body in bodies)
        return " ".join(f"'sha256-{base64.b64encode(d).decode('ascii')}'" for d in digests)

    return (
        f"default-src 'none'; img-src data:; script-src {hashes('script')}; "
        f"style-src {hashes('style')}; base-uri 'none'; form-action 'none'"
    )


def _embedded(data: Any) -> str:
    """JSON that cannot end the script element it stands in."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c")


def _scene(result: Result) -> dict[str, Any]:
    """Return what the drawings need: rounded and thinned to what a screen can show."""
    branches = []
    stride = max(1, -(-len(result.tree.points()) // _DRAWN_POINTS))
    for number, branch in enumerate(result.tree.branches):
        blue, green, red = branch_color(number)
        keep = np.unique([*range(0, len(branch), stride), len(branch) - 1])
        sigma = [round(float(s), 2) if np.isfinite(s) else None for s in branch.sigma_mm[keep]]
        branches.append(
            {
                "points": np.round(branch.points_mm[keep], 2).tolist(),
                "arc": np.round(branch.arc_mm[keep], 2).tolist(),
                "radius": np.round(branch.radius_mm[keep], 2).tolist(),
                "sigma": sigma,
                "color": f"rgb({red},{green},{blue})",
            }
        )
    views = [[view.carm.primary_angle_deg, view.carm.secondary_angle_deg] for view in result.views]
    lengths = [branch.length_mm for branch in result.tree.branches]
    longest = int(np.argmax(lengths)) if lengths else -1
    return {"branches": branches, "views": views, "longest": longest}


def _figure(view: Mapping[str, Any], picture: Array, most_bytes: int) -> str:
    name = html.escape(f"View {view['id']}: {view['name']}")
    source = base64.b64encode(_jpeg(picture, most_bytes)).decode("ascii")
    details = [
        f"{_share(view['coverage'])} of the vessels explained",
        f"{_share(view['support'])} of the tree seen",
        f"overlap (Dice) {_number(view['overlap'])}",
        f"mean distance {_number(view['distance_mm'], ' mm')}",
    ]
    return (
        f'<figure><img alt="{name} with the reprojected centreline" '
        f'src="data:image/jpeg;base64,{source}"><figcaption><b>{name}</b><br>'
        f"{'; '.join(details)}</figcaption></figure>"
    )


def _jpeg(picture: Array, most_bytes: int) -> bytes:
    """Encode as JPEG of at most so many bytes, if a quality worth looking at allows it."""
    shrink = _PICTURE_SIDE / max(picture.shape[:2])
    if shrink < 1:
        picture = cv2.resize(picture, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    data = b""
    for quality in _JPEG_QUALITIES:
        ok, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
        if not ok:
            raise GcarError("a picture could not be encoded as JPEG")
        data = bytes(encoded.tobytes())
        if len(data) <= most_bytes:
            break
    return data


def _button(number: int, view: Mapping[str, Any]) -> str:
    name = html.escape(f"View {view['id']}: {view['name']}")
    return f'<button type="button" data-view="{number}">{name}</button>'


def _branch(number: int, row: Mapping[str, Any], hidden: Sequence[float]) -> str:
    cells = [
        str(number + 1),
        f"{row['length_mm']:.1f}",
        f"{2 * row['mean_radius_mm']:.2f}",
        f"{2 * row['min_radius_mm']:.2f}",
        _number(row["mean_sigma_mm"]),
        *(f"{100 * share:.0f} %" for share in hidden),
    ]
    columns = "".join(f"<td>{cell}</td>" for cell in cells)
    return (
        f'<tr data-branch="{number}"><td class="swatch"></td>{columns}<td class="short">-</td></tr>'
    )


def _sentences(summary: Mapping[str, Any]) -> list[str]:
    """List findings and notes; a single finding is the status sentence already."""
    findings = list(summary["findings"])
    return [*(findings if len(findings) > 1 else []), *summary["notes"]]


def _facts(summary: Mapping[str, Any]) -> str:
    facts = {
        "view separation": f"{summary['separation_deg']:.0f} deg",
        "branches": str(len(summary["tree"]["branches"])),
        "centreline": f"{summary['tree']['length_mm']:.0f} mm",
        "Gaussians": str(summary["counts"]["gaussians"]),
        "time": f"{summary['seconds']['total']:.1f} s",
    }
    return "".join(
        f"<span>{html.escape(name)} <b>{html.escape(value)}</b></span>"
        for name, value in facts.items()
    )


def _provenance(summary: Mapping[str, Any]) -> dict[str, str]:
    model = summary["model"]
    rows = {
        "Centres": str(summary["predictor"]),
        "Model": "none" if model is None else f"{model['name']} ({model['sha256'][:12]})",
        "Refinement": f"{summary['refiner']}, {summary['counts']['steps']} steps",
        "View separation": f"{summary['separation_deg']:.1f} deg",
    }
    for view in summary["views"]:
        picture = view["picture"]
        rows[f"Picture {view['id']}"] = (
            f"{picture['columns']} x {picture['rows']}, {picture['bit_depth']} bit, "
            f"{view['kind']}, SHA-256 {picture['sha256'][:12]}"
        )
    for name, version in summary["versions"].items():
        rows[name] = str(version or "not installed")
    return rows


def _rows(values: Mapping[str, str]) -> str:
    return "".join(
        f"<tr><th>{html.escape(key)}</th><td>{html.escape(value)}</td></tr>"
        for key, value in values.items()
    )


def _list(sentences: Sequence[str]) -> str:
    if not sentences:
        return ""
    return "<ul>" + "".join(f"<li>{html.escape(text)}</li>" for text in sentences) + "</ul>"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.0%}"


def _number(value: float | None, unit: str = "") -> str:
    return "-" if value is None else f"{value:.2f}{unit}"

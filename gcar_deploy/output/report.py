"""report.html: one page that needs no network, status first."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Mapping, Sequence
from datetime import datetime
from importlib import resources
from typing import Any

import cv2

from gcar_deploy.errors import GcarError
from gcar_deploy.output.colors import SCALE, css
from gcar_deploy.output.pressure_plot import pressure_svg
from gcar_deploy.output.report_data import scene_data
from gcar_deploy.output.words import GHOST, LEFT_OUT, explained
from gcar_deploy.reconstruction import Reconstruction
from gcar_deploy.tree.rooted import inlet_arcs
from gcar_deploy.types import Array

_TEMPLATE = "report_template.html"
#: tried in turn until the pictures together fit the budget
_JPEG_QUALITIES = (85, 75, 65, 50, 35)
_PICTURE_SIDE = 1024
_PICTURES_BYTES = 200_000


def report_html(
    result: Reconstruction, summary: Mapping[str, Any], pictures: Sequence[Array]
) -> str:
    """Render the page.

    Parameters
    ----------
    result : Reconstruction
    summary : its ``summary()``
    pictures : (rows, cols, 3) uint8, blue green red, one per view, of any size; the reprojected
        tree is drawn over them by the page

    Returns
    -------
    HTML text; scripts and styles inside, allowed by their hashes and nothing else
    """
    template = resources.files("gcar_deploy.output").joinpath(_TEMPLATE).read_text("utf-8")
    far_mm = inlet_arcs(result.tree)
    parts = {
        "STATUS": html.escape(str(summary["status"])),
        "SENTENCE": html.escape(str(summary["sentence"])),
        "FINDINGS": _list(_sentences(summary)),
        "FACTS": _facts(summary),
        "FIGURES": "".join(
            _figure(k, view, picture, _PICTURES_BYTES // len(pictures))
            for k, (view, picture) in enumerate(zip(summary["views"], pictures, strict=True))
        ),
        "BUTTONS": "".join(_button(k, view) for k, view in enumerate(summary["views"]))
        + _further_button(summary),
        "FURTHER": _further(summary),
        "LEFTOUT": _left_out(summary),
        "ANGLES": _angles(summary),
        "SHORTCOUNT": str(len(summary["views"]) + 1),
        "SHORTHEAD": "".join(
            f"<th>view {html.escape(str(view['id']))}</th>" for view in summary["views"]
        ),
        "BRANCHES": "".join(
            _branch(row, hidden, far)
            for row, hidden, far in zip(
                summary["tree"]["branches"], result.measured.hidden.tolist(), far_mm, strict=True
            )
        ),
        "GHOST": GHOST,
        "LESIONS": _lesions(summary["tree"]["branches"], far_mm),
        "PRESSURE": pressure_rows(summary),
        "ASSUMED": html.escape(summary["pressure"]["sentence"]),
        "CURVES": pressure_svg(result.pressure).replace(' xmlns="http://www.w3.org/2000/svg"', ""),
        "TIMINGS": _rows({k: f"{v:.2f} s" for k, v in summary["seconds"].items()}),
        "PROVENANCE": _rows(_provenance(summary)),
        "USE": html.escape(str(summary["use"])),
        "LOW": css(SCALE[0]),
        "HIGH": css(SCALE[1]),
        "DATA": _embedded(scene_data(result)),
    }
    # One pass: a name of a view that looks like a mark is text.
    page = re.sub("__([A-Z]+)__", lambda mark: parts.get(mark[1], mark[0]), template)
    return page.replace("__CSP__", page_policy(page), 1)


def page_policy(page: str) -> str:
    """Return the content security policy: only the scripts and styles of this very page."""

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


def _figure(number: int, view: Mapping[str, Any], picture: Array, most_bytes: int) -> str:
    name = html.escape(f"View {view['id']}: {view['name']}")
    source = base64.b64encode(_jpeg(picture, most_bytes)).decode("ascii")
    details = [
        explained(view["coverage"], view["coverage_even"], view["left_out"]),
        f"{_share(view['support'])} of the tree seen",
        f"overlap (Dice) {_number(view['overlap'])}",
        f"mean distance {_number(view['distance_mm'], ' mm')}",
    ]
    return (
        f'<figure><div class="stage"><img alt="{name}" src="data:image/jpeg;base64,{source}">'
        f'<canvas class="lines" data-view="{number}" role="img" '
        f'aria-label="{name}: reprojected centreline"></canvas></div>'
        f"<figcaption><b>{name}</b><br>"
        f"{'; '.join(details)}</figcaption></figure>"
    )


def _left_out(summary: Mapping[str, Any]) -> str:
    """Say what the grey of the pictures is, where there is some."""
    if not any(view["left_out"] for view in summary["views"]):
        return ""
    grey = '<span class="grey">Light grey</span> in the picture'
    return f' <span class="hint">{grey}, {LEFT_OUT}.</span>'


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


def _further_button(summary: Mapping[str, Any]) -> str:
    if summary["best_further_view"] is None:
        return ""
    name = html.escape(str(summary["best_further_view"]["name"]))
    return f'<button type="button" data-view="{len(summary["views"])}">Further: {name}</button>'


def _further(summary: Mapping[str, Any]) -> str:
    view = summary["best_further_view"]
    if view is None:
        return "Best further view: not known."
    return (
        f"Best further view: <b>{html.escape(str(view['name']))}</b>. It would lower the mean "
        f"bound of the centreline's error for 1 px of noise from {view['sigma_before_mm']:.2f} to "
        f"{view['sigma_after_mm']:.2f} mm, and hides {view['foreshortening']:.0%} of the length."
    )


def _angles(summary: Mapping[str, Any]) -> str:
    """One row a bifurcation: where, and the angle between each two branches."""
    rows = {}
    for k, node in enumerate(summary["tree"]["bifurcations"], start=1):
        rows[f"Bifurcation {k}"] = "; ".join(
            f"{angle['branches'][0]} and {angle['branches'][1]}: {angle['angle_deg']:.0f}°"
            for angle in node["angles"]
        )
    return _rows(rows) or "<tr><td>none</td></tr>"


def branch_title(row: Mapping[str, Any]) -> str:
    """Return the number of a branch, and its name with the probability if it has one."""
    if row["name"] is None:
        return str(row["branch"])
    # Rounded down: what is not certain never reads 100 %.
    return f"{row['branch']} {row['name']} ({int(100 * row['name_confidence'])} %)"


def _lesions(rows: Sequence[Mapping[str, Any]], far_mm: Sequence[float | None]) -> str:
    """One row a lesion, the most severe first."""
    found = [
        (one, row, far)
        for row, far in zip(rows, far_mm, strict=True) for one in row.get("lesions") or ()
    ]  # fmt: skip
    out = []
    for one, row, far in sorted(found, key=lambda told: -told[0]["stenosis_percent"]):
        start, end = one["lesion_mm"]
        cells = [
            branch_title(row), _from_ostium(one["minimal_at_mm"], far), f"{end - start:.1f}",
            _number(one["minimal_diameter_mm"]), _number(one["reference_diameter_mm"]),
            f"{one['stenosis_percent']:.0f} %",
        ]  # fmt: skip
        columns = "".join(f"<td>{html.escape(cell)}</td>" for cell in cells)
        out.append(f'<tr data-branch="{row["branch"]}">{columns}</tr>')
    return "".join(out) or '<tr><td colspan="6">none of a quarter and more</td></tr>'


def _from_ostium(at_mm: float | None, far_mm: float | None) -> str:
    """Distance of a place on a branch, mm; of a part that no ostium is known of, none."""
    return "-" if at_mm is None or far_mm is None else f"{far_mm + at_mm:.0f}"


def _branch(row: Mapping[str, Any], hidden: Sequence[float], far_mm: float | None) -> str:
    cells = [
        html.escape(branch_title(row)),
        f"{row['length_mm']:.1f}",
        f"{2 * row['mean_radius_mm']:.2f}",
        _number(row["minimal_diameter_mm"]),
        _number(row["reference_diameter_mm"]),
        _narrowing(row),
        _from_ostium(row["minimal_at_mm"], far_mm),
        f"{row['lesion_length_mm']:.1f}" if row["lesion_length_mm"] else "-",
        _number(row["mean_sigma_mm"]),
        _share(row["ghost_probability"]),
        *(f"{100 * share:.0f} %" for share in hidden),
    ]
    columns = "".join(f"<td>{cell}</td>" for cell in cells)
    return (
        f'<tr data-branch="{row["branch"]}"><td class="swatch"></td>{columns}'
        '<td class="short">-</td></tr>'
    )


def _narrowing(row: Mapping[str, Any]) -> str:
    """Say the stenosis, that of further lesions, and what the branch narrows to without one."""
    if row["stenosis_percent"] is None:
        return "-"
    further = [one["stenosis_percent"] for one in (row.get("lesions") or ())[1:]]
    told = ", ".join(f"{percent:.0f} %" for percent in (row["stenosis_percent"], *further))
    least = row.get("narrows_to_mm")
    return told if least is None else f"{told}; narrows to {least:.2f} mm without recovery"


def pressure_rows(summary: Mapping[str, Any]) -> str:
    """One row a branch: Pd/Pa at its far end with the interval, or why it is withheld."""
    out = []
    titles = [branch_title(row) for row in summary["tree"]["branches"]]
    for row, title in zip(summary["pressure"]["branches"], titles, strict=True):
        cells = [title, f"{row['from_mm']:.0f} - {row['to_mm']:.0f}"]
        cells.append("-" if row["flow_ml_min"] is None else f"{row['flow_ml_min']:.0f}")
        line = "".join(f"<td>{html.escape(cell)}</td>" for cell in cells)
        if row["withheld"]:
            told = f'<td colspan="3">withheld: {html.escape(row["withheld"])}</td>'
        else:
            low, high = row["interval"]
            told = (
                f"<td>{row['pd_pa']:.2f}</td><td>{low:.2f} - {high:.2f}</td>"
                f"<td>{row['drop_mmhg']:.1f}</td>"
            )
        out.append(f"<tr>{line}{told}</tr>")
    return "".join(out)


def _sentences(summary: Mapping[str, Any]) -> list[str]:
    """List findings and notes; the first finding is the status sentence already."""
    return [*summary["findings"][1:], *summary["notes"]]


def _facts(summary: Mapping[str, Any]) -> str:
    facts = {
        "view separation": f"{summary['separation_deg']:.0f} deg",
        "branches": str(len(summary["tree"]["branches"])),
        "centreline": f"{summary['tree']['length_mm']:.0f} mm",
        "connected parts": str(len(summary["tree"]["parts_mm"])),
        "expected in ghosts": _share(summary["ambiguity"]["ghost_share"]),
        "Gaussians": str(summary["counts"]["gaussians"]),
        "time": f"{summary['seconds']['total']:.1f} s",
        # Here alone: the other files of one input are the same on every day.
        "written": datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %z"),
    }
    return "".join(
        f"<span>{html.escape(name)} <b>{html.escape(value)}</b></span>"
        for name, value in facts.items()
    )


def _provenance(summary: Mapping[str, Any]) -> dict[str, str]:
    models = {key: summary[key] for key in ("model", "segmenter")}
    said = {
        key: "none" if model is None else f"{model['name']} ({model['sha256'][:12]})"
        for key, model in models.items()
    }
    rows = {
        "Centres": str(summary["predictor"]),
        "Model": said["model"],
        "Vessel network": said["segmenter"],
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

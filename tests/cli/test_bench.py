"""gcar bench: its table, its picture, and what it says of wrong calls."""

from __future__ import annotations

import csv
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from gcar_deploy.bench import tradeoff as benchmark
from gcar_deploy.bench.chart import RIGHT, WIDTH, Point, tradeoff_svg
from gcar_deploy.bench.tradeoff import Cell, Row, at_size, front, knee
from gcar_deploy.cli.bench import COLUMNS, _csv, chart
from tests.cli.conftest import gcar


def row(seconds, error, refiner="tube", **more):
    cell = Cell(predictor="none", refiner=refiner, iterations=4, gaussians=None, pixels=128)
    return Row(
        case="a", cell=cell, status="ok", used=9, p50_s=seconds, p95_s=seconds, rmse_mm=error,
        p95_mm=2 * error, over_bound=error / 0.5, dsc=0.8, **more,
    )  # fmt: skip


def test_front_and_knee():
    rows = [row(1.0, 2.0), row(2.0, 1.0), row(3.0, 1.5), row(4.0, 0.97), row(9.0, 0.96)]
    assert [r.p50_s for r in front(rows)] == [1.0, 2.0, 4.0, 9.0]
    # 1.0 is within 5 % of the least, 0.96, and the cheapest that is.
    assert knee(rows).p50_s == 2.0
    failed = Row(case="a", cell=rows[0].cell, status="refused")
    assert front([failed]) == [] and knee([failed]) is None


def test_table_and_picture_hold_every_cell():
    rows = [row(1.0, 2.0, refiner="none"), row(2.0, 1.0), row(3.0, 1.5, refiner="paper & co")]
    table = list(csv.DictReader(_csv(rows).splitlines()))
    assert tuple(table[0]) == COLUMNS and [r["rmse_mm"] for r in table] == ["2", "1", "1.5"]
    svg = ET.fromstring(chart(rows, "demo"))  # noqa: S314 - our own text
    space = "{http://www.w3.org/2000/svg}"
    tips = [t.text for t in svg.iter(f"{space}title")]
    assert len(tips) == 3 and any("paper & co" in t for t in tips)
    words = " ".join(t.text for t in svg.iter(f"{space}text"))
    assert (
        "Pareto front" in words
        and "Bound" in words.title()
        and "more work" in words
        and "predictor + refiner" in words
    )


def test_the_chart_explains_ring_and_dotted_line_beside_itself():
    """Words within it would lie on points; nothing is explained that is not drawn."""
    points = [Point(seconds=s, error_mm=e, series="a") for s, e in ((1, 2), (2, 1), (9, 0.9))]

    def drawn(knee, bound_mm):
        made = tradeoff_svg(points, points[:2], knee, title="t", bound_mm=bound_mm)
        svg, space = ET.fromstring(made), "{http://www.w3.org/2000/svg}"  # noqa: S314 - our own
        words = {t.text: float(t.get("x")) for t in svg.iter(f"{space}text")}
        rings = sum(c.get("fill") == "none" for c in svg.iter(f"{space}circle"))
        dotted = sum(one.get("stroke-dasharray") == "2 4" for one in svg.iter(f"{space}line"))
        return words, rings, dotted

    words, rings, dotted = drawn(points[1], 1.2)
    assert (rings, dotted) == (2, 2)  # in the chart, and what it means
    for told in ("more work buys", "nothing past here", "Cramér-Rao bound"):
        assert words[told] > WIDTH - RIGHT
        assert words[told] + 7.5 * len(told) < WIDTH
    words, rings, dotted = drawn(None, None)
    assert (rings, dotted) == (0, 0) and not {"more work buys", "Cramér-Rao bound"} & words.keys()


def test_the_grid_varies_every_axis():
    full, quick = benchmark.cells(False), benchmark.cells(True)
    assert len(quick) < len(full) / 3
    for name in ("predictor", "refiner", "iterations", "gaussians", "pixels"):
        assert len({getattr(cell, name) for cell in full}) >= 2, name


def test_pictures_shrink_with_their_view():
    case = benchmark.demo()
    small = at_size(case.angiograms, 128)
    assert {a.pixels.shape for a in small} == {(128, 128)}
    for a, b in zip(small, case.angiograms, strict=True):
        assert (a.carm.rows, a.carm.columns) == (128, 128)
        assert a.pixels.mean() == pytest.approx(b.pixels.mean(), rel=1e-5)
    assert at_size(case.angiograms, 4096)[0] is case.angiograms[0]


@pytest.mark.slow
def test_one_cell_of_the_demo_is_measured():
    cell = Cell(predictor="none", refiner="tube", iterations=2, gaussians=None, pixels=128)
    (found,) = benchmark.run([benchmark.demo()], [cell], repeats=1, threads=1)
    assert found.status == "degraded" and found.used > 10
    assert found.p50_s > 0 and found.rmse_mm > 0 and found.pairs is None
    assert found.over_bound == pytest.approx(found.rmse_mm / benchmark._bound_mm(benchmark.demo()))


def test_wrong_calls_are_one_line(tmp_path: Path):
    (tmp_path / "bench.csv").write_text("mine")
    done = gcar("bench", "--out", tmp_path)
    assert done.code == 2 and "bench.csv exists; --force" in done.err
    assert (tmp_path / "bench.csv").read_text() == "mine"


def test_what_the_workshop_offers_is_declared_and_there():
    import tomllib

    root = Path(__file__).parents[2]
    declared = tomllib.loads((root / "pyproject.toml").read_text())["project"]["entry-points"]
    assert set(declared[benchmark.PLUGINS]) == {"label-cases", "pair-timer"}
    pytest.importorskip("numba")
    from gcar_export.cli import bench_plugins

    for target in declared[benchmark.PLUGINS].values():
        module, name = target.split(":")
        assert module == "gcar_export.cli.bench_plugins" and callable(getattr(bench_plugins, name))

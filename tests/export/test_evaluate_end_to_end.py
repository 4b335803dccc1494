"""A small generated tree through every method, to tables, pictures and report."""

import dataclasses
import json
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from gcar_deploy.errors import ModelError
from gcar_export.cli.main import main
from gcar_export.evaluate.evaluate import EvaluateOptions, evaluate
from gcar_export.evaluate.tables import MEASURES
from gcar_export.methods.settings import METHODS, MethodSettings
from gcar_export.methods.solve import check_models
from gcar_export.studies.converge import converge
from tests.export.label_files import write_tree

pytestmark = pytest.mark.slow
PLAIN = MethodSettings()
SETTINGS = dataclasses.replace(
    PLAIN,
    paper_steps=5,
    fbp_gaussians=500,
    nerp=dataclasses.replace(PLAIN.nerp, steps=30, width=32, features=32, hidden_layers=2),
    sart=dataclasses.replace(PLAIN.sart, iterations=3),
)


def available():
    """Every method but those of the single-view predictor where no such model is installed."""
    out = []
    for method in METHODS:
        try:
            check_models([method], SETTINGS)
            out.append(method)
        except ModelError as error:
            assert "gcp" in method, error
    return tuple(out)


class Page(HTMLParser):
    """Counts what a report holds."""

    def __init__(self):
        super().__init__()
        self.tags, self.sources = [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href")]


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("end-to-end")
    write_tree(folder / "imagecas" / "5.label.nii.gz", 5)
    options = EvaluateOptions(
        data=folder, out=folder / "out", protocol="paper", methods=available(), settings=SETTINGS
    )
    return options, evaluate(options)


def test_every_method_gives_every_measure_or_a_reason(evaluated):
    options, rows = evaluated
    assert len(rows) == len(options.methods)
    for row in rows:
        assert row["status"] in ("ok", "degraded"), (row["method"], row["sentence"])
        assert row["seconds"] > 0
        # what only the moved, the common and the thin protocol ask for
        elsewhere = {"shifted_dsc", "cd_mm", "parts", "found_1mm", "true_1mm"}
        assert not elsewhere & set(row["measures"])
        for name in set(MEASURES) - elsewhere:
            value = row["measures"][name]
            assert (value is None) == (name in row["reasons"]), (row["method"], name)
            assert value is None or np.isfinite(value)
    json.loads((options.out / "summary.json").read_text(), parse_constant=pytest.fail)


def test_methods_keep_their_rank(evaluated):
    _, rows = evaluated
    best = {
        method: np.mean([r["measures"]["best_dsc"] or 0.0 for r in rows if r["method"] == method])
        for method in {row["method"] for row in rows}
    }
    assert best["ours"] > 0.6
    assert best["ours"] == best["multi+tube"]
    for method in ("hull", "visual_hull", "fdk", "sart", "nerp", "3dgr-fbp"):
        assert best["ours"] > best[method] + 0.1, method


def test_report_holds_tables_and_pictures_and_is_drawn_again_from_the_csv(evaluated):
    options, _ = evaluated
    given = ["evaluate", "--data", str(options.data), "--out", str(options.out), "--draw-only"]
    tables = (options.out / "tables.md").read_text()
    pages = []
    for _ in range(2):
        done = CliRunner().invoke(main, [*given, "--methods", ",".join(options.methods)])
        assert done.exit_code == 0, done.output
        pages.append((options.out / "report.html").read_text())
    assert (options.out / "tables.md").read_text() == tables
    assert pages[0] == pages[1]
    page = Page()
    page.feed(pages[0])
    assert page.tags.count("img") == 3  # bars, speed against error, the tree
    assert all(source.startswith("data:image/png;base64,") for source in page.sources)
    for path in (options.out / "pictures").glob("*.png"):
        picture = cv2.imread(str(path))
        assert picture.std() > 5, path.name
    assert all(f"<td>{method}</td>" in pages[0] for method in options.methods)


def test_curves_of_convergence_rise(evaluated, tmp_path):
    options, _ = evaluated
    part = dataclasses.replace(options, methods=("nerp",), out=tmp_path, cases=("5",))
    rows = converge(part, (60, 1))
    assert [row["steps"] for row in rows] == [1, 60]
    first, last = (row["measures"]["best_dsc"] or 0.0 for row in rows)
    assert last > first + 0.1
    assert cv2.imread(str(tmp_path / "converge.png")).std() > 5
    assert len((tmp_path / "converge.csv").read_text().splitlines()) == 3

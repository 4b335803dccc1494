"""The page of the paper's tables: its own cells, empty ones for what was not run."""

import json

import pytest

from gcar_deploy.errors import UsageError
from gcar_export.evaluate import paper_tables, tables
from gcar_export.studies import paper_page


def row(method, views=2, case="0001", dsc=0.5):
    measures = dict.fromkeys(tables.MEASURES) | {
        "dsc": dsc, "new_dsc": 0.4, "new_psnr_masked_db": 20.0, "new_psnr_db": 25.0, "ssim": 0.97,
    }  # fmt: skip
    return {
        "protocol": "paper", "dataset": "ImageCAS", "views": views, "case": case,
        "method": method, "status": "ok", "sentence": "", "measures": measures, "gaussians": 336,
        "seconds": 1.0, "cpu_seconds": 2.0, "stages": {}, "reasons": {},
    }  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "rows").mkdir()
    made = [row("3dgr-gcp", 2, case, dsc) for case, dsc in (("0001", 0.3), ("0003", 0.5))]
    made += [row("3dgr-gcp", 4), row("ours", 2, "0001", 0.8), row("3dgr-fbp"), row("fdk")]
    for k, one in enumerate(made):
        (tmp_path / "rows" / f"paper-{k}.json").write_text(json.dumps(one))
    return tmp_path


def test_rows_stand_beside_the_printed_values_under_their_own_names(folder):
    text = paper_page.page(paper_page.read_rows(folder))
    lines = text.splitlines()
    (ours,) = [k for k, line in enumerate(lines) if "| 3DGR-FBP (as printed) |" in line]
    assert "52.86 ± 4.95" in lines[ours + 1] and paper_tables.NOTE in lines[ours + 1]
    assert any("| ImageCAS (2) | 3DGR-GCP (as printed) | 40.00 ± 0.00" in line for line in lines)


def test_what_was_not_run_is_an_empty_cell_and_never_a_number(folder):
    text = paper_page.over_views(paper_page.read_rows(folder))
    volume = text[text.index("| DSC(0.5) %") :].splitlines()
    # One tree was seen from four views: at two views, too, it alone counts.
    assert "| 3dgr-gcp | 30.00 (n=1) | 50.00 (n=1) |  |  |" in volume
    assert "| nerp |  |  |  |  |" in volume
    ran = paper_page.what_was_run(paper_page.read_rows(folder))
    assert "| 3DGR-GCP (as printed): the paper's predictor, its refinement | 2 | 2 | 336 |" in ran


def test_figures_are_drawn_from_what_is_there(folder):
    path = paper_page.draw(paper_page.read_rows(folder), folder)
    assert path.read_bytes()[:4] == b"\x89PNG"


def test_a_folder_without_rows_is_said(tmp_path):
    with pytest.raises(UsageError, match="holds no row"):
        paper_page.read_rows(tmp_path)

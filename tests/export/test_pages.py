"""Documents get their figures from what evaluations left, and nothing else of them changes."""

from __future__ import annotations

from gcar_export.evaluate import tables
from gcar_export.evaluate.pages import filled
from tests.export.test_evaluate import _row

PAGE = """before
<!-- figures: overview -->
old
| raw 8-bit pictures of the same | 9 | as it was |
<!-- end -->
between
<!-- figures: paper -->
<!-- end -->
<!-- figures: absent -->
kept
<!-- end -->
after
"""


def test_blocks_are_filled_and_the_rest_stays(tmp_path):
    (tmp_path / "paper").mkdir()
    rows = [_row("1", "ours", 0.5), _row("2", "ours", 0.7), _row("1", "hull", 0.1)]
    rows[1]["status"] = "degraded"
    rows[0]["measures"]["cldice"] = 0.25
    rows[1]["measures"]["cldice"] = 0.75
    (tmp_path / "paper" / "cases.csv").write_text(tables.case_rows_csv(rows))
    text, missing = filled(PAGE, tmp_path)
    assert missing == ["absent"]
    lines = text.splitlines()
    assert lines[0] == "before" and lines[-1] == "after" and "kept" in lines and "between" in lines
    assert "old" not in lines
    (line,) = [line for line in lines if line.startswith("| path lengths 128")]
    # by hand: mean of 50 and 70 with SD 14.14, of 25 and 75 with SD 35.36
    assert "| 2 | 60.00 ± 14.14 | 50.00 ± 35.36 | - | 2.00 ± 0.00 | 1 / 1 / 0 |" in line
    assert lines.index("| raw 8-bit pictures of the same | 9 | as it was |") > lines.index(line)
    assert "| hull | 10.00 (n=1)" in text
    assert filled(text, tmp_path)[0] == text

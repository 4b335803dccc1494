"""Seconds per picture: methods in turns, the pair only where there is one."""

import pytest

pytest.importorskip("numba")

from gcar_export.studies import segmentation_time as study


def test_the_ratio_is_that_to_the_pair_and_goes_without_it():
    lines = study.table({"net": 0.3, "auto": 0.5, study.PAIR: 0.1}).splitlines()
    assert lines[0].count("|") == 5
    assert [line.split("|")[-2].strip() for line in lines[2:]] == ["3.0", "5.0"]
    alone = study.table({"net": 0.3}).splitlines()
    assert alone[0].count("|") == 3 and "itk" not in "".join(alone) and "0.300" in alone[2]


@pytest.mark.slow
def test_every_method_reads_every_picture_and_the_pair_runs_beside(monkeypatch):
    read, paired = [], []
    monkeypatch.setattr(
        study, "extract_vessels", lambda a, options, net: read.append((a.sha256, options.segmenter))
    )
    seconds = study.timed(None, lambda: paired.append(1), trees=2, repeats=2)
    assert list(seconds) == ["auto", "classic", "net", study.PAIR]
    assert len(paired) == 5 and len(read) == 15 and {name for name, _ in read} == {"0", "1"}
    assert study.pictures(1)[0].pixels.shape == (512, 512)
    assert study.PAIR not in study.timed(None, None, trees=1, repeats=1)
